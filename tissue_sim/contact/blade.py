"""The blade in the tissue: springs with a yield force that pays for the fracture work.

Points of the edge in the simulation lag behind those of the device's edge. The springs between them
load the tissue. A spring yields where it reaches the resistance of its piece of the edge,
J l sin(edge, motion) + friction. The point then slips through the tissue, and the work of that slip
is toughness times the swept area, whether the edge is drawn, pressed, sliced or turned. Along an
existing cut, the blade pays friction alone (docs/method.md).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import HOLD, Coupling
from cutting_trainer.tissue_sim.contact.edge import lag_behind, measure_lengths, resist
from cutting_trainer.tissue_sim.contact.fracture import (
    BLADE_THICKNESS,
    KNOTS,
    CutStrips,
)
from cutting_trainer.tissue_sim.mesh.locate import locate_points
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, tetrahedron_volumes

_SAMPLES = 48
_WHOLE = _SAMPLES / 2
"""Points in the tissue at which their springs are as stiff as the coupling: half of the edge. Each
has the same stiffness however many there are, else a spring that goes in or out would take energy
from the others or give it to them."""
_MIN_AREA = 1e-8
_AHEAD = 1e-4
"""[m] ahead of the edge, where the tissue is tested for a cut."""
_MEDIAN_SAMPLES = 20000
"""Elements in the sample for a median."""
_MAX_SLIPS = 12
_MAX_STEPS = 100
"""Places at which tissue is looked for between an edge in the air and the device's."""
_MAX_FREE_SLIP = BLADE_THICKNESS / 2
"""[m] by which the edge slips along a cut before what is ahead of it is looked up again."""
_SETTLED = 1e-6
"""[m] of slip below which the edge counts as at rest."""
_MIN_POINTS = 4
"""Points in the tissue from which on they tell the direction of the edge."""
_ONE_WAY = 0.3
"""Share of the springs' forces in their sum from which on the tissue is loaded point by point."""
_PARTS = np.arange(1, 9) / 8
"""Places of a piece at which the end of the tissue is looked for."""
_SHARES = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
_KNOTS = np.rint(np.linspace(0, _SAMPLES - 1, KNOTS)).astype(int)


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
    """Resistance of the tissue to the blade.

    Attributes:
        threshold: contact force at which the blade enters [N] (thesis 5.1).
        toughness: fracture toughness J [J/m^2].
        friction: per immersed length [N/m].
    """

    threshold: float
    toughness: float
    friction: float


class Blade:
    """The blade's edge in the tissue, from entry to exit.

    Args:
        resistance: of the tissue.
        root, tip: the device's edge [m], shape (3,).
        hint: a tetrahedron near the entry.

    Attributes:
        immersed: length of the edge in the tissue [m].
        limit: largest force that the edge transmits as it is pulled, or would as it is moved [N].
        force: of the edge on the tissue [N], shape (3,).
        torque: the same about the tip of the device's edge [N m], shape (3,).
        lag: mean distance of the edge from the device's, where it is in the tissue [m].
        paid: work of cutting since entry, toughness times swept area [J].
        rubbed: work of friction since entry [J].
    """

    def __init__(
        self, resistance: Resistance, root: np.ndarray, tip: np.ndarray, hint: int
    ) -> None:
        self._resistance = resistance
        self._device = np.array([root, tip])
        self._device_points = self._points = _points_of(self._device)
        self._moved = np.zeros((_SAMPLES, 3))
        self._tip, self._edge = tip.copy(), root - tip
        self._cut_tip, self._cut_edge = tip.copy(), root - tip
        self._hint = hint
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray | None] = (
            np.zeros(3),
            self._cut_edge,
            None,
        )
        self._inside = np.zeros(_SAMPLES, bool)
        self._corners = np.zeros((0, 4), np.int64)
        self._parts = np.zeros((0, 4))
        self._spans = np.zeros(0)
        self._fracture = CutStrips()
        self._element = 0.0
        self._grip = 0.0
        self._back: np.ndarray | None = None
        self._failed = self._set_back = False
        self.immersed = self.limit = self.lag = self.paid = self.rubbed = 0.0
        self.force, self.torque = np.zeros(3), np.zeros(3)

    @property
    def device(self) -> np.ndarray:
        """Root and tip of the device's edge [m], shape (2, 3)."""
        return self._device

    def kept(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the state for `restore`: nothing in it is changed in place."""
        return dict(vars(self)), dict(vars(self._fracture))

    def restore(self, kept: tuple[dict[str, Any], dict[str, Any]]) -> None:
        """Return to a state of `kept`."""
        vars(self).update(kept[0])
        vars(self._fracture).update(kept[1])

    def carry(self, positions: np.ndarray) -> None:
        """Move the edge with the tissue.

        The edge is rigid: tissue that slides along it takes it along by no more than friction does,
        or a hand that slices (Atkins). Else the tissue that heaps up before a blade would lift the
        edge out.

        Args:
            positions: nodes now, of the same mesh as at the last `follow` [m], shape (n, 3).
        """
        if not self._inside.any():
            return
        before = self._points[self._inside]
        carried = np.einsum('ij,ijk->ik', self._parts, positions[self._corners])
        unit, device = self._direction(), self._device_points[self._inside]
        most = self._along(device - before, unit)
        stretch = (device - carried) @ unit
        slid = stretch - np.clip(stretch, -most, most)
        self._points = self._points.copy()
        self._points[self._inside] = carried + slid[:, None] * unit
        shares = _SHARES[self._inside]
        at, along = _line(shares, carried - before)
        self._cut_tip, self._cut_edge = self._cut_tip + at, self._cut_edge + along
        ways = at + along * np.clip(_SHARES[_KNOTS], shares[0], shares[-1])[:, None]
        self._fracture.carry(ways - (ways @ unit)[:, None] * unit)

    def _along(self, stretch: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """Return the largest stretch along the edge to which tissue may take it [m], shape (p,)."""
        parts = []
        for ways in (stretch, self._moved[self._inside]):
            along = ways @ unit
            parts += [np.abs(along), np.linalg.norm(ways - along[:, None] * unit, axis=1)]
        held, pulled, sliced, pushed = parts
        sliced = np.where(pushed > 0.0, sliced / np.maximum(pushed, 1e-12), 0.0)
        return np.maximum(np.maximum(held, self._grip), sliced * pulled)

    def follow(
        self,
        mesh: TetMesh,
        positions: np.ndarray,
        device: np.ndarray,
        stiffness: float,
        opened: np.ndarray,
    ) -> None:
        """Let the edge slip after the device's edge.

        Args:
            mesh: the tissue.
            positions: current nodes [m], shape (n, 3).
            device: root and tip of the device's edge [m], shape (2, 3).
            stiffness: of the coupling [N/m].
            opened: triangles of the surface that cuts have opened, shape (c, 3).
        """
        if self._element == 0.0:
            some = mesh.tetrahedra[:: 1 + len(mesh.tetrahedra) // _MEDIAN_SAMPLES]
            volumes = tetrahedron_volumes(mesh.rest, some)
            self._element = 2 * float(np.cbrt(np.median(volumes)))
        before = self._device_points
        self._device = device.copy()
        self._device_points = _points_of(device)
        self._grip = self._resistance.friction * self._piece() / (stiffness / _WHOLE)
        self._moved = self._device_points - before
        self._points = self._lagging()
        self._immerse(mesh, positions)
        cuts, limit = np.zeros((0, 3, 3)), -1.0
        if not self._inside.any():
            self._fracture.forget()
        else:
            ends = np.concatenate([self._points, self._device_points])[np.tile(self._inside, 2)]
            cuts = self._fracture.near(positions[opened], ends)
            for _ in range(_MAX_SLIPS):
                limit = self._slip(stiffness, cuts)
                if limit >= 0.0:
                    break
                self._immerse(mesh, positions)
                if not self._inside.any():
                    break
        self._settle(stiffness, cuts, limit)

    def let_go(self) -> None:
        """Let the edge follow the device without force: nothing is known of the tool."""
        self._inside = np.zeros(_SAMPLES, bool)
        self._corners, self._parts = np.zeros((0, 4), np.int64), np.zeros((0, 4))
        self._spans = np.zeros(0)
        self._fracture.forget()
        self._settle(0.0, np.zeros((0, 3, 3)), 0.0)

    def spring(
        self, positions: np.ndarray, ahead: np.ndarray, share: float, stiffness: float
    ) -> Coupling:
        """Return the spring until the next `follow`; free where no edge is in the tissue.

        Args:
            positions: current nodes [m], shape (n, 3).
            ahead: root and tip of the device's edge at the end of the frame [m], shape (2, 3).
            share: of the frame that has passed.
            stiffness: of the coupling [N/m].
        """
        count = len(self._corners)
        if count == 0:
            return Coupling()
        forces = self._spans * (self._stretch() @ self.force)
        loads = self._spans / self._spans.sum()
        if self.force @ self.force > 0.0 and forces.sum() > _ONE_WAY * np.abs(forces).sum():
            loads = forces / forces.sum()
        nodes, slots = np.unique(self._corners, return_inverse=True)
        weights = np.bincount(slots.ravel(), (loads[:, None] * self._parts).ravel(), len(nodes))
        middle = float(_SHARES[self._inside].mean())
        moved = (1 - middle) * (ahead[1] - self._device[1]) + middle * (ahead[0] - self._device[0])
        rate = moved / (1 - share) if share < 1 else np.zeros(3)
        whole = stiffness * float(self._spans.sum()) / _WHOLE
        at = weights @ positions[nodes] + self.force / whole
        return Coupling(
            mode=HOLD,
            nodes=nodes.astype(np.int64),
            weights=weights,
            start=at - share * rate,
            end=at + moved,
            stiffness=whole,
            limit=self.limit,
        )

    def _stretch(self) -> np.ndarray:
        """Return from the edge to the device's edge at each point in the tissue [m], (p, 3)."""
        return np.asarray((self._device_points - self._points)[self._inside])

    def _immerse(self, mesh: TetMesh, positions: np.ndarray) -> None:
        """Find the points in the tissue. Those in the air go with them: the edge is rigid.

        Where a cut gapes so far that all are in the air, the edge goes on to the tissue before it,
        which has still to be cut, or else to the device's.
        """
        before = np.full(_SAMPLES, 0.5)
        before[self._inside] = self._spans
        found, parts = self._locate(mesh, positions, self._points)
        lost = self._inside & (found < 0)
        if (found < 0).all():
            self._points = self._before_tissue(mesh, positions)
            found, parts = self._locate(mesh, positions, self._points)
        elif lost.any():
            self._inside = found >= 0
            self._points = np.where(lost[:, None], self._lagging(), self._points)
            found, parts = self._locate(mesh, positions, self._points)
        self._inside = found >= 0
        self._corners = mesh.tetrahedra[found[self._inside]].astype(np.int64)
        self._parts = parts[self._inside]
        if len(self._corners):
            self._hint = int(found[self._inside][0])
        piece = (self._device[0] - self._device[1]) / _SAMPLES
        tets, neighbors = mesh.tetrahedra, mesh.neighbors
        lengths = measure_lengths(
            positions, tets, neighbors, self._points, self._inside, piece, _PARTS, self._hint
        )
        self._spans = lengths[self._inside]
        grown = np.where(self._inside, np.sqrt(before / np.maximum(lengths, 1e-12)), 1.0)
        self._relax(mesh, positions, grown)

    def _lagging(self) -> np.ndarray:
        """Return the points, with those in the air as far behind as the nearest in the tissue."""
        points = lag_behind(self._device_points, self._points, self._inside, _SHARES)
        return np.asarray(points)

    def _locate(
        self, mesh: TetMesh, positions: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the tetrahedron of each point or -1, and the barycentric coordinates in it."""
        found, parts = np.empty(len(points), np.int64), np.empty((len(points), 4))
        locate_points(positions, mesh.tetrahedra, mesh.neighbors, points, self._hint, found, parts)
        return found, parts

    def _before_tissue(self, mesh: TetMesh, positions: np.ndarray) -> np.ndarray:
        """Return an edge in the air where it meets tissue on its way to the device's [m]."""
        device = self._device_points
        ways = device - self._points
        longest = float(np.linalg.norm(ways, axis=1).max())
        steps = min(int(np.ceil(longest / (BLADE_THICKNESS / 2))), _MAX_STEPS)
        if steps == 0:
            return device
        shares = np.arange(1, steps + 1) / steps
        on_way = device - (1 - shares)[:, None, None] * ways
        found, _ = self._locate(mesh, positions, on_way.reshape(-1, 3))
        meets = (found >= 0).reshape(steps, -1).any(axis=1)
        return np.asarray(on_way[int(meets.argmax())] if meets.any() else device)

    def _relax(self, mesh: TetMesh, positions: np.ndarray, grown: np.ndarray) -> None:
        """Spread the energy of points over the edge that has come into the tissue beside them.

        Args:
            mesh, positions: as for `follow`.
            grown: root of the length that a point stood for over that it stands for now, (48,).
        """
        stretch = self._device_points - self._points
        at = np.flatnonzero((grown < 1) & (np.abs(stretch).max(axis=1) > _SETTLED))
        if not len(at):
            return
        points = self._points[at] + (1 - grown[at])[:, None] * stretch[at]
        found, parts = self._locate(mesh, positions, points)
        at, found, parts, points = (x[found >= 0] for x in (at, found, parts, points))
        slots = np.cumsum(self._inside)[at] - 1
        self._points = self._points.copy()
        self._points[at] = points
        self._corners[slots], self._parts[slots] = mesh.tetrahedra[found], parts

    def _knots(self) -> np.ndarray:
        """Return some points of the edge [m], shape (KNOTS, 3)."""
        knots, half = self._lagging()[_KNOTS], (self._device[0] - self._device[1]) / _SAMPLES / 2
        knots[0] -= half
        knots[-1] += half
        return knots

    def _piece(self) -> float:
        """Return the length of the edge that a point stands for [m]."""
        return float(np.linalg.norm(self._device[0] - self._device[1])) / _SAMPLES

    def _direction(self) -> np.ndarray:
        edge = self._device[0] - self._device[1]
        return np.asarray(edge / np.linalg.norm(edge))

    def _slip(self, stiffness: float, cuts: np.ndarray) -> float:
        """Let the points slip whose springs exceed the resistance.

        Returns:
            The largest force that the edge transmits as it is pulled [N]; -1 where a point slipped.
        """
        ways, each = self._stretch(), stiffness / _WHOLE * self._spans
        pieces = self._piece() * self._spans
        fresh, limits = self._resist(ways, cuts, pieces)
        sizes = np.maximum(np.linalg.norm(ways, axis=1), 1e-300)
        slid = np.maximum(sizes - limits / each, 0.0)
        slid = np.where(fresh == 0, np.minimum(slid, _MAX_FREE_SLIP), slid)
        if slid.max() < _SETTLED:
            return float(limits.sum())
        ways *= (slid / sizes)[:, None]
        rub = self._resistance.friction * float(pieces @ slid)
        self.paid += float(limits @ slid) - rub
        self.rubbed += rub
        cutting = bool((slid[fresh == 1] > _SETTLED).any())
        before = self._knots() if cutting else self._points
        self._points = self._points.copy()
        self._points[self._inside] += ways
        self._points = self._lagging()
        if cutting:
            self._fracture.add(before, self._knots())
        else:
            self._fracture.leave()
        return -1.0

    def _resist(
        self, ways: np.ndarray, cuts: np.ndarray, pieces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the results of `resist` for the points in the tissue."""
        toughness, friction = self._resistance.toughness, self._resistance.friction
        points, edge = self._points[self._inside], self._direction()
        reach = BLADE_THICKNESS / 2
        found: tuple[np.ndarray, np.ndarray] = resist(
            points, ways, cuts, pieces, edge, toughness, friction, reach, _AHEAD
        )
        return found

    def _settle(self, stiffness: float, cuts: np.ndarray, limit: float) -> None:
        """Update the output: force, torque, limit, and the edge as a line.

        Args:
            stiffness: of the coupling [N/m].
            cuts: triangles of cuts near the edge [m], shape (t, 3, 3).
            limit: largest force as the edge is pulled now [N]; negative: unknown.
        """
        self.force, self.torque, self.limit, self.lag = np.zeros(3), np.zeros(3), 0.0, 0.0
        count = len(self._corners)
        pieces = self._piece() * self._spans
        self.immersed = float(pieces.sum())
        root, self._tip = self._device
        self._edge = root - self._tip
        if count == 0:
            return
        stretch, shares = self._stretch(), _SHARES[self._inside]
        pulls = stiffness / _WHOLE * self._spans[:, None] * stretch
        self.force = pulls.sum(axis=0)
        self.torque = np.cross(shares[:, None] * self._edge, pulls).sum(axis=0)
        self.lag = float(np.linalg.norm(stretch.mean(axis=0)))
        # As it is pulled now, or will be if the device moves on.
        if limit < 0.0:
            limit = float(self._resist(stretch.copy(), cuts, pieces)[1].sum())
        moved = self._resist(self._moved[self._inside], cuts, pieces)[1]
        self.limit = max(limit, float(moved.sum()))
        if count < _MIN_POINTS:
            self._tip = self._tip - stretch.mean(axis=0)
        else:
            at, along = _line(shares, stretch)
            self._tip, self._edge = self._tip - at, self._edge - along

    def sweep(self) -> Sweep | None:
        """Return the sweep of the edge since the last `confirm_sweep`; None if it is negligible."""
        sweep = Sweep(
            self._cut_tip + self._cut_edge, self._cut_tip, self._tip + self._edge, self._tip
        )
        return sweep if sweep.area > _MIN_AREA else None

    def confirm_sweep(self) -> None:
        """Start the next sweep from the present edge."""
        self._before = (self._cut_tip - self._tip, self._cut_edge, self._back)
        self._cut_tip = self._tip.copy()
        self._cut_edge = self._edge.copy()
        behind = self._fracture.behind(self._element)
        self._back = None if behind is None else behind - self._cut_tip
        self._set_back &= self._failed
        self._failed = False

    def retry_sweep(self) -> None:
        """Start the next sweep where the last one, which was not cut, started, or an element
        earlier.

        The cutting service may have lost the stroke, and with it the element around the edge, which
        is divided only after the edge has left it. Repeated failures extend the sweep only once.
        """
        offset, self._cut_edge, self._back = self._before
        self._cut_tip = self._cut_tip + offset
        if self._back is not None and not self._set_back:
            root, tip = self._back
            self._cut_tip, self._cut_edge = self._cut_tip + tip, root - tip
            self._set_back = True
        self._failed = True


def _points_of(device: np.ndarray) -> np.ndarray:
    """Return points of an edge, given by root and tip [m], shape (48, 3)."""
    root, tip = device
    return np.asarray(tip + _SHARES[:, None] * (root - tip))


def _line(shares: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the line a + s b nearest to values at shares s; level where they are too few.

    Args:
        shares: shape (p,).
        values: shape (p, 3).
    """
    mean, arms = values.mean(axis=0), shares - shares.mean()
    if len(shares) < _MIN_POINTS:
        return mean, np.zeros(3)
    along = arms @ values / float(arms @ arms)
    return mean - float(shares.mean()) * along, along
