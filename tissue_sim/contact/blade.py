"""The blade in the tissue: springs with a yield force that pays for the fracture work.

Points of the edge in the simulation lag behind those of the device's edge. The springs between them
load the tissue. A spring yields where it reaches the resistance of its piece of the edge,
J l sin(edge, motion) + friction. The point then slips through the tissue, and the work of that slip
is toughness times the swept area, whether the edge is drawn, pressed, sliced or turned. Along an
existing cut, the blade pays friction alone (docs/method.md).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.contact.anchor import Anchor, anchor_of
from cutting_trainer.tissue_sim.contact.blade_law import (
    WHOLE,
    Pull,
    carry_edge,
    follow_device,
    gather_loads,
    no_pull,
)
from cutting_trainer.tissue_sim.contact.coupling import HOLD, Coupling, PointSprings
from cutting_trainer.tissue_sim.contact.facing import BLADE_HEIGHT, Law
from cutting_trainer.tissue_sim.contact.fracture import BLADE_THICKNESS, Strips
from cutting_trainer.tissue_sim.contact.immersion import POINTS, SHARES, Edge, Tissue
from cutting_trainer.tissue_sim.mesh.locate import NearElements, locate_points
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, tetrahedron_volumes

_MIN_AREA = 1e-8
_MIN_WAY = 1e-12
_MIN_ACROSS = 0.3
"""Motion across the edge, as a share of all motion, from which on a sweep has a direction."""
_MIN_FIRST = 0.15
"""Motion across the edge from which on the first sweep has one, in sizes of an element: the cut is
led on behind it."""
_MEDIAN_SAMPLES = 20000
"""Elements in the sample for a median."""


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
        tip_width: of the slit that the tip opens [m]; 0: the blade enters by `threshold`, and its
            tip resists by nothing.
        regions: toughness and friction of regions 1, 2, ... of the mesh; region 0 has those above.
        crack_length: by which a crack goes on at once [m]; 0: steadily.
    """

    threshold: float
    toughness: float
    friction: float
    tip_width: float = 0.0
    regions: tuple[tuple[float, float], ...] = ()
    crack_length: float = 0.0


class Turning(NamedTuple):
    """Resistance of the tissue to turning a tool.

    Attributes:
        torque: of the tissue on the tool about the tip of its blade [N m], shape (3,).
        resistance: largest torque that the blade transmits [N m].
        immersed: mean and mean square of the places along the blade, from 0 at its tip to 1 at its
            root, that are in the tissue, shape (2,).
    """

    torque: np.ndarray
    resistance: float
    immersed: np.ndarray


NOT_TURNED = Turning(np.zeros(3), 0.0, np.zeros(2))


class Blade:
    """The blade's edge in the tissue, from entry to exit.

    Args:
        resistance: of the tissue.
        root, tip: the device's edge [m], shape (3,).
        hint: a tetrahedron near the entry.
        line_compliance: of the tissue, see `Material.line_compliance` [m^2/N].

    Attributes:
        immersed: length of the edge in the tissue [m].
        limit: largest force that the edge transmits as it is pulled, or would as it is moved [N].
        force: of the edge on the tissue [N], shape (3,).
        turning: force and limit as a torque about the tip of the device's edge.
        lag: mean distance of the edge from the device's, where it is in the tissue [m].
        paid: work of cutting since entry, toughness times swept area [J].
        rubbed: work of friction since entry [J].
    """

    _renumbered, _begun = False, True  # a state of before may lack them

    def __init__(
        self,
        resistance: Resistance,
        root: np.ndarray,
        tip: np.ndarray,
        hint: int,
        line_compliance: float = 0.0,
    ) -> None:
        r = resistance
        toughness, friction = np.array([(r.toughness, r.friction), *r.regions]).T.copy()
        spine = float(line_compliance * np.log(BLADE_HEIGHT / BLADE_THICKNESS))
        at_tip = toughness * r.tip_width
        self._law = Law(
            1.0, toughness, friction, np.zeros(3), spine, at_tip, r.crack_length, np.zeros((3, 3))
        )
        self._device = np.array([root, tip])
        self._moved = np.zeros((POINTS, 3))
        self._state = Edge(
            points_of(self._device),
            np.zeros((POINTS, 4), np.int64),
            np.zeros((POINTS, 4)),
            np.zeros(POINTS),
            np.array([hint]),
            np.zeros(POINTS, np.int64),
            np.zeros(2),
        )
        self._strips = Strips.empty()
        self._tip, self._edge = tip.copy(), root - tip
        self._cut_tip, self._cut_edge = tip.copy(), root - tip
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray | None] = (
            np.zeros(3),
            self._cut_edge,
            None,
        )
        self._element = 0.0
        self._back: np.ndarray | None = None
        self._from: Anchor | None = None
        self._to: Anchor | None = None
        self._failed = self._set_back = self._begun = False
        self.paid = self.rubbed = self._swept = 0.0
        self._settle(no_pull())

    @property
    def device(self) -> np.ndarray:
        """Root and tip of the device's edge [m], shape (2, 3)."""
        return self._device

    @property
    def stretch(self) -> np.ndarray:
        """From the edge to the device's edge, at the points in the tissue [m], shape (p, 3)."""
        return self._stretch()[self._state.spans > 0.0]

    def note_stiffness(self, stiffness: np.ndarray) -> None:
        """Note the stiffness of tissue and coupling at the edge [N/m], shape (3, 3)."""
        self._law = self._law._replace(rigidity=stiffness)

    def kept(self) -> dict[str, Any]:
        """Return the state for `restore`."""
        kept = dict(vars(self))
        kept['_state'] = Edge(*(values.copy() for values in self._state))
        kept['_strips'] = Strips(*(values.copy() for values in self._strips))
        return kept

    def restore(self, kept: dict[str, Any]) -> None:
        """Return to a state of `kept`, which stays as it is."""
        vars(self).update(kept)
        vars(self).update(self.kept())

    def carry(self, positions: np.ndarray) -> None:
        """Move the edge with the tissue (see `carry_edge`), and the last sweep of one that left.

        Args:
            positions: nodes now, of the same mesh as at the last `follow` [m], shape (n, 3).
        """
        moved = np.zeros((2, 3))
        if self._to is not None:
            moved, self._to = self._to.carried(positions)
            self._tip, self._edge = self._tip + moved[0], self._edge + moved[1]
        elif self._state.spans.any():
            device = points_of(self._device)
            moved, rubbed = carry_edge(
                self._state, self._strips, device, self._moved, positions, self._law
            )
            self.rubbed += float(rubbed)
        if self._from is not None:
            moved, self._from = self._from.carried(positions)
        self._cut_tip, self._cut_edge = self._cut_tip + moved[0], self._cut_edge + moved[1]

    def tie(self, mesh: TetMesh, near: NearElements, positions: np.ndarray) -> None:
        """Tie the edge from which the next sweep starts to the tissue, unless it is: sweeps join in
        it.

        Args:
            mesh: the tissue.
            near: its tetrahedra.
            positions: nodes now [m], shape (n, 3).
        """
        if self._from is not None:
            return
        points = points_of(np.array([self._cut_tip + self._cut_edge, self._cut_tip]))
        among = near.find(positions, points.min(axis=0), points.max(axis=0))
        found, weights = np.empty(POINTS, np.int64), np.empty((POINTS, 4))
        tets, hint = mesh.tetrahedra, self._state.hint[0]
        locate_points(positions, tets, mesh.neighbors, among, points, hint, found, weights)
        inside = found >= 0
        if inside.any():
            corners = tets[found[inside]].astype(np.int64)
            self._from = Anchor(corners, weights[inside], points[inside], SHARES[inside])

    def follow(
        self,
        mesh: TetMesh,
        near: NearElements,
        opened: np.ndarray,
        positions: np.ndarray,
        device: np.ndarray,
        moved: np.ndarray,
        stiffness: float,
        facing: np.ndarray,
    ) -> None:
        """Let the edge slip after the device's edge.

        Args:
            mesh: the tissue.
            near: its tetrahedra.
            opened: triangles of the surface that cuts have opened, shape (c, 3).
            positions: current nodes [m], shape (n, 3).
            device: root and tip of the device's edge [m], shape (2, 3).
            moved: their motion [m], shape (2, 3).
            stiffness: of the coupling [N/m].
            facing: see `ToolContact.blade_facing`.
        """
        if self._element == 0.0:
            some = mesh.tetrahedra[:: 1 + len(mesh.tetrahedra) // _MEDIAN_SAMPLES]
            volumes = tetrahedron_volumes(mesh.rest, some)
            self._element = 2 * float(np.cbrt(np.median(volumes)))
        before, anchor = self._device, self._anchor()
        self._device, self._moved = device.copy(), points_of(moved)
        self._law = self._law._replace(stiffness=stiffness / WHOLE, facing=facing)
        points, edge = points_of(device), self._state.points
        # No point gets farther from the device's than the farthest is.
        margin = 1e-6 + float(np.sqrt(np.square(points - edge).sum(axis=1).max()))
        margin += float(np.linalg.norm(points[1] - points[0]))
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        among = near.find(positions, low, high)
        tissue = Tissue(
            positions, mesh.rest, mesh.tetrahedra, mesh.neighbors, among, opened, mesh.regions
        )
        pull = follow_device(self._state, self._strips, points, self._moved, tissue, self._law)
        self._renumbered = False
        if self._to is not None and self._state.spans.any():
            self._come_back(before)
        self._settle(pull)
        if anchor is not None and not self._state.spans.any():
            self._leave(anchor)

    def leave(self) -> None:
        """Take the blade out of the tissue where it is; its last sweep can be asked for."""
        self._leave(self._anchor())
        self._state.spans[:] = 0.0

    def _anchor(self) -> Anchor | None:
        """Return the anchor of the edge, which stays where it is if the mesh has changed since."""
        anchor = anchor_of(self._state)
        return anchor.loose() if anchor is not None and self._renumbered else anchor

    def _leave(self, anchor: Anchor | None) -> None:
        """Keep the sweep of an edge that leaves the tissue, and let it go with the tissue.

        Args:
            anchor: of the edge before; None: it has left already.
        """
        if self._swept <= _MIN_AREA and not self._failed:
            self._cut_tip, self._cut_edge = self._tip.copy(), self._edge.copy()
            self._from = None
        self._to = self._to if anchor is None else anchor

    def _come_back(self, before: np.ndarray) -> None:
        """Go on from the device's edge before [m], shape (2, 3), unless a sweep is kept."""
        self._to = None
        if self.sweep() is None:
            self._cut_tip, self._cut_edge = before[1], before[0] - before[1]
            self._from = None

    def untie(self) -> None:
        """Let the last sweep of an edge that leaves stay where it is: the mesh has changed."""
        self._from, self._renumbered = None, True
        if self._to is not None:
            self._to = self._to.loose()

    def let_go(self) -> None:
        """Let the edge follow the device without force: nothing is known of the tool."""
        self._state.spans[:] = 0.0
        self._strips.counts[:] = 0
        self._settle(no_pull())

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
        spans = self._state.spans
        inside = spans > 0.0
        if not inside.any():
            return Coupling()
        nodes, weights = gather_loads(self._state, spans / spans.sum())
        middle = float(SHARES[inside].mean())
        moved = (1 - middle) * (ahead[1] - self._device[1]) + middle * (ahead[0] - self._device[0])
        rate = moved / (1 - share) if share < 1 else np.zeros(3)
        whole = stiffness * float(spans.sum()) / WHOLE
        at = weights @ positions[nodes] + self.force / whole
        return Coupling(
            mode=HOLD,
            nodes=nodes,
            weights=weights,
            start=at - share * rate,
            end=at + moved,
            stiffness=whole,
            limit=self.limit,
            points=self._springs(inside, positions, ahead, share, stiffness),
        )

    def _springs(
        self,
        inside: np.ndarray,
        positions: np.ndarray,
        ahead: np.ndarray,
        share: float,
        stiffness: float,
    ) -> PointSprings:
        """Return the springs of the points in the tissue; arguments as of `spring`."""
        corners, weights = self._state.corners[inside], self._state.weights[inside]
        forces, spans = self._forces[inside], self._state.spans[inside]
        moved = (points_of(ahead) - points_of(self._device))[inside]
        rates = moved / (1 - share) if share < 1 else np.zeros_like(moved)
        each = stiffness * spans / WHOLE
        at = np.einsum('pk,pkc->pc', weights, positions[corners]) + forces / each[:, None]
        limits = np.maximum(self._limits[inside], np.linalg.norm(forces, axis=1))
        ends = np.stack([at - share * rates, at + moved], axis=1)
        return PointSprings(corners, weights, ends, each, limits)

    def _stretch(self) -> np.ndarray:
        """Return from the edge to the device's edge at all points [m], shape (POINTS, 3)."""
        return np.asarray(points_of(self._device) - self._state.points)

    def _settle(self, pull: Pull) -> None:
        """Update the output, and the edge as a line."""
        root, tip = self._device
        if self._to is None:
            self._tip = tip - pull.line[0]
            self._edge = root - tip - pull.line[1]
        self.force = pull.force
        self._forces, self._limits = pull.forces, pull.limits
        spans = self._state.spans
        shares = spans / spans.sum() if spans.any() else spans
        immersed = np.array([shares @ SHARES, shares @ SHARES**2])
        self.turning = Turning(-pull.torque, float(pull.torque_limit), immersed)
        self.limit, self.lag = float(pull.limit), float(pull.lag)
        self.paid += float(pull.paid)
        self.rubbed += float(pull.rubbed)
        self._swept += float(pull.swept)
        if pull.held and self._swept <= _MIN_AREA and not self._failed:
            # Spine or flat have carried the tissue along: nothing is to be opened.
            self._cut_tip, self._cut_edge = self._tip.copy(), self._edge.copy()
            self._from = anchor_of(self._state)
        length = float(np.linalg.norm(root - tip)) / POINTS
        self.immersed = length * float(spans.sum())

    def sweep(self) -> Sweep | None:
        """Return the sweep of the edge since the last `confirm_sweep`; None if it is negligible.

        The tissue bends the edge at which the last sweep ended. The sweep is straight, and starts
        behind all of it: no edge of the mesh slips through between the two.
        """
        tip, root = self._cut_tip, self._cut_tip + self._cut_edge
        tip_to, root_to = self._tip, self._tip + self._edge
        if Sweep(root, tip, root_to, tip_to).area <= _MIN_AREA:
            return None
        way = self._way()
        if self._to is None and not self._is_across(way):
            return None
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), _MIN_WAY)
        back = way * self._gap(way)
        return Sweep(root - back[0], tip - back[1], root_to, tip_to)

    def _way(self) -> np.ndarray:
        """Return the motion of root and tip since the last sweep ended [m], shape (2, 3)."""
        tip = self._tip - self._cut_tip
        return np.array([tip + self._edge - self._cut_edge, tip])

    def _is_across(self, way: np.ndarray) -> bool:
        """Return whether a motion of root and tip [m], shape (2, 3), leads across the edge."""
        across = np.linalg.norm(self._across(way), axis=1).max()
        least = 0.0 if self._begun else _MIN_FIRST * self._element
        return bool(across >= max(_MIN_ACROSS * np.linalg.norm(way, axis=1).max(), least))

    def _across(self, way: np.ndarray) -> np.ndarray:
        """Return the part of a motion of root and tip across the edge [m], shape (2, 3)."""
        along = self._edge / max(float(np.linalg.norm(self._edge)), _MIN_WAY)
        return np.asarray(way - np.outer(way @ along, along))

    def sink(self) -> None:
        """Let the begin of the next sweep go along with an edge that moves along itself.

        That motion sweeps nothing. Its sweep would have the direction of the tremor, and would put
        nodes on the wrong side of the cut for good.
        """
        if self._to is not None or self._failed or not self._state.spans.any():
            return
        way = self._way()
        if self._is_across(way):
            return
        root, tip = self._across(way)
        self._cut_tip = self._tip - tip
        self._cut_edge = self._edge - root + tip
        self._from = anchor_of(self._state)

    def _gap(self, way: np.ndarray) -> float:
        """Return by how much the straight start of a sweep is ahead of the bent one [m].

        Args:
            way: unit vectors of the motion of root and tip, shape (2, 3).
        """
        if self._from is None or not len(self._from.points):
            return 0.0
        shares = self._from.shares[:, None]
        ahead = self._cut_tip + shares * self._cut_edge - self._from.points
        along = way[1] + shares * (way[0] - way[1])
        over = (ahead * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), _MIN_WAY)
        return max(float(over.max()), 0.0)

    def confirm_sweep(self) -> None:
        """Start the next sweep from the present edge."""
        self._swept, self._from, self._begun = 0.0, None, True
        self._before = (self._cut_tip - self._tip, self._cut_edge, self._back)
        self._cut_tip = self._tip.copy()
        self._cut_edge = self._edge.copy()
        behind = self._strips.behind(self._element) if self._to is None else None
        self._back = None if behind is None else behind - self._cut_tip
        self._set_back &= self._failed
        self._failed = False

    def retry_sweep(self) -> None:
        """Start the next sweep where the last one, which was not cut, started, or an element
        earlier.

        The cutting service may have lost the stroke, and with it the element around the edge, which
        is divided only after the edge has left it. Repeated failures extend the sweep only once.
        """
        self._from = None
        offset, self._cut_edge, self._back = self._before
        self._cut_tip = self._cut_tip + offset
        if self._back is not None and not self._set_back:
            root, tip = self._back
            self._cut_tip, self._cut_edge = self._cut_tip + tip, root - tip
            self._set_back = True
        self._failed = True


def points_of(edge: np.ndarray) -> np.ndarray:
    """Return points of an edge, given by root and tip [m], shape (POINTS, 3)."""
    root, tip = edge
    return np.asarray(tip + SHARES[:, None] * (root - tip))
