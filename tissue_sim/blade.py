"""The blade in the tissue: a spring with a yield force, so that what is cut has been paid for.

The edge that the simulation holds lags behind the device's edge. The spring between them loads the
tissue along the immersed length. It yields where its force reaches the resistance
J L sin(edge, motion) + friction: the edge then slips through the tissue, and the work of that slip
is toughness times the area it sweeps (docs/method.md).
"""

from dataclasses import dataclass

import numpy as np

from tissue_sim.coupling import HOLD, Coupling
from tissue_sim.locate import locate_points
from tissue_sim.mesh import TetMesh

_SAMPLES = 48
_LEAST_AREA = 1e-8


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

    def force(self, length: float, edge: np.ndarray, motion: np.ndarray) -> float:
        """The largest force that the blade transmits [N].

        Args:
            length: immersed [m].
            edge: vector along the edge, shape (3,).
            motion: vector along which the blade is pulled, shape (3,).
        """
        sizes = np.linalg.norm(edge) * np.linalg.norm(motion)
        sine = np.linalg.norm(np.cross(edge, motion)) / sizes if sizes > 0 else 0.0
        return float(length * (self.toughness * sine + self.friction))


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
        self._before = (np.zeros(3), self._cut_edge)
        self._coupling = Coupling()
        self._center = entry
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
        nodes, weights, count = self._immerse(mesh, positions)
        self.immersed = count / _SAMPLES * float(np.linalg.norm(self._edge))
        pull = tip - self._tip
        self.limit = self._resistance.force(self.immersed, self._edge, pull)
        if count == 0:
            self._coupling = Coupling()
            self._device_tip = tip.copy()
            return self._coupling
        self._center = weights @ positions[nodes]
        self._coupling = Coupling(
            mode=HOLD,
            nodes=nodes,
            weights=weights,
            start=self._center + self._device_tip - self._tip,
            end=self._center + pull,
            stiffness=stiffness,
            limit=self.limit,
        )
        self._device_tip = tip.copy()
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
        count = int(inside.sum())
        if count == 0:
            return np.zeros(0, np.int64), np.zeros(0), 0
        self._hint = int(found[inside][0])
        corners = mesh.tetrahedra[found[inside]].ravel()
        nodes, slots = np.unique(corners, return_inverse=True)
        summed = np.bincount(slots, weights[inside].ravel(), len(nodes)) / count
        return nodes.astype(np.int64), summed, count

    def yield_after(self, positions: np.ndarray) -> None:
        """Carries the edge with the tissue; lets it slip where the spring exceeds the resistance.

        Args:
            positions: nodes at the end of the frame [m], shape (n, 3).
        """
        spring = self._coupling
        if spring.mode == HOLD:
            carried = spring.point(positions) - self._center
            self._tip = self._tip + carried
            self._cut_tip = self._cut_tip + carried
        pull = self._device_tip - self._tip
        force = spring.stiffness * float(np.linalg.norm(pull))
        if spring.mode != HOLD:
            self._tip = self._tip + pull
        elif force > self.limit:
            self._tip = self._tip + pull * (1 - self.limit / force)

    def sweep(self) -> Sweep | None:
        """What the edge has swept since `swept` was last called; None: next to nothing."""
        sweep = Sweep(
            self._cut_tip + self._cut_edge, self._cut_tip, self._tip + self._edge, self._tip
        )
        return sweep if sweep.area > _LEAST_AREA else None

    def swept(self) -> None:
        """Takes the present edge as the one that the next sweep starts from."""
        self._before = (self._cut_tip - self._tip, self._cut_edge)
        self._cut_tip = self._tip.copy()
        self._cut_edge = self._edge.copy()

    def unswept(self) -> None:
        """The last sweep was not cut: the next one starts where it did."""
        self._cut_tip = self._cut_tip + self._before[0]
        self._cut_edge = self._before[1]
