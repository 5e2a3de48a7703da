"""How the tool holds on to the tissue: a spring to a material point, evaluated in every substep.

A force that is held for a 33 ms frame makes the loop of coupling spring and tissue diverge as soon
as the spring is stiffer than the tissue. So the simulation is given the spring, not the force: its
tissue end moves with the nodes.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

FREE = 0
PUSH = 1
HOLD = 2
_GRIP = 1.0
"""Largest force along the surface in a frame, as a part of that into it."""


class Spring(NamedTuple):
    """What the kernels take of a coupling.

    Attributes:
        mode, nodes, weights, normal: see `Coupling`.
        ends: its tool's end at the start and at the end of the frame [m], shape (2, 3).
        anchor: rest position of the tissue's end [m], shape (3,).
        scalars: stiffness [N/m] and largest force [N].
    """

    mode: int
    nodes: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    ends: np.ndarray
    anchor: np.ndarray
    scalars: np.ndarray


@dataclass
class Coupling:
    """A spring between the tool and the weighted mean of some nodes.

    Attributes:
        mode: FREE (no spring), PUSH (frictionless, along `normal`, never pulls) or HOLD (all
            directions).
        nodes: shape (c,).
        weights: sum 1, shape (c,).
        start, end: where the tool's end of the spring is at the start and at the end of the frame
            [m], shape (3,).
        normal: outward unit normal (PUSH), shape (3,).
        stiffness: [N/m].
        limit: largest force [N]; the spring yields above it.
    """

    mode: int = FREE
    nodes: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))
    start: np.ndarray = field(default_factory=lambda: np.zeros(3))
    end: np.ndarray = field(default_factory=lambda: np.zeros(3))
    normal: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stiffness: float = 0.0
    limit: float = np.inf

    def point(self, positions: np.ndarray) -> np.ndarray:
        """The tissue's end of the spring [m], shape (3,), for node positions [m], shape (n, 3)."""
        return self.weights @ positions[self.nodes]

    def spring(self, rest: np.ndarray) -> Spring:
        """What the kernels take, for rest positions [m], shape (n, 3)."""
        return Spring(
            self.mode,
            self.nodes,
            self.weights,
            self.normal,
            np.array([self.start, self.end]),
            self.weights @ rest[self.nodes],
            np.array([self.stiffness, self.limit]),
        )

    def force(self, positions: np.ndarray) -> np.ndarray:
        """Force on the tissue at the end of the frame [N], shape (3,)."""
        out = np.zeros(3)
        scalars = np.array([self.stiffness, self.limit])
        spring_force(self.mode, self.end - self.point(positions), self.normal, scalars, out)
        return out


@njit(cache=True)
def spring_force(mode, stretch, normal, scalars, out):
    """Force of the spring on the tissue.

    Args:
        mode: FREE, PUSH or HOLD.
        stretch: tool's end minus tissue's end [m], shape (3,).
        normal: outward unit normal, shape (3,).
        scalars: stiffness [N/m] and largest force [N].
        out: force [N], shape (3,).
    """
    stiffness, limit = scalars[0], scalars[1]
    out[:] = 0.0
    if mode == PUSH:
        along = stretch[0] * normal[0] + stretch[1] * normal[1] + stretch[2] * normal[2]
        if along >= 0.0:
            return
        across = 0.0
        for i in range(3):
            out[i] = stretch[i] - along * normal[i]
            across += out[i] * out[i]
        # Continuous where the contact opens: a spring that let go at once would feed energy in.
        grip = min(1.0, -_GRIP * along / max(np.sqrt(across), 1e-300))
        for i in range(3):
            out[i] = stiffness * (along * normal[i] + grip * out[i])
    elif mode == HOLD:
        length = np.sqrt(stretch[0] ** 2 + stretch[1] ** 2 + stretch[2] ** 2)
        size = stiffness
        if stiffness * length > limit:
            size = limit / length
        for i in range(3):
            out[i] = size * stretch[i]


@njit(cache=True)
def spring_stretch(spring, at, u, stretch):
    """Tool's end minus tissue's end.

    Args:
        spring: see `Spring`.
        at: share of the frame that has passed.
        u: displacement by coordinate [m], shape (3 n,).
        stretch: output [m], shape (3,).
    """
    ends = spring.ends
    for i in range(3):
        stretch[i] = ends[0, i] + at * (ends[1, i] - ends[0, i]) - spring.anchor[i]
        for c in range(spring.nodes.shape[0]):
            stretch[i] -= spring.weights[c] * u[3 * spring.nodes[c] + i]


@njit(cache=True)
def force_of_spring(spring, at, u, out):
    """Force of the spring on the tissue.

    Args:
        spring: see `Spring`.
        at: share of the frame that has passed.
        u: displacement by coordinate [m], shape (3 n,).
        out: [N], shape (3,).
    """
    stretch = np.empty(3)
    spring_stretch(spring, at, u, stretch)
    spring_force(spring.mode, stretch, spring.normal, spring.scalars, out)


@njit(cache=True)
def subtract_spring(spring, at, u, f, out):
    """Takes the spring's force on the tissue off the elastic one.

    Args:
        f: what is to be subtracted from [N], shape (3 n,).
        spring, at, u, out: as for `force_of_spring`.
    """
    force_of_spring(spring, at, u, out)
    for c in range(spring.nodes.shape[0]):
        for i in range(3):
            f[3 * spring.nodes[c] + i] -= spring.weights[c] * out[i]


@njit(cache=True)
def spring_work(spring, force, u, last):
    """Work on the tissue since the last call, by the mean of the forces then and now [J].

    Args:
        spring: see `Spring`.
        force: on the tissue now [N], shape (3,).
        u: displacement by coordinate [m], shape (3 n,).
        last: force [N] and place [m] of the tissue's end at the last call; renewed, shape (2, 3).
    """
    work = 0.0
    for i in range(3):
        place = 0.0
        for c in range(spring.nodes.shape[0]):
            place += spring.weights[c] * u[3 * spring.nodes[c] + i]
        work += 0.5 * (force[i] + last[0, i]) * (place - last[1, i])
        last[0, i] = force[i]
        last[1, i] = place
    return work


@njit(cache=True)
def start_of_work(spring, u, last):
    """Puts the present place of the tissue's end, and no force, in `last`; the work is 0 J."""
    force = np.zeros(3)
    spring_work(spring, force, u, last)
    return 0.0
