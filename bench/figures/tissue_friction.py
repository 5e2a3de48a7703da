"""Figure of dry friction: what a tool takes that slides to and fro on a flat rigid ground."""

import math

import numpy as np

from bench.figures.figure import Figure
from cutting_trainer.haptic_bridge.proxy.friction import drag, make_stick
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.tissue_sim.contact.friction import Friction

_RADIUS, _DEPTH, _REACH = 0.004, 0.002, 0.003
"""[m] of the sphere; of the tip; half of the way to and fro."""
_STIFFNESS = 200.0
"""[N/m] of the coupling spring, on a rigid ground."""
_COEFFICIENTS = (0.1, 0.3, 0.6)
_TICKS = 1000
"""In a cycle."""


def measure() -> list[Figure]:
    """Return the figure of line 6."""
    off = [abs(_loop(mu) / _exact(mu) - 1) for mu in _COEFFICIENTS]
    name = 'work of friction in a cycle, off 4 mu N (reach - mu N / k)'
    return [Figure(6, name, max(off), 0.02, 'at most', '', len(off))]


def _exact(coefficient: float) -> float:
    held = coefficient * _STIFFNESS * _DEPTH
    return 4 * held * (_REACH - held / _STIFFNESS)


def _loop(coefficient: float) -> float:
    """Return the work that the hand puts in over the second cycle [J]."""
    half = 0.05
    corners = half * np.array(
        [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0]]
    )
    ground = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), revision=1, topology=1)
    stick = make_stick(Friction(coefficient))
    proxy = Proxy(_RADIUS, stick)
    proxy.step(ground, 1.0, np.array([0.0, 0.0, 2 * _RADIUS]))
    way = _REACH * np.sin(np.linspace(0.0, 4 * math.pi, 2 * _TICKS + 1))
    pulls = np.zeros(len(way))
    for i, x in enumerate(way):
        tip = np.array([x, 0.0, _RADIUS - _DEPTH])
        touch = proxy.step(ground, 1.0, tip)
        pressed = _STIFFNESS * float(np.linalg.norm(proxy.place - tip))
        drag(stick, tip, touch.normal, pressed, _STIFFNESS)
        pulls[i] = -stick[0]['force'][0]
    pulls, way = pulls[_TICKS:], way[_TICKS:]
    return float(np.sum((pulls[1:] + pulls[:-1]) / 2 * np.diff(way)))
