"""Tetrahedral mesh of the tissue: rest shape and connectivity, changed in batches."""

from dataclasses import dataclass, field

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.mesh.topology import (
    Links,
    adjacent_nodes,
    append_tetrahedra,
    remove_tetrahedra,
    renumber_node,
)


def _no_indices() -> np.ndarray:
    return np.zeros(0, np.int64)


def _no_parents() -> np.ndarray:
    return np.zeros((0, 4), np.int64)


@dataclass(frozen=True)
class TopologyDelta:
    """A change of connectivity, with its parts in the order of `TetMesh.apply`.

    New and moved nodes have four parents and weights (sum 1). Rest position, displacement and
    velocity are interpolated alike, so a change of connectivity moves nothing.

    Attributes:
        node_parents: existing nodes by new node, shape (a, 4).
        node_weights: shape (a, 4).
        moved_nodes: existing nodes that slide to another material point, shape (b,).
        moved_parents, moved_weights: where to, in terms of the nodes before any of them moves,
            shape (b, 4).
        removed_tetrahedra: indices before the change, shape (r,).
        tetrahedra: nodes of the new ones; new nodes count on from the node count, shape (c, 4).
        outer_faces: bit f of a new tetrahedron: its face opposite node f, where free, belongs to
            the original surface, shape (c,).
        regions: of the new ones, shape (c,); (0,) in a tissue of one material.
    """

    node_parents: np.ndarray = field(default_factory=_no_parents)
    node_weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    moved_nodes: np.ndarray = field(default_factory=_no_indices)
    moved_parents: np.ndarray = field(default_factory=_no_parents)
    moved_weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    removed_tetrahedra: np.ndarray = field(default_factory=_no_indices)
    tetrahedra: np.ndarray = field(default_factory=_no_parents)
    outer_faces: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))
    regions: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))

    @property
    def empty(self) -> bool:
        """Whether nothing changes."""
        return not (len(self.removed_tetrahedra) or len(self.tetrahedra) or len(self.moved_nodes))


@dataclass(frozen=True)
class Touched:
    """Slots written by a batch, each sorted and without repeats.

    Attributes:
        nodes: nodes of removed and added tetrahedra, and of those around moved or renumbered nodes.
        rest: nodes that are new, or whose rest position or number changed.
        tetrahedra: slots of tetrahedra.
        triangles: slots of surface triangles.
        renumbered: (target, source) of each node that took the place of a removed one, in order.
    """

    nodes: np.ndarray
    rest: np.ndarray
    tetrahedra: np.ndarray
    triangles: np.ndarray
    renumbered: list[tuple[int, int]]


def _require_valid(
    rest: np.ndarray,
    tetrahedra: np.ndarray,
    fixed: np.ndarray | None,
    regions: np.ndarray | None,
) -> None:
    """Reject arrays that are none of a mesh: kernels index them unchecked."""
    count = len(rest)
    if rest.shape != (count, 3) or not np.isfinite(rest).all():
        raise MeshError(f'rest positions have the shape {rest.shape}: finite (n, 3) are needed')
    if tetrahedra.shape != (len(tetrahedra), 4) or tetrahedra.dtype.kind not in 'iu':
        raise MeshError(
            f'tetrahedra have the shape {tetrahedra.shape} and the type {tetrahedra.dtype}: '
            'integers, (m, 4), are needed'
        )
    absent = ((tetrahedra < 0) | (tetrahedra >= count)).any(axis=1)
    if absent.any():
        which = int(np.argmax(absent))
        nodes = tetrahedra[which].tolist()
        raise MeshError(f'tetrahedron {which} has nodes {nodes}: the mesh has {count}, from 0 on')
    if regions is not None and np.shape(regions) not in ((0,), (len(tetrahedra),)):
        raise MeshError(
            f'regions have the shape {np.shape(regions)}: one for each of {len(tetrahedra)} '
            'tetrahedra is needed'
        )
    if fixed is not None and np.shape(fixed) != (count,):
        raise MeshError(
            f'fixed has the shape {np.shape(fixed)}: a mask of all nodes, ({count},), is needed'
        )


class TetMesh:
    """Rest shape and connectivity of the tissue, in arrays that grow by doubling.

    New tetrahedra are appended. A removed one is replaced by the last; nodes likewise. Adjacency
    and surface are updated in time proportional to the change.

    Args:
        rest: rest positions [m], shape (n, 3).
        tetrahedra: node indices, positively oriented, shape (m, 4).
        fixed: which nodes do not move, shape (n,).
        regions: row of the table of materials by tetrahedron, shape (m,); (0,): one material.

    Raises:
        MeshError: an array has another shape, a position is not finite, a tetrahedron has a node
            that is not there, or a face belongs to more than two tetrahedra.
    """

    def __init__(
        self,
        rest: np.ndarray,
        tetrahedra: np.ndarray,
        fixed: np.ndarray | None = None,
        regions: np.ndarray | None = None,
    ) -> None:
        _require_valid(np.asarray(rest), np.asarray(tetrahedra), fixed, regions)
        self.node_count = len(rest)
        # Spare room: the first cut of a large mesh does not have to move it all.
        m, n = len(tetrahedra), len(rest) + len(rest) // 4
        self._rest = grown(np.array(rest, float), n)
        self._fixed = grown(
            np.zeros(len(rest), np.uint8) if fixed is None else np.array(fixed, np.uint8), n
        )
        own = np.zeros(0, np.uint8) if regions is None else np.asarray(regions, np.uint8)
        self.links = _allocate(n, m + m // 4, 4 * m, 16 * m + 64, len(own) > 0)
        order = np.ascontiguousarray(tetrahedra, np.int64)
        bad = append_tetrahedra(self.links, order, np.full(m, 15, np.uint8), own)
        if bad >= 0:
            raise MeshError(
                f'tetrahedron {bad} with nodes {order[bad].tolist()} is the third on one of its '
                'faces; a face may belong to two tetrahedra at most'
            )
        self.links.counts[2] = 0
        self.topology = 0

    def set_kinds(self, triangles: np.ndarray, kinds: np.ndarray) -> None:
        """Mark the surface triangles opened by cuts, for a mesh that was cut before.

        Args:
            triangles: nodes, shape (k, 3).
            kinds: OUTER or CUT of each, shape (k,).
        """
        ours = np.sort(self.triangles, axis=1)
        theirs = np.sort(triangles, axis=1)
        order, wanted = np.lexsort(ours.T), np.lexsort(theirs.T)
        self.links.triangle_kind[order] = kinds[wanted]

    @property
    def rest(self) -> np.ndarray:
        """Rest positions [m], shape (n, 3); a view."""
        return self._rest[: self.node_count]

    @property
    def fixed(self) -> np.ndarray:
        """1 where the node does not move, shape (n,); a view."""
        return self._fixed[: self.node_count]

    @property
    def tetrahedra(self) -> np.ndarray:
        """Node indices, shape (m, 4), int32; a view."""
        return self.links.tetrahedra[: self.links.counts[0]]

    @property
    def neighbors(self) -> np.ndarray:
        """Face (4 t + i) across each face, -1 at the boundary, shape (m, 4); a view."""
        return self.links.neighbors[: self.links.counts[0]]

    @property
    def triangles(self) -> np.ndarray:
        """Surface triangles, outward counter-clockwise, shape (k, 3), int32; a view."""
        return self.links.triangles[: self.links.counts[1]]

    @property
    def triangle_kind(self) -> np.ndarray:
        """OUTER or CUT by surface triangle, shape (k,); a view."""
        return self.links.triangle_kind[: self.links.counts[1]]

    @property
    def triangle_face(self) -> np.ndarray:
        """Face (4 t + i) of each surface triangle, shape (k,); a view."""
        return self.links.triangle_face[: self.links.counts[1]]

    @property
    def regions(self) -> np.ndarray:
        """Row of the table of materials by tetrahedron, shape (m,), uint8; a view.

        A tissue of one material has none, shape (0,).
        """
        return self.links.region[: self.links.counts[0]]

    def regions_at(self, tetrahedra: np.ndarray) -> np.ndarray:
        """Return the regions of some tetrahedra, shape (r,); (0,) with one material."""
        return self.regions[tetrahedra] if len(self.regions) else self.regions

    def by_region(self, values: np.ndarray) -> np.ndarray:
        """Return values by tetrahedron, shape (m,), of values by region."""
        regions = self.regions
        if len(regions):
            return np.asarray(values[regions])
        return np.full(len(self.tetrahedra), values[0])

    def volumes(self) -> np.ndarray:
        """Return signed rest volumes [m^3], shape (m,)."""
        return tetrahedron_volumes(self.rest, self.tetrahedra)

    def apply(self, delta: TopologyDelta) -> Touched:
        """Apply a change of connectivity.

        Args:
            delta: the change; node and tetrahedron numbers are those before it.

        Returns:
            The written slots. Nodes without a tetrahedron are removed.

        Raises:
            MeshError: an index is out of range, or a face would belong to three tetrahedra. The
                mesh is left unchanged in the first case only.
        """
        self._check(delta)
        removed = np.unique(np.asarray(delta.removed_tetrahedra, np.int64))[::-1].copy()
        added = np.ascontiguousarray(delta.tetrahedra, np.int64).reshape(-1, 4)
        old_nodes = self.tetrahedra[removed].ravel()
        first_new = self.node_count
        moved = np.asarray(delta.moved_nodes, np.int64)
        self._interpolate_nodes(delta, moved)
        self._reserve(len(removed), len(added), len(old_nodes))
        self.links.counts[2] = 0
        remove_tetrahedra(self.links, removed)
        outer, own = np.asarray(delta.outer_faces, np.uint8), np.asarray(delta.regions, np.uint8)
        bad = append_tetrahedra(self.links, added, outer, own)
        if bad >= 0:
            raise MeshError(
                f'new tetrahedron {bad} with nodes {added[bad].tolist()} would be the third '
                'on a face'
            )
        new = np.arange(first_new, self.node_count)
        nodes = np.unique(np.concatenate([old_nodes, added.ravel(), moved, new]))
        renumbered = self._drop_orphans(nodes)
        self.topology += 1
        return self._touched(nodes, first_new, moved, renumbered)

    def _check(self, delta: TopologyDelta) -> None:
        m, n = int(self.links.counts[0]), self.node_count
        limits = (
            ('removed_tetrahedra', delta.removed_tetrahedra, m),
            ('node_parents', delta.node_parents, n),
            ('moved_nodes', delta.moved_nodes, n),
            ('moved_parents', delta.moved_parents, n),
            ('tetrahedra', delta.tetrahedra, n + len(delta.node_parents)),
        )
        for name, values, limit in limits:
            array = np.asarray(values)
            if array.size and (array.min() < 0 or array.max() >= limit):
                worst = array.max() if array.max() >= limit else array.min()
                raise MeshError(f'{name} has index {worst}; allowed are 0 to {limit - 1}')
        if len(self.regions):
            given, wanted = len(delta.regions), len(delta.tetrahedra)
            if given != wanted or not np.isin(delta.regions, self.regions).all():
                raise MeshError(
                    f'{wanted} new tetrahedra have {given} regions; each needs one of the mesh'
                )

    def _interpolate_nodes(self, delta: TopologyDelta, moved: np.ndarray) -> None:
        n, a = self.node_count, len(delta.node_parents)
        self._rest = grown(self._rest, n + a)
        self._fixed = grown(self._fixed, n + a)
        self._rest[n : n + a] = interpolated(self._rest, delta.node_parents, delta.node_weights)
        new = interpolated(self._rest, delta.moved_parents, delta.moved_weights)
        held = self._fixed[np.asarray(delta.node_parents, np.int64)] | (
            np.asarray(delta.node_weights) == 0
        )
        self._fixed[n : n + a] = held.all(axis=1)
        self._rest[moved] = new
        self.node_count = n + a

    def _reserve(self, removed: int, added: int, corners: int) -> None:
        links = self.links
        m, k = int(links.counts[0]), int(links.counts[1])
        tets, triangles = m + added, k + 4 * (removed + added)
        log = 16 * (removed + added) + 64 * corners + 64
        n = self.node_count
        self.links = Links(
            links.counts,
            grown(links.tetrahedra, tets),
            grown(links.neighbors, tets),
            grown(links.face_triangle, tets),
            grown(links.corner_next, 4 * tets),
            grown(links.corner_prev, 4 * tets),
            grown(links.first_corner, n, fill=-1),
            grown(links.triangles, triangles),
            grown(links.triangle_face, triangles),
            grown(links.triangle_kind, triangles),
            grown(links.log, log),
            grown(links.region, tets) if len(links.region) else links.region,
        )

    def _drop_orphans(self, nodes: np.ndarray) -> list[tuple[int, int]]:
        renumbered = []
        for node in nodes[self.links.first_corner[nodes] < 0][::-1]:
            last = self.node_count - 1
            if node != last:
                self.links = self.links._replace(
                    log=grown(self.links.log, int(self.links.counts[2]) + 1024)
                )
                self._rest[node] = self._rest[last]
                self._fixed[node] = self._fixed[last]
                renumber_node(self.links, last, int(node))
                renumbered.append((int(node), last))
            self.node_count = last
        return renumbered

    def _touched(
        self,
        nodes: np.ndarray,
        first_new: int,
        moved: np.ndarray,
        renumbered: list[tuple[int, int]],
    ) -> Touched:
        log = self.links.log[: self.links.counts[2]]
        tets = np.unique(log[log % 2 == 0] // 2)
        triangles = np.unique(log[log % 2 == 1] // 2)
        tets = tets[tets < self.links.counts[0]]
        # Rows refer to a node by its number and to elements by their shape: all elements of a
        # moved or renumbered node are touched.
        targets = np.array([target for target, _ in renumbered], np.int64)
        renewed = np.concatenate([moved, targets])
        renewed = renewed[renewed < self.node_count]
        links = self.links
        stars = adjacent_nodes(links.tetrahedra, links.first_corner, links.corner_next, renewed)
        nodes = np.unique(np.concatenate([nodes, stars]))
        rest = np.unique(np.concatenate([np.arange(first_new, self.node_count), moved, targets]))
        return Touched(
            nodes=nodes[nodes < self.node_count],
            rest=rest[rest < self.node_count],
            tetrahedra=tets,
            triangles=triangles[triangles < self.links.counts[1]],
            renumbered=renumbered,
        )

    def star(self, node: int) -> np.ndarray:
        """Return the tetrahedra of a node, shape (s,)."""
        star = []
        corner = self.links.first_corner[node]
        while corner >= 0:
            star.append(corner // 4)
            corner = self.links.corner_next[corner]
        return np.array(star, np.int64)


def carried_over(rows: np.ndarray, count: int, delta: TopologyDelta, touched: Touched) -> None:
    """Carry nodal values through a change of connectivity, in place.

    Args:
        rows: with room for the new nodes, shape (count + a or more, d).
        count: of nodes before the change.
        delta: the change.
        touched: result of `TetMesh.apply`.
    """
    new = interpolated(rows, delta.node_parents, delta.node_weights)
    moved = interpolated(rows, delta.moved_parents, delta.moved_weights)
    rows[count : count + len(new)] = new
    rows[np.asarray(delta.moved_nodes, np.int64)] = moved
    for target, source in touched.renumbered:
        rows[target] = rows[source]


def interpolated(values: np.ndarray, parents: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return weighted sums of four rows each, added in the order of the parents.

    Args:
        values: rows, shape (n, d).
        parents: row indices, shape (a, 4).
        weights: shape (a, 4).

    Returns:
        Shape (a, d).
    """
    rows = np.asarray(parents, np.int64).reshape(-1, 4)
    w = np.asarray(weights, float).reshape(-1, 4, 1)
    return (
        w[:, 0] * values[rows[:, 0]]
        + w[:, 1] * values[rows[:, 1]]
        + w[:, 2] * values[rows[:, 2]]
        + w[:, 3] * values[rows[:, 3]]
    )


def tetrahedron_volumes(positions: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return signed volumes [m^3], shape (m,), at positions [m], shape (n, 3)."""
    a, b, c, d = (positions[tetrahedra[:, i]] for i in range(4))
    return np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) / 6


def grown(array: np.ndarray, size: int, *, fill: int = 0) -> np.ndarray:
    """Return the array, or a copy of doubled size with at least `size` rows."""
    if len(array) >= size:
        return array
    larger = np.full((max(size, 2 * len(array)), *array.shape[1:]), fill, array.dtype)
    larger[: len(array)] = array
    return larger


def _allocate(nodes: int, tets: int, triangles: int, log: int, labelled: bool) -> Links:
    return Links(
        np.zeros(3, np.int64),
        np.zeros((tets, 4), np.int32),
        np.full((tets, 4), -1, np.int32),
        np.full((tets, 4), -1, np.int32),
        np.full(4 * tets, -1, np.int32),
        np.full(4 * tets, -1, np.int32),
        np.full(nodes, -1, np.int32),
        np.zeros((triangles, 3), np.int32),
        np.zeros(triangles, np.int32),
        np.zeros(triangles, np.uint8),
        np.zeros(log, np.int64),
        np.zeros(tets if labelled else 0, np.uint8),
    )
