"""The blade in the tissue: a spring with a yield force, so that what is cut has been paid for.

The edge that the simulation holds lags behind the device's edge. The spring between them loads the
tissue along the immersed length. It yields where its force reaches the resistance
J L sin(edge, motion) + friction: the edge then slips through the tissue, and the work of that slip
is toughness times the area it sweeps. L is the length with uncut tissue ahead: where the blade goes
along a cut, it pays friction alone (docs/method.md).
"""

from dataclasses import dataclass

import numpy as np

from tissue_sim.coupling import HOLD, Coupling
from tissue_sim.fracture import THICKNESS, Fracture, count_fresh, cut_normal
from tissue_sim.locate import locate_points
from tissue_sim.mesh import TetMesh, tetrahedron_volumes

_SAMPLES = 48
_LEAST_AREA = 1e-8
_AHEAD = 1e-4
"""[m] ahead of the edge, where it is asked whether the tissue is cut."""
_ENOUGH = 20000
"""Elements that a median is taken of."""
_MOST_STEPS = 32
_MOST_SLIPS = 8
_SETTLED = 1.01
"""Force over resistance at which the blade is taken to rest."""


@dataclass(frozen=True)
class Sweep:
    """The blade's edge before and after a step, in the deformed tissue [m], each shape (3,)."""

    root_from: np.ndarray
    tip_from: np.ndarray
    root_to: np.ndarray
    tip_to: np.ndarray

    @property
    def area(self) -> float:
        """Area of the two triangles between the edges [m^2]."""
        a, b, c, d = self.root_from, self.tip_from, self.tip_to, self.root_to
        first = np.linalg.norm(np.cross(b - a, c - a))
        return float(first + np.linalg.norm(np.cross(c - a, d - a))) / 2


@dataclass(frozen=True)
class Resistance:
    """What the tissue sets against the blade.

    Attributes:
        threshold: contact force that lets the blade in [N] (thesis 5.1).
        toughness: fracture toughness J [J/m^2].
        friction: by immersed length [N/m].
    """

    threshold: float
    toughness: float
    friction: float

    def force(self, length: float, fresh: float, edge: np.ndarray, motion: np.ndarray) -> float:
        """The largest force that the blade transmits [N].

        Args:
            length: immersed [m].
            fresh: the part of it with uncut tissue ahead [m].
            edge: vector along the edge, shape (3,).
            motion: vector along which the blade is pulled, shape (3,).
        """
        sizes = np.linalg.norm(edge) * np.linalg.norm(motion)
        sine = np.linalg.norm(np.cross(edge, motion)) / sizes if sizes > 0 else 0.0
        return float(fresh * self.toughness * sine + length * self.friction)


class Blade:
    """The edge in the tissue, from the frame that lets it in to the frame that it leaves.

    Args:
        resistance: of the tissue.
        root, tip: the device's edge [m], shape (3,).
        entry: point of the surface where the tip goes in [m], shape (3,).
        hint: a tetrahedron near the entry.
    """

    def __init__(
        self,
        resistance: Resistance,
        root: np.ndarray,
        tip: np.ndarray,
        entry: np.ndarray,
        hint: int,
    ) -> None:
        self._resistance = resistance
        self._edge = root - tip
        self._tip = entry.copy()
        self._device_tip = tip.copy()
        self._cut_tip = self._tip.copy()
        self._cut_edge = self._edge.copy()
        self._hint = hint
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray | None] = (
            np.zeros(3),
            self._cut_edge,
            None,
        )
        self._coupling = Coupling()
        self._center = entry
        self._fracture = Fracture()
        self._points = np.zeros((0, 3))
        self._cuts = np.zeros((0, 3, 3))
        self._element = 0.0
        self._back: np.ndarray | None = None
        self._failed = self._set_back = False
        self.immersed = 0.0
        self.limit = 0.0

    def couple(
        self,
        mesh: TetMesh,
        positions: np.ndarray,
        root: np.ndarray,
        tip: np.ndarray,
        stiffness: float,
    ) -> Coupling:
        """Takes the device's edge and lays the spring for one frame.

        Args:
            mesh: the tissue.
            positions: current nodes [m], shape (n, 3).
            root, tip: the device's edge [m], shape (3,).
            stiffness: of the spring [N/m].

        Returns:
            The spring; free where no part of the edge is in the tissue.
        """
        self._edge = root - tip
        if self._element == 0.0:
            some = mesh.tetrahedra[:: 1 + len(mesh.tetrahedra) // _ENOUGH]
            volumes = tetrahedron_volumes(mesh.rest, some)
            self._element = 2 * float(np.cbrt(np.median(volumes)))
        start = self._device_tip
        self._device_tip = tip.copy()
        nodes, weights, count = self._immerse(mesh, positions)
        if count == 0:
            # Nothing holds it: it goes with the device, in this very frame.
            self._tip = tip.copy()
            start = tip
            self._fracture.forget()
            nodes, weights, count = self._immerse(mesh, positions)
        self.immersed = count / _SAMPLES * float(np.linalg.norm(self._edge))
        if count > 0:
            ends = np.concatenate([self._points, self._points + tip - self._tip])
            self._cuts = self._fracture.near(mesh, positions, ends)
            if self._slide(tip - self._tip, stiffness):
                start = tip
                nodes, weights, count = self._immerse(mesh, positions)
        self.immersed = count / _SAMPLES * float(np.linalg.norm(self._edge))
        pull = tip - self._tip
        self.limit, _ = self._resist(pull)
        if count == 0:
            self._coupling = Coupling()
            return self._coupling
        self._center = weights @ positions[nodes]
        self._coupling = Coupling(
            mode=HOLD,
            nodes=nodes,
            weights=weights,
            start=self._center + start - self._tip,
            end=self._center + pull,
            stiffness=stiffness,
            limit=self.limit,
        )
        return self._coupling

    def _immerse(self, mesh: TetMesh, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        shares = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        points = self._tip + shares[:, None] * self._edge
        found = np.empty(_SAMPLES, np.int64)
        weights = np.empty((_SAMPLES, 4))
        locate_points(
            positions, mesh.tetrahedra, mesh.neighbors, points, self._hint, found, weights
        )
        inside = found >= 0
        self._points = points[inside]
        count = len(self._points)
        if count == 0:
            return np.zeros(0, np.int64), np.zeros(0), 0
        self._hint = int(found[inside][0])
        corners = mesh.tetrahedra[found[inside]].ravel()
        nodes, slots = np.unique(corners, return_inverse=True)
        summed = np.bincount(slots, weights[inside].ravel(), len(nodes)) / count
        return nodes.astype(np.int64), summed, count

    def _slide(self, pull: np.ndarray, stiffness: float) -> bool:
        """Lets the edge go along the cut that it is in, up to where the tissue is uncut.

        Across the cut it stays: its sides guide the blade.
        """
        normal = cut_normal(self._points, self._cuts, THICKNESS / 2)
        along = pull - (pull @ normal) * normal
        length = float(np.linalg.norm(along))
        held = self._resistance.force(self.immersed, 0.0, self._edge, along) / stiffness
        if not normal.any() or length <= held:
            return False
        motion = along / length
        steps = min(int(np.ceil(length / _AHEAD)), _MOST_STEPS)
        slid = 0.0
        for way in np.linspace(0.0, length - held, steps + 1)[1:]:
            if self._fresh(motion, slid + _AHEAD):
                break
            slid = float(way)
        if slid == 0.0:
            return False
        self._tip = self._tip + slid * motion
        self._fracture.leave()
        return True

    def _fresh(self, motion: np.ndarray, ahead: float) -> int:
        """How many of the points in the tissue would cut it, so far ahead [m]."""
        if len(self._cuts) == 0:
            return len(self._points)
        return count_fresh(self._points, ahead * motion, motion, self._cuts, THICKNESS / 2)

    def _resist(self, pull: np.ndarray) -> tuple[float, bool]:
        """The largest force of the spring [N], and whether the tissue is cut beyond it."""
        count, length = len(self._points), float(np.linalg.norm(pull))
        fresh = self._fresh(pull / length, _AHEAD) if count and length > 0 else count
        uncut = self.immersed * fresh / max(count, 1)
        return self._resistance.force(self.immersed, uncut, self._edge, pull), fresh > 0

    def yield_after(self, mesh: TetMesh, positions: np.ndarray) -> None:
        """Carries the edge with the tissue; lets it slip where the spring exceeds the resistance.

        Args:
            positions: nodes at the end of the frame [m], shape (n, 3).
        """
        spring = self._coupling
        if spring.mode != HOLD:
            self._tip = self._device_tip.copy()
            self._fracture.forget()
            return
        carried = spring.point(positions) - self._center
        self._tip = self._tip + carried
        self._cut_tip = self._cut_tip + carried
        self._fracture.carry(carried)
        for _ in range(_MOST_SLIPS):
            *_, count = self._immerse(mesh, positions)
            self.immersed = count / _SAMPLES * float(np.linalg.norm(self._edge))
            if count == 0:
                return
            pull = self._device_tip - self._tip
            limit, cuts = self._resist(pull)
            force = spring.stiffness * float(np.linalg.norm(pull))
            if not cuts or force <= _SETTLED * limit:
                return
            before = self._tip
            self._tip = before + pull * (1 - limit / force)
            edges = np.array([[at + self._edge, at] for at in (before, self._tip)])
            self._fracture.add(*edges)

    def sweep(self) -> Sweep | None:
        """What the edge has swept since `swept` was last called; None: next to nothing."""
        sweep = Sweep(
            self._cut_tip + self._cut_edge, self._cut_tip, self._tip + self._edge, self._tip
        )
        return sweep if sweep.area > _LEAST_AREA else None

    def swept(self) -> None:
        """Takes the present edge as the one that the next sweep starts from."""
        self._before = (self._cut_tip - self._tip, self._cut_edge, self._back)
        self._cut_tip = self._tip.copy()
        self._cut_edge = self._edge.copy()
        behind = self._fracture.behind(self._element)
        self._back = None if behind is None else behind - self._cut_tip
        self._set_back &= self._failed
        self._failed = False

    def unswept(self) -> None:
        """The last sweep was not cut: the next one starts where it did, or an element before.

        Who cuts may have forgotten the stroke, and with it the element that the edge was in, which
        is divided only when the edge has left it. Failures in a row go back so far once.
        """
        offset, self._cut_edge, self._back = self._before
        self._cut_tip = self._cut_tip + offset
        if self._back is not None and not self._set_back:
            root, tip = self._back
            self._cut_tip, self._cut_edge = self._cut_tip + tip, root - tip
            self._set_back = True
        self._failed = True
