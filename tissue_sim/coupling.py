"""How the tool holds on to the tissue: a spring to a material point, evaluated in every substep.

A force that is held for a 33 ms frame makes the loop of coupling spring and tissue diverge as soon
as the spring is stiffer than the tissue. So the simulation is given the spring, not the force: its
tissue end moves with the nodes.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

FREE = 0
PUSH = 1
HOLD = 2
_GRIP = 1.0
"""Largest force along the surface in a frame, as a part of that into it."""


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
