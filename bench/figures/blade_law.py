"""Figures of the law of the blade: work of a cut, what leads it, how it goes in, and slicing."""

import numpy as np

from bench.figures.figure import Figure
from bench.haptics.leading_side import DEPTH, TOUGHNESS, moved
from bench.haptics.puncture import TOUGHNESS as PUNCTURED
from bench.haptics.puncture import WIDTH, pushed_in
from bench.haptics.turned_blade import PRICE, turned
from bench.validate.blade import run_slicing
from bench.validate.sawtooth import run_sawtooth
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings

_HERTZ = 2.5
"""Force over J w at which the work of a dent by Hertz reaches J w times its depth."""


def measure() -> list[Figure]:
    """Return the figures of lines 3 and 7."""
    work, paid = turned(DeviceSettings(), 1.0)
    name = 'turned by 57 degrees in tissue: price of the cut over J A, off 1'
    felt = 'work of the hand by force and torque over the price of the cut, off 1'
    return [
        Figure(3, name, abs(paid / PRICE - 1), 0.05, 'at most', '', 1),
        Figure(3, felt, abs(work / paid - 1), 0.05, 'at most', '', 1),
        *_leading(),
        *_puncture(),
        *_slicing(),
        *_sawtooth(),
    ]


def _leading() -> list[Figure]:
    edge, flat, spine = (moved(np.radians(angle)) for angle in (0.0, 90.0, 180.0))
    opened = 1e6 * (spine.opened + flat.opened)
    cutting = abs(edge.force / (TOUGHNESS * DEPTH) - 1)
    return [
        Figure(3, 'edge leading: force over J w, off 1', cutting, 0.05, 'at most', '', 1),
        Figure(3, 'force, spine over edge', spine.force / edge.force, 1.02, 'at least', '', 1),
        Figure(3, 'force, flat over spine', flat.force / spine.force, 1.02, 'at least', '', 1),
        Figure(3, 'opened with spine and flat leading', opened, 0.0, 'at most', 'mm^2', 2),
    ]


def _puncture() -> list[Figure]:
    slit = PUNCTURED * WIDTH
    peaks = [
        pushed_in(cell, rate, modulus, until_entry=True).peak
        for cell, rate, modulus in ((0.0075, 480, 10800), (0.0075, 480, 43200), (0.005, 960, 21600))
    ]
    entry = max(abs(peak / (_HERTZ * slit) - 1) for peak in peaks)
    usual, refined = (pushed_in(*of, 21600).plateau for of in ((0.006, 30), (0.004, 240)))
    return [
        Figure(7, 'force of entry over 2.5 J w, off 1', entry, 0.1, 'at most', '', len(peaks)),
        Figure(7, 'force after it over J w, off 1', abs(usual / slit - 1), 0.1, 'at most', '', 1),
        Figure(7, 'the same over refined, off 1', abs(usual / refined - 1), 0.1, 'at most', '', 1),
    ]


def _sawtooth() -> list[Figure]:
    errors = [abs(result.error or 0.0) for result in run_sawtooth(quick=True)]
    name = 'crack in steps: mean, length and work of the teeth, off 1, worst'
    return [Figure(7, name, max(errors), 0.1, 'at most', '', len(errors))]


def _slicing() -> list[Figure]:
    errors = [abs(result.error or np.inf) for result in run_slicing(quick=False)]
    name = 'slice/push 0 to 4, force over that of Atkins, off 1, worst'
    return [Figure(7, name, max(errors), 0.1, 'at most', '', len(errors))]
