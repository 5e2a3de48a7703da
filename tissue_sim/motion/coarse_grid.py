"""Coarse grid over a tissue: trilinear interpolation from its vertices to the nodes.

A vertex moves the nodes in the eight cells around it. Where a cut, or the shape of the tissue,
separates these nodes, each connected piece has an unknown of its own, so that none bridges the gap.
"""

from collections.abc import Callable

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.adjacency import NodeAdjacency
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, Touched, grown

_MIN_WEIGHT = 1e-4
"""Smaller weights count as 0, so that no unknown moves next to nothing."""


@inner
def _corner(cell, node, i, j, k):
    """Return which corner of a node's cell a vertex is, -1: none."""
    a, b, c = i - cell[node, 0], j - cell[node, 1], k - cell[node, 2]
    if a < 0 or b < 0 or c < 0 or a > 1 or b > 1 or c > 1:
        return -1
    return 4 * a + 2 * b + c


@inner
def _kept(nodes, cell, vertex, columns, given, done):
    """Return the first unknown that the nodes of a piece have and no other piece was given, or
    -1.
    """
    for node in nodes:
        had = columns[node, _corner(cell, node, vertex[0], vertex[1], vertex[2])]
        taken = had < 0
        for earlier in range(done):
            taken = taken or given[earlier] == had
        if not taken:
            return had
    return -1


@kernel
def _number_pieces(vertices, cell, start, used, neighbours, some, before, after, count):
    """Give each connected piece around some vertices an unknown, the largest piece first.

    A piece keeps the unknown that its nodes have, unless a larger one has it.

    Args:
        vertices: along each axis, shape (v, 3).
        cell: first vertex of the nodes' cells along each axis, shape (n, 3).
        start, used, neighbours: adjacency of the nodes, see `AdjacencyRows`.
        some: nodes in the cells around these vertices, shape (s,).
        before: unknowns of the nodes, -1: none, shape (n, 8).
        after: output: those now, shape (n, 8).
        count: of unknowns.

    Returns:
        Number of unknowns.
    """
    n = cell.shape[0]
    seen, queue = np.full(n, -1, np.int64), np.empty(n, np.int64)
    begin, given = np.empty(n + 1, np.int64), np.empty(n, np.int64)
    for which in range(len(vertices)):
        i, j, k = vertices[which, 0], vertices[which, 1], vertices[which, 2]
        pieces = at = end = 0
        for seed in some:
            if seen[seed] == which or used[seed] == 0 or _corner(cell, seed, i, j, k) < 0:
                continue
            begin[pieces] = end
            pieces += 1
            seen[seed], queue[end] = which, seed
            end += 1
            while at < end:
                first = start[queue[at]]
                for slot in range(first, first + used[queue[at]]):
                    other = neighbours[slot]
                    if seen[other] != which and _corner(cell, other, i, j, k) >= 0:
                        seen[other], queue[end] = which, other
                        end += 1
                at += 1
        begin[pieces] = end
        left = begin[1 : pieces + 1] - begin[:pieces]
        for done in range(pieces):
            piece = left.argmax()
            left[piece] = 0
            nodes = queue[begin[piece] : begin[piece + 1]]
            given[done] = _kept(nodes, cell, vertices[which], before, given, done)
            if given[done] < 0:
                given[done] = count
                count += 1
            for node in nodes:
                after[node, _corner(cell, node, i, j, k)] = given[done]
    return count


class CoarseGrid:
    """Unknowns at the vertices of a regular grid, and how nodes follow them.

    Args:
        mesh: the tissue; followed by `follow_cut`.
        neighbours: adjacency of its nodes.
        count: rough number of cells in the tissue.

    Attributes:
        count: of unknowns, c.
        columns: unknowns of each node, shape (>= n, 8).
        weights: of these, 0 at fixed nodes and where there is no unknown; else a node's sum is 1,
            shape (>= n, 8).
    """

    def __init__(self, mesh: TetMesh, neighbours: NodeAdjacency, count: int) -> None:
        self._mesh = mesh
        self._neighbours = neighbours
        self._low = mesh.rest.min(axis=0)
        size = np.ptp(mesh.rest, axis=0)
        edge = float((mesh.volumes().sum() / count) ** (1 / 3))
        cells = np.maximum(np.round(size / edge), 1).astype(np.int64)
        self._edge = np.maximum(size, 1e-9) / cells
        self._shape = cells + 1
        self.count = 0
        n = mesh.node_count
        self._cell = np.zeros((n, 3), np.int64)
        self.columns, self.weights = np.full((n, 8), -1), np.zeros((n, 8))
        self._place(np.arange(n))
        every = np.ascontiguousarray(np.argwhere(np.ones(self._shape)))
        self._accept(*self._numbered(every))

    def _place(self, nodes: np.ndarray) -> None:
        """Find the cells and weights of some nodes."""
        at = (self._mesh.rest[nodes] - self._low) / self._edge
        cell = np.clip(at.astype(np.int64), 0, self._shape - 2)
        part = np.clip(at - cell, 0.0, 1.0)
        x, y, z = np.moveaxis(np.stack([1 - part, part], axis=2), 1, 0)
        weights = np.einsum('na,nb,nc->nabc', x, y, z).reshape(-1, 8)
        weights[weights < _MIN_WEIGHT] = 0.0
        weights /= weights.sum(axis=1, keepdims=True)
        weights[self._mesh.fixed[nodes] == 1] = 0.0
        self._cell[nodes], self.weights[nodes], self.columns[nodes] = cell, weights, -1

    def _numbered(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Number the pieces around some vertices.

        Returns:
            Nodes whose unknowns change, sorted, shape (k,); their unknowns, shape (k, 8); and the
            number of all.
        """
        n = self._mesh.node_count
        cell, before = self._cell[:n], self.columns[:n]
        near = np.zeros(self._shape + 1, bool)
        for corner in np.ndindex(2, 2, 2):
            near[tuple((vertices - corner).T)] = True  # -1 is the spare one at the end
        some = np.flatnonzero(near[tuple(cell.T)])
        rows, after = self._neighbours.rows, before.copy()
        args = vertices, cell, rows.start, rows.used, rows.columns, some, before, after
        count = int(_number_pieces(*args, self.count))
        changed = some[(after[some] != before[some]).any(axis=1)]
        return changed, after[changed], count

    def _accept(self, nodes: np.ndarray, columns: np.ndarray, count: int) -> None:
        self.columns[nodes], self.count = columns, count
        alone = nodes[(columns < 0).any(axis=1)]  # without elements
        self.weights[alone], self.columns[alone] = 0.0, -1

    def follow_cut(self, touched: Touched, changes: Callable[[np.ndarray], None]) -> None:
        """Follow a change of connectivity: separated pieces get unknowns of their own.

        Args:
            touched: the written slots.
            changes: is called before, with the nodes whose unknowns change, sorted, shape (k,).
        """
        n = self._mesh.node_count
        self._cell, self.weights = grown(self._cell, n), grown(self.weights, n)
        self.columns = grown(self.columns, n, fill=-1)
        self._place(touched.rest[touched.rest < n])
        cells = np.unique(self._cell[touched.nodes[touched.nodes < n]], axis=0)
        corners = np.array(list(np.ndindex(2, 2, 2)))
        vertices = np.unique((cells[:, None] + corners).reshape(-1, 3), axis=0)
        found = self._numbered(vertices)
        changes(found[0])
        self._accept(*found)
