"""Combined subdivision and separation method (thesis 5.3 to 5.5), with its limiting cases."""

from dataclasses import replace

import numpy as np

from cutting_trainer.cutting.batch import CutStateError, Scheme, build_batch, give_up_edges
from cutting_trainer.cutting.bridges import part_bridges, part_uncovered
from cutting_trainer.cutting.broad_phase import quad
from cutting_trainer.cutting.coverage import closed_area
from cutting_trainer.cutting.crossings import find_hits, lengthened, met_tetrahedra, surfaces
from cutting_trainer.cutting.front import slide_front
from cutting_trainer.cutting.geometry import smallest_altitudes
from cutting_trainer.cutting.junctions import part_junctions
from cutting_trainer.cutting.lookup import NODES, clear, empty_tables, with_room
from cutting_trainer.cutting.method_interface import CutResult, check_sweep
from cutting_trainer.cutting.snap_release import settle_waiting
from cutting_trainer.cutting.snapping import SnapLimits, SnapStroke, conflicts, register
from cutting_trainer.cutting.state_table import active_list, pending
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, grown

_ROOM_FOR_CHILDREN = 6.0
_LEAD = 0.44
"""How far a cut is led on where a stroke begins or ends inside the tissue, in median altitudes. The
front ends short of the blade by so much in the mean."""
_BRIEF, _MIN_WAY = 0.3, 1.25
"""How much further a cut is led on at its end, in median altitudes, for each edge of way that a
stroke is shorter than the second, in edges. A short one passes between the edges of the elements.
"""
_REACH, _SHALLOW = 0.25, 1.0
"""How much further than its tip a blade is taken to cut that is an edge deep or deeper; and what is
added for each edge that is lacking to this depth, in median altitudes. A shallow blade passes
between the edges of the elements."""
_MAX_REACH, _REACH_BY_DEPTH = 0.6, 2.0
"""Largest reach, and largest reach for each edge of depth, in median altitudes."""
_NEAR = 0.5
"""Distance from the surface at which a node with a contradicted side is put on the cut, as a share
of the median altitude."""
_STRIP = 2.5
"""Way that is remembered of each end of a stroke, in edges."""
_MAX_STRETCH = 4.0
"""Largest length of an edge in the rest shape, relative to its length as it is."""
_MAX_STRIPS = 32
_EDGE = 1.5
"""Edge of a well-shaped element, in altitudes."""
_ENOUGH = 20000
"""Elements in the sample for a median."""
_HOLDS = 'the tissue holds together across the cut at ({:.1f}, {:.1f}, {:.1f}) mm at rest'
_CLOSED = (
    'the tissue still holds together where the blade swept {:.2f} cm^2 around '
    '({:.1f}, {:.1f}, {:.1f}) mm at rest: elements with edges of {:.1f} mm are too large for a cut '
    'so small'
)
FOLDED = 'the blade crosses or follows a cut: the stroke goes on as a new one'


class CombinedMethod:
    """Cuts by cases A to H and by separation along faces, in batches behind the blade.

    Args:
        scheme: parameters of the method.

    Limitations: the visible cut ends about one element behind the blade. A stroke has one sheet in
        each element: where the blade folds back on its own cut, the stroke is finished and a new
        one begins.
    """

    def __init__(self, scheme: Scheme) -> None:
        self._scheme = scheme
        self._tables = empty_tables()
        self._altitude = 0.0
        self._size = (-1, -1)
        self._first_new = 0
        self._queue: list[np.ndarray] = []
        self._last = np.zeros((4, 3))
        self._direction = np.zeros(3)
        self._active = np.zeros((0, 4), np.int64)
        self._reach = 0.0
        self._located = False
        self._seen = np.zeros(0, np.int64)
        self._mark = 0
        self._lines = np.zeros((0, 2, 3))
        self._strips: list[np.ndarray] = []

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Cut along a sweep, except in the elements around the blade."""
        check_sweep(sweep)
        self._queue.append(quad(sweep))
        return self._work(mesh, np.ascontiguousarray(positions, float), finish=False)

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """Put all pending crossings into the mesh and clear the tables, after the blade has
        left.
        """
        result = self._work(mesh, np.ascontiguousarray(positions, float), finish=True)
        self._forget()
        return result

    def abort(self) -> None:
        """Forget the stroke; the mesh stays unchanged."""
        self._queue.clear()
        self._strips.clear()
        self._tables = empty_tables()
        self._forget()

    def _forget(self) -> None:
        self._lines = self._lines[:0]
        self._size = (-1, -1)
        self._last = np.zeros((4, 3))
        self._direction = np.zeros(3)
        self._active = np.zeros((0, 4), np.int64)
        self._reach = 0.0
        self._located = False

    def _work(self, mesh: TetMesh, positions: np.ndarray, *, finish: bool) -> CutResult:
        warnings = self._follow(mesh)
        touched = 0
        folded = False
        while self._queue and not folded:
            met, folded = self._meet(mesh, positions, self._queue[0], tolerant=finish)
            touched += met
            if not folded:
                self._last = self._queue.pop(0)
                self._trace(mesh, positions)
        if finish or folded:
            self._round_off(mesh, positions)
        active = self._active[:0] if finish or folded else self._active
        stroke = self._stroke(mesh, positions)
        waiting = settle_waiting(active, stroke, self._scheme.subdivides)
        held = np.concatenate([active, np.repeat(waiting[:, None], 4, axis=1)])
        batch = build_batch(mesh, positions, self._tables, held, self._scheme, self._limits())
        self._tables = batch.tables
        delta, area = batch.delta, batch.report.area
        if folded:
            warnings.append(FOLDED)
        if finish or folded:
            delta, more, said = self._join_strokes(mesh, delta, folded=folded)
            area += more
            warnings += said
            self._empty_tables(mesh, delta.node_parents.shape[0])
        further = len(delta.node_parents) - len(batch.delta.node_parents)
        self._size = (batch.size[0] + further, batch.size[1])
        report = replace(
            batch.report,
            touched=touched,
            area=area,
            warnings=tuple(warnings) + batch.report.warnings,
        )
        return CutResult(delta, report)

    def _trace(self, mesh: TetMesh, positions: np.ndarray) -> None:
        """Remember where the blade went, in the rest shape of the elements around it."""
        if not len(self._active):
            return
        nodes = np.unique(self._active)
        near = np.column_stack([positions[nodes], np.ones(len(nodes))])
        to_rest = np.linalg.lstsq(near, mesh.rest[nodes], rcond=None)[0]
        corners = np.column_stack([self._last, np.ones(4)]) @ to_rest
        here, rest = (
            np.linalg.norm(at[[0, 3]] - at[[1, 2]], axis=1) for at in (self._last, corners)
        )
        if (rest > _MAX_STRETCH * here).any():
            return  # the map of few flat elements says nothing of an edge that is long beside them
        edge = corners[[3, 2]]
        if not len(self._lines):
            self._lines = corners[None, :2]
        way = np.linalg.norm(edge - self._lines[-1], axis=1).mean()
        if way > 0.2 * _EDGE * self._altitude:
            self._lines = np.concatenate([self._lines, edge[None]])

    def _join_strokes(
        self, mesh: TetMesh, delta: TopologyDelta, *, folded: bool
    ) -> tuple[TopologyDelta, float, list[str]]:
        """Part the tissue that this stroke has left, also where it meets the ends of earlier ones;
        remember its ends.
        """
        h = _EDGE * self._altitude
        lines, self._lines = self._lines, self._lines[:0]
        if not self._scheme.leads_on or len(lines) < 2:
            return delta, 0.0, []
        delta, area, places = part_bridges(mesh, delta, self._tables, self._first_new, lines, h)
        ends = []
        for one in (lines, lines[::-1]):
            count = 2 + int(np.searchsorted(_ways(one), _STRIP * h))
            ends.append(np.ascontiguousarray(one[:count]))
        nodes = self._tables.node_id[: self._tables.counts[NODES]]
        delta, more = part_junctions(mesh, delta, nodes, ends, self._strips, h)
        self._strips = [*self._strips, *ends][-_MAX_STRIPS:]
        area += more
        said = [_HOLDS.format(*1e3 * place) for place in places[:1]]
        front = self._first_new, lines, h, self._limits().small
        delta, more, opened = slide_front(mesh, delta, nodes, *front)
        area += more
        delta, more = part_uncovered(mesh, delta, self._tables, opened, lines, h)
        if more > 0.0:
            area += more
            delta, more, opened = slide_front(mesh, delta, nodes, *front)
            area += more
        closed, middle = closed_area(mesh, lines, opened, h)
        if closed > 0.0 and not folded:
            said.append(_CLOSED.format(1e4 * closed, *1e3 * middle, 1e3 * h))
        return delta, area, said

    def _round_off(self, mesh: TetMesh, positions: np.ndarray) -> None:
        """Lead the cut on where a stroke ends inside the tissue."""
        lead = 0.0
        if self._scheme.leads_on:
            lacking = _MIN_WAY - _ways(self._lines).max(initial=0.0) / (_EDGE * self._altitude)
            lead = (_LEAD + _BRIEF * max(lacking, 0.0)) * self._altitude
        way = (self._last[2:] - self._last[1::-1]).mean(axis=0)
        length = float(np.linalg.norm(way))
        if len(self._active) and min(lead, length) > 0.0:
            end = self._last[[3, 2, 2, 3]]
            end[2:] += way * (lead / length)
            self._meet(mesh, positions, end, tolerant=True)
        self._last = np.zeros((4, 3))

    def _follow(self, mesh: TetMesh) -> list[str]:
        """Allocate for the mesh, and drop a stroke of another mesh."""
        warnings = []
        if self._tables.counts[NODES] and (mesh.node_count, len(mesh.tetrahedra)) != self._size:
            queue = self._queue.copy()
            self.abort()
            self._queue = queue
            warnings.append('the mesh changed within a stroke, which goes on as a new one')
        if self._altitude == 0.0:
            some = mesh.tetrahedra[:: 1 + len(mesh.tetrahedra) // _ENOUGH]
            self._altitude = float(np.median(smallest_altitudes(mesh.rest, some)))
        self._tables = with_room(
            self._tables,
            mesh_nodes=mesh.node_count + mesh.node_count // 4,
            tetrahedra=len(mesh.tetrahedra) + len(mesh.tetrahedra) // 4,
            nodes=0,
            edges=0,
            parents=0,
        )
        if self._tables.counts[NODES] == 0:
            self._first_new = mesh.node_count
        return warnings

    def _meet(
        self, mesh: TetMesh, positions: np.ndarray, corners: np.ndarray, *, tolerant: bool
    ) -> tuple[int, bool]:
        """Register the crossings of a sweep; return the number of met elements, and whether it
        folded back.
        """
        near = np.unique(self._active)
        links, tables = mesh.links, self._tables
        self._mark += 1
        self._seen = grown(self._seen, len(tables.owner))
        most = _MAX_REACH * self._altitude if self._scheme.leads_on else 0.0
        triangles = surfaces(lengthened(corners, most, most, back=0.0))
        met = met_tetrahedra(
            triangles, links, positions, near, not self._located, self._seen, self._mark
        )
        self._located |= len(met) > 0
        active, depth = active_list(corners[3], corners[2], links, tables, positions, met)
        before, after, back = self._reach, self._reach_at(depth), 0.0
        if not tables.counts[NODES]:
            _, begun = active_list(corners[0], corners[1], links, tables, positions, met)
            before = self._reach_at(begun)
            back = _LEAD * self._altitude if before > 0.0 else 0.0
        triangles = surfaces(lengthened(corners, before, after, back=back))
        nodes, data = find_hits(triangles, links, tables, positions, met)
        self._turn(triangles, corners)
        stroke = self._stroke(mesh, positions)
        if not tolerant and conflicts(nodes, data, _NEAR * self._altitude, stroke):
            return len(met), True
        tables = with_room(
            tables,
            mesh_nodes=mesh.node_count,
            tetrahedra=len(mesh.tetrahedra),
            nodes=4 * len(met) + 2 * len(nodes) + 64 * len(nodes),
            edges=len(nodes),
            parents=0,
        )
        register(nodes, data, stroke._replace(tables=tables))
        if not self._scheme.subdivides:
            give_up_edges(tables)
        self._tables = tables
        self._active, self._reach = active, after
        return len(met), False

    def _reach_at(self, depth: float) -> float:
        """Return how much further than its tip a blade at a depth is taken to cut [m].

        Args:
            depth: length of the edge in the tissue [m].
        """
        if not self._scheme.leads_on:
            return 0.0
        deep = depth / (_EDGE * self._altitude)
        reach = _REACH + _SHALLOW * max(1.0 - deep, 0.0)
        return min(reach, _MAX_REACH, _REACH_BY_DEPTH * deep) * self._altitude

    def _stroke(self, mesh: TetMesh, positions: np.ndarray) -> SnapStroke:
        """Return the operand of the kernels of snapping."""
        direction = self._direction / max(float(np.linalg.norm(self._direction)), 1e-300)
        return SnapStroke(
            direction, mesh.links, self._tables, positions, mesh.rest, mesh.fixed, self._limits()
        )

    def _limits(self) -> SnapLimits:
        scheme = self._scheme
        floor = scheme.floor * self._altitude
        return SnapLimits(
            tau=scheme.tau,
            off=scheme.off * self._altitude if scheme.slides else np.inf,
            thin=scheme.thin * self._altitude,
            small=_ROOM_FOR_CHILDREN * floor,
            floor=floor,
            shape=scheme.shape * self._altitude,
        )

    def _turn(self, triangles: np.ndarray, corners: np.ndarray) -> None:
        """Update the normal of the stroke by its sweeps, averaged over about one element."""
        way = float(np.linalg.norm(corners[2:] - corners[1::-1], axis=1).mean())
        direction = self._direction * np.exp(-way / self._altitude)
        for a, b, c in triangles:
            normal = np.cross(b - a, c - a) / 2
            direction += normal if normal @ self._direction >= 0 else -normal
        self._direction = direction

    def _empty_tables(self, mesh: TetMesh, new_nodes: int) -> None:
        if pending(self._tables):
            raise CutStateError('crossings are pending after a stroke; they have to be in the mesh')
        clear(self._tables, self._first_new, mesh.node_count + new_nodes)


def _ways(lines: np.ndarray) -> np.ndarray:
    """Return the way from the first of some places of an edge to each later one [m], (k - 1,).

    Args:
        lines: root and tip by place [m], shape (k, 2, 3).
    """
    return np.cumsum(np.linalg.norm(np.diff(lines, axis=0), axis=2).mean(axis=1))
