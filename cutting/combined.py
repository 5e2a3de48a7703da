"""The combined subdivision and separation method (thesis 5.3 to 5.5), and its limiting cases."""

from dataclasses import replace

import numpy as np

from cutting.batch import CutStateError, Scheme, build_batch, give_up_edges
from cutting.contact import find_hits, met_tetrahedra, surfaces
from cutting.geometry import smallest_altitudes
from cutting.lookup import NODES, clear, empty_tables, with_room
from cutting.method import CutResult, check_sweep
from cutting.propagation import quad
from cutting.snapping import Limits, Stroke, conflicts, register
from cutting.state_table import active_list, pending
from tissue_sim.blade import Sweep
from tissue_sim.mesh import TetMesh, grown

_ROOM_FOR_CHILDREN = 6.0
_ENOUGH = 20000
"""Elements that a median is taken of."""
FOLDED = 'the blade crosses its own cut: the stroke goes on as a new one'


class CombinedMethod:
    """Cuts by cases A to H and by separation along faces, in batches behind the blade.

    Args:
        scheme: which member of the family.

    Limitations: the visible cut ends about one element behind the blade. A stroke has one sheet in
        each element: where
    the blade folds back on its own cut, what it has cut is finished and a new stroke begins.
    """

    def __init__(self, scheme: Scheme) -> None:
        self._scheme = scheme
        self._tables = empty_tables()
        self._altitude = 0.0
        self._size = (-1, -1)
        self._first_new = 0
        self._queue: list[np.ndarray] = []
        self._direction = np.zeros(3)
        self._active = np.zeros((0, 4), np.int64)
        self._located = False
        self._seen = np.zeros(0, np.int64)
        self._mark = 0

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Cuts along a sweep, up to the elements that the blade is still in."""
        check_sweep(sweep)
        self._queue.append(quad(sweep))
        return self._work(mesh, np.ascontiguousarray(positions, float), finish=False)

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """The blade has left: every pending crossing goes into the mesh, and the tables are
        emptied.
        """
        result = self._work(mesh, np.ascontiguousarray(positions, float), finish=True)
        self._forget()
        return result

    def abort(self) -> None:
        """Forgets the stroke; the mesh stays as it is."""
        self._queue.clear()
        self._tables = empty_tables()
        self._forget()

    def _forget(self) -> None:
        self._size = (-1, -1)
        self._direction = np.zeros(3)
        self._active = np.zeros((0, 4), np.int64)
        self._located = False

    def _work(self, mesh: TetMesh, positions: np.ndarray, *, finish: bool) -> CutResult:
        warnings = self._follow(mesh)
        touched = 0
        folded = False
        while self._queue and not folded:
            met, folded = self._meet(mesh, positions, self._queue[0], tolerant=finish)
            touched += met
            if not folded:
                self._queue.pop(0)
        active = self._active[:0] if finish or folded else self._active
        batch = build_batch(mesh, positions, self._tables, active, self._scheme, self._limits())
        self._tables = batch.tables
        if folded:
            warnings.append(FOLDED)
        if finish or folded:
            self._empty_tables(mesh, batch.delta.node_parents.shape[0])
        self._size = batch.size
        report = replace(
            batch.report, touched=touched, warnings=tuple(warnings) + batch.report.warnings
        )
        return CutResult(batch.delta, report)

    def _follow(self, mesh: TetMesh) -> list[str]:
        """Makes room for the mesh, and drops a stroke that belongs to another one."""
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
        """Enters what one sweep crosses; returns how many elements it met, and whether it folded
        back.
        """
        triangles = surfaces(corners)
        near = np.unique(self._active)
        links, tables = mesh.links, self._tables
        self._mark += 1
        self._seen = grown(self._seen, len(tables.owner))
        met = met_tetrahedra(
            triangles, links, positions, near, not self._located, self._seen, self._mark
        )
        self._located |= len(met) > 0
        nodes, data = find_hits(triangles, links, tables, positions, met)
        self._turn(triangles, corners)
        direction = self._direction / max(float(np.linalg.norm(self._direction)), 1e-300)
        if not tolerant and conflicts(tables, nodes, data, direction, positions):
            return len(met), True
        tables = with_room(
            tables,
            mesh_nodes=mesh.node_count,
            tetrahedra=len(mesh.tetrahedra),
            nodes=4 * len(met) + 2 * len(nodes) + 64 * len(nodes),
            edges=len(nodes),
            parents=0,
        )
        limits = self._limits()
        register(
            nodes,
            data,
            Stroke(direction, links, tables, positions, mesh.rest, mesh.fixed, limits),
        )
        if not self._scheme.subdivides:
            give_up_edges(tables)
        self._tables = tables
        self._active = active_list(corners[3], corners[2], links, tables, positions, met)
        return len(met), False

    def _limits(self) -> Limits:
        scheme = self._scheme
        floor = scheme.floor * self._altitude
        return Limits(
            tau=scheme.tau,
            off=scheme.off * self._altitude if scheme.slides else np.inf,
            thin=scheme.thin * self._altitude,
            small=_ROOM_FOR_CHILDREN * floor,
            floor=floor,
            shape=scheme.shape * self._altitude,
        )

    def _turn(self, triangles: np.ndarray, corners: np.ndarray) -> None:
        """Lets the normal of the stroke follow its sweeps, with a memory of about one element."""
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
