"""Coupling of tool and tissue: a spring to a material point, evaluated in every substep.

A force held constant for a 33 ms frame makes the loop of coupling spring and tissue diverge as soon
as the spring is stiffer than the tissue. The simulation therefore gets the spring, not the force:
its tissue end moves with the nodes.

Against a footprint the spring has a part that the mesh cannot see in series: the settlement under
the tool, hertz * force^(2/3) (1 + bend * force^(2/3)), less the part `seen` by the mesh. It is
never stiffer than the coupling spring alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel

FREE = 0
PUSH = 1
HOLD = 2


class Springs(NamedTuple):
    """The couplings of all tools as operand of the kernels, t of them.

    Attributes:
        modes: see `Coupling`, shape (t,).
        nodes, weights: likewise; a short row repeats its first node with weight 0, shape (t, c).
        normals: likewise, shape (t, 3).
        ends: positions of the tools' ends at the start and end of the frame [m], shape (t, 2, 3).
        anchors: rest positions of the tissue's ends [m], shape (t, 3).
        scalars: see `Coupling.scalars`, shape (t, 9).
    """

    modes: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    normals: np.ndarray
    ends: np.ndarray
    anchors: np.ndarray
    scalars: np.ndarray


class PointSprings(NamedTuple):
    """The springs of a blade, one for each point of its edge in the tissue, p of them.

    Attributes:
        nodes: corners of the element around each, shape (p, 4).
        weights: barycentric coordinates there, shape (p, 4).
        ends: where the tool's end is at the start and at the end of the frame [m], shape (p, 2, 3).
        stiffness: [N/m], shape (p,).
        limits: largest forces [N], shape (p,).
    """

    nodes: np.ndarray
    weights: np.ndarray
    ends: np.ndarray
    stiffness: np.ndarray
    limits: np.ndarray


@dataclass
class Coupling:
    """A spring between the tool and the weighted mean of some nodes.

    Attributes:
        mode: FREE (no spring), PUSH (along `normal`, never pulls, and across it up to `share`) or
            HOLD (all directions).
        nodes: shape (c,).
        weights: sum 1, shape (c,).
        start, end: where the tool's end of the spring is at the start and at the end of the frame
            [m], shape (3,).
        normal: outward unit normal (PUSH), shape (3,).
        stiffness: [N/m].
        limit: largest force [N]; the spring yields above it.
        hertz: settlement under the tool, by force^(2/3) (PUSH); 0: none in series [m N^(-2/3)].
        bend: its relative growth, by force^(2/3) [N^(-2/3)].
        seen: compliance of the mesh that this settlement replaces [m/N].
        most: force from which on the settlement grows in proportion [N].
        reach: radius of the disc around the touched point that is under load [m]; 0: a triangle.
        share: largest tangential force, relative to the normal force (PUSH): without friction, of
            the tissue that moves under the tool within a frame; else the coefficient of friction.
        points: springs that move the tissue in place of this one, which is their mean (HOLD). A
            single spring would load the points otherwise than they pull, and give energy to the
            tissue: the blade would stick and slip.
    """

    mode: int = FREE
    nodes: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))
    start: np.ndarray = field(default_factory=lambda: np.zeros(3))
    end: np.ndarray = field(default_factory=lambda: np.zeros(3))
    normal: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stiffness: float = 0.0
    limit: float = np.inf
    hertz: float = 0.0
    bend: float = 0.0
    seen: float = 0.0
    most: float = np.inf
    reach: float = 0.0
    share: float = 1.0
    points: PointSprings | None = None

    @cached_property
    def scalars(self) -> np.ndarray:
        """Constants of the law at its first use, shape (9,).

        Stiffness [N/m], largest force [N]; of the settlement `hertz`, `bend`, `seen`; force [N],
        stretch [m] and stiffness [N/m] from which on the law is straight; `share`.
        """
        law = np.zeros(9)
        law[:5] = self.stiffness, self.limit, self.hertz, self.bend, self.seen
        law[8] = self.share
        if self.hertz > 0.0:
            steepest = (2 * self.hertz / (3 * self.seen)) ** 3 if self.seen > 0.0 else np.inf
            law[5] = min(steepest, self.most)
            if np.isfinite(law[5]):
                root = np.cbrt(law[5])
                yields = self.hertz * (2 + 4 * self.bend * root**2) / (3 * root) - self.seen
                law[6] = self._stretch_at(law[5])
                law[7] = 1 / (1 / self.stiffness + max(yields, 0.0))
        return law

    def stretch_at(self, force: float) -> float:
        """Return the normal stretch at a normal force [m]."""
        law = self.scalars
        if force > law[5] and self.hertz > 0.0:
            return float(law[6] + (force - law[5]) / law[7])
        return self._stretch_at(force)

    def _stretch_at(self, force: float) -> float:
        """Return the normal stretch in the curved part of the law [m]."""
        part = np.cbrt(force) ** 2
        settled = self.hertz * part * (1 + self.bend * part)
        return float(force * (1 / self.stiffness - self.seen) + settled)

    def pushed(self, stretch: float) -> float:
        """Return the normal force at a normal stretch, 0 or more [N]."""
        return float(normal_force(stretch, self.scalars))

    def point(self, positions: np.ndarray) -> np.ndarray:
        """Return the tissue's end of the spring [m], shape (3,); `positions` has shape (n, 3)."""
        return self.weights @ positions[self.nodes]

    def force(self, positions: np.ndarray, share: float = 1.0) -> np.ndarray:
        """Return the force on the tissue after a share of the frame [N], shape (3,)."""
        out = np.zeros(3)
        stretch = self.start + share * (self.end - self.start) - self.point(positions)
        spring_force(self.mode, stretch, self.normal, self.scalars, out)
        return out


def springs_of(couplings: Sequence[Coupling], rest: np.ndarray) -> Springs:
    """Return the operand of the kernels for the couplings that are not free.

    Args:
        couplings: of the tools.
        rest: rest positions [m], shape (n, 3).
    """
    rows = [_rows(coupling) for coupling in couplings if coupling.mode != FREE]
    if not rows:
        none, pairs = np.zeros((0, 3)), np.zeros((0, 2, 3))
        nodes, weights = np.zeros((0, 0), np.int64), np.zeros((0, 0))
        modes, scalars = np.zeros(0, np.int64), np.zeros((0, 9))
        return Springs(modes, nodes, weights, none, pairs, none, scalars)
    width = max(row.nodes.shape[1] for row in rows)
    count = sum(len(row.modes) for row in rows)
    nodes, weights, at = np.zeros((count, width), np.int64), np.zeros((count, width)), 0
    for row in rows:
        here = slice(at, at + len(row.modes))
        nodes[here] = row.nodes[:, :1]
        nodes[here, : row.nodes.shape[1]] = row.nodes
        weights[here, : row.nodes.shape[1]] = row.weights
        at = here.stop
    anchors = np.einsum('rc,rci->ri', weights, rest[nodes])
    modes, normals, ends, scalars = (
        np.concatenate([getattr(row, name) for row in rows])
        for name in ('modes', 'normals', 'ends', 'scalars')
    )
    return Springs(modes, nodes, weights, normals, ends, anchors, scalars)


def _rows(coupling: Coupling) -> Springs:
    """Return the operand for one coupling, without anchors."""
    points = coupling.points
    if points is None:
        ends = np.array([[coupling.start, coupling.end]])
        nodes, weights = coupling.nodes[None], coupling.weights[None]
        scalars = coupling.scalars[None]
    else:
        nodes, weights, ends = points.nodes, points.weights, points.ends
        scalars = np.tile(coupling.scalars, (len(nodes), 1))
        scalars[:, 0], scalars[:, 1] = points.stiffness, points.limits
    count = len(nodes)
    modes, normals = np.full(count, coupling.mode), np.tile(coupling.normal, (count, 1))
    return Springs(modes, nodes, weights, normals, ends, normals, scalars)


NO_SPRINGS = springs_of((), np.zeros((0, 3)))


def held_nodes(couplings: Sequence[Coupling]) -> np.ndarray:
    """Return the nodes that tools load, with repeats, shape (c,)."""
    return np.concatenate([np.zeros(0, np.int64), *(coupling.nodes for coupling in couplings)])


class Tool(Protocol):
    """The tool within a frame: each part of the frame has its own spring.

    Attributes:
        parts: of a frame.
    """

    parts: int

    def restart(self) -> Coupling:
        """Return to the begin of the frame, and the spring of its first part."""

    def after(self, share: float, positions: np.ndarray) -> Coupling:
        """Return the spring of the next part.

        Args:
            share: of the frame that has passed.
            positions: nodes now [m], shape (n, 3).
        """


@kernel
def normal_force(stretch, scalars):
    """Return the force of a spring against a footprint at a normal stretch [N].

    Args:
        stretch: 0 or more [m].
        scalars: see `Coupling.scalars`, with `hertz` above 0.
    """
    if stretch <= 0.0:
        return 0.0
    hertz, bend, straight = scalars[2], scalars[3], scalars[5]
    if stretch >= scalars[6] and np.isfinite(straight):
        return straight + scalars[7] * (stretch - scalars[6])
    # Newton's method for the cube root of the force, kept between two bounds.
    linear, low, high = 1.0 / scalars[0] - scalars[4], 0.0, np.sqrt(stretch / hertz)
    if linear < 0.0:
        high = np.cbrt(straight)
    root = min(np.sqrt(stretch / hertz), high)
    for _ in range(60):
        square = root * root
        value = linear * square * root + hertz * square * (1.0 + bend * square) - stretch
        if value > 0.0:
            high = root
        else:
            low = root
        slope = root * (3.0 * linear * root + hertz * (2.0 + 4.0 * bend * square))
        after = root - value / slope
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - root) <= 1e-13 * root:
            break
        root = after
    return root * root * root


@inner
def held_by(stretch, stiffness, limit):
    """Return the force over the stretch of a spring that yields at its limit [N/m]."""
    length = np.sqrt(stretch[0] ** 2 + stretch[1] ** 2 + stretch[2] ** 2)
    return limit / length if stiffness * length > limit else stiffness


@kernel
def spring_force(mode, stretch, normal, scalars, out):
    """Compute the force of the spring on the tissue.

    Args:
        mode: FREE, PUSH or HOLD.
        stretch: tool's end minus tissue's end [m], shape (3,).
        normal: outward unit normal, shape (3,).
        scalars: see `Coupling.scalars`.
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
        # Continuous where the contact opens: an abrupt release would add energy.
        if scalars[2] > 0.0:
            pushed = normal_force(-along, scalars)
            most = scalars[8] * pushed
            grip = min(stiffness, most / max(np.sqrt(across), 1e-300))
            for i in range(3):
                out[i] = grip * out[i] - pushed * normal[i]
            return
        grip = min(1.0, -scalars[8] * along / max(np.sqrt(across), 1e-300))
        for i in range(3):
            out[i] = stiffness * (along * normal[i] + grip * out[i])
    elif mode == HOLD:
        size = held_by(stretch, stiffness, limit)
        for i in range(3):
            out[i] = size * stretch[i]


@inner
def spring_stretch(nodes, weights, ends, anchors, tool, at, u, stretch):
    """Compute the tool's end minus the tissue's end.

    Args:
        nodes, weights, ends, anchors: see `Springs`.
        tool: which one.
        at: elapsed share of the frame.
        u: displacement by coordinate [m], shape (3 n,).
        stretch: output [m], shape (3,).
    """
    for i in range(3):
        stretch[i] = ends[tool, 0, i] + at * (ends[tool, 1, i] - ends[tool, 0, i])
        stretch[i] -= anchors[tool, i]
        for c in range(nodes.shape[1]):
            stretch[i] -= weights[tool, c] * u[3 * nodes[tool, c] + i]


# The loops take the arrays out of the tuple once: Numba counts references for each that is taken.


@inner
def forces_of_springs(springs, at, u, out):
    """Compute the forces of the springs on the tissue.

    Args:
        springs: see `Springs`.
        at: elapsed share of the frame.
        u: displacement by coordinate [m], shape (3 n,).
        out: [N], shape (t, 3).
    """
    nodes, weights, ends, anchors = springs.nodes, springs.weights, springs.ends, springs.anchors
    modes, normals, scalars, stretch = springs.modes, springs.normals, springs.scalars, np.empty(3)
    for tool in range(modes.shape[0]):
        spring_stretch(nodes, weights, ends, anchors, tool, at, u, stretch)
        if modes[tool] == HOLD:
            size = held_by(stretch, scalars[tool, 0], scalars[tool, 1])
            for i in range(3):
                out[tool, i] = size * stretch[i]
        else:
            spring_force(modes[tool], stretch, normals[tool], scalars[tool], out[tool])


@inner
def subtract_springs(springs, at, u, f, out):
    """Subtract the springs' forces on the tissue from the elastic force.

    Args:
        f: elastic force [N], shape (3 n,).
        springs, at, u, out: as for `forces_of_springs`.
    """
    forces_of_springs(springs, at, u, out)
    nodes, weights = springs.nodes, springs.weights
    for tool in range(nodes.shape[0]):
        for c in range(nodes.shape[1]):
            for i in range(3):
                f[3 * nodes[tool, c] + i] -= weights[tool, c] * out[tool, i]


@inner
def work_of_springs(springs, forces, u, last):
    """Return the work on the tissue since the last call, by the trapezoidal rule [J].

    Args:
        springs: see `Springs`.
        forces: on the tissue now [N], shape (t, 3).
        u: displacement by coordinate [m], shape (3 n,).
        last: forces [N] and positions [m] of the tissue's ends at the last call; updated, shape
            (t, 2, 3).
    """
    work, nodes, weights = 0.0, springs.nodes, springs.weights
    for tool in range(nodes.shape[0]):
        for i in range(3):
            place = 0.0
            for c in range(nodes.shape[1]):
                place += weights[tool, c] * u[3 * nodes[tool, c] + i]
            way = place - last[tool, 1, i]
            work += 0.5 * (forces[tool, i] + last[tool, 0, i]) * way
            last[tool, 0, i] = forces[tool, i]
            last[tool, 1, i] = place
    return work


@inner
def start_of_work(springs, u, last):
    """Initialise `last` with the present positions and zero force; return 0 J."""
    forces = np.zeros((springs.modes.shape[0], 3))
    work_of_springs(springs, forces, u, last)
    return 0.0
