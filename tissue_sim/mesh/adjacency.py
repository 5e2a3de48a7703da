"""Adjacency of nodes: neighbours, levels around some nodes, and intervals of node numbers."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown

PATCH = 2048
"""Nodes around a place that stand for a whole large tissue: their rim is some ten elements away."""
_FAR = 255


class AdjacencyRows(NamedTuple):
    """Neighbours of each node: those of node i are columns[start[i] : start[i] + used[i]]."""

    start: np.ndarray
    used: np.ndarray
    room: np.ndarray
    columns: np.ndarray


@kernel
def _gather(rows, filled, tetrahedra, first_corner, corner_next, nodes, seen, stamp):
    """Write the rows of some nodes; return the first whose row does not fit in columns, or -1."""
    start, used, room, columns = rows.start, rows.used, rows.room, rows.columns
    for which in range(nodes.shape[0]):
        node, behind = nodes[which], filled[0]
        count = 0
        seen[node] = stamp + which
        corner = first_corner[node]
        while corner >= 0:
            if behind + count + 4 > columns.shape[0]:
                return which
            for i in range(4):
                other = tetrahedra[corner // 4, i]
                if seen[other] != stamp + which:
                    seen[other] = stamp + which
                    columns[behind + count] = other
                    count += 1
            corner = corner_next[corner]
        if count > room[node]:
            start[node], room[node] = behind, count
            filled[0] += count
        for k in range(count):
            columns[start[node] + k] = columns[behind + k]
        used[node] = count
    return -1


class NodeAdjacency:
    """Nodes that share an element, of a mesh under cuts; nodes on opposite cut faces share none.

    Args:
        mesh: the mesh; followed by `update`.
    """

    def __init__(self, mesh: TetMesh) -> None:
        self._mesh = mesh
        n = mesh.node_count
        none = np.zeros(n, np.int64)
        self._rows = AdjacencyRows(none, none.copy(), none.copy(), np.zeros(0, np.int32))
        self._filled = np.zeros(1, np.int64)
        self._seen = np.zeros(0, np.int64)
        self._stamp = 1
        self.update(np.arange(n))

    def update(self, nodes: np.ndarray) -> None:
        """Follow a change of connectivity; `nodes`: `Touched.nodes` of the batch, shape (r,)."""
        n, known, links = self._mesh.node_count, len(self._rows.room), self._mesh.links
        start, used, room = (grown(values, n) for values in self._rows[:3])
        room[known:] = 0
        self._rows = AdjacencyRows(start, used, room, self._rows.columns)
        if len(self._seen) < n:
            self._seen, self._stamp = np.zeros(len(start), np.int64), 1
        left = np.asarray(nodes, np.int64)
        while len(left):
            arrays = links.tetrahedra, links.first_corner, links.corner_next
            full = _gather(self._rows, self._filled, *arrays, left, self._seen, self._stamp)
            self._stamp += len(left)
            if full < 0:
                break
            left = left[full:]
            if self._filled[0] > 64 * n + 4096 and len(left) < n:
                self._filled[0], self._rows.room[:], left = 0, 0, np.arange(n)
            size = int(self._filled[0]) + 16 * len(left) + 4096
            self._rows = self._rows._replace(columns=grown(self._rows.columns, size))

    @property
    def rows(self) -> AdjacencyRows:
        """The rows of the present nodes, the node itself among its neighbours."""
        return self._rows

    def levels(self, nodes: np.ndarray, rings: int, least: int = 0) -> np.ndarray:
        """Return the distance of all nodes from some, in edges, up to `rings`, shape (n,).

        Args:
            nodes: start nodes, in any order and with repeats, shape (s,).
            rings: largest distance; farther nodes have a larger level.
            least: smallest number of nodes; with fewer, the distance grows.
        """
        n, seeds = self._mesh.node_count, np.asarray(nodes, np.int64)
        return np.asarray(_spread(self._rows, n, seeds, rings, least))

    def around(self, nodes: np.ndarray, rings: int, least: int = 0) -> np.ndarray:
        """Return the nodes within the distance of `levels`, sorted, shape (a,)."""
        return np.flatnonzero(self.levels(nodes, rings, least) != _FAR)


@kernel
def _spread(rows, n, nodes, rings, least):
    start, used, columns = rows.start, rows.used, rows.columns
    level = np.full(n, _FAR, np.uint8)
    listed = np.empty(n, np.int64)
    count = 0
    for node in nodes:
        if level[node] == _FAR:
            level[node] = 0
            listed[count] = node
            count += 1
    begin, ring = 0, 0
    while (ring < rings or count < least) and begin < count:
        end = count
        ring += 1
        for k in range(begin, end):
            first = start[listed[k]]
            for slot in range(first, first + used[listed[k]]):
                node = columns[slot]
                if level[node] == _FAR:
                    level[node] = min(ring, _FAR - 1)
                    listed[count] = node
                    count += 1
        begin = end
    return level


@kernel
def intervals(level, most):
    """Return the intervals of nodes whose level is at most `most`, shape (s, 2)."""
    ends = np.empty((level.shape[0] // 2 + 1, 2), np.int64)
    count = 0
    inside = False
    for node in range(level.shape[0]):
        if (level[node] <= most) != inside:
            inside = not inside
            if inside:
                ends[count, 0] = node
            else:
                ends[count, 1] = node
                count += 1
    if inside:
        ends[count, 1] = level.shape[0]
        count += 1
    return ends[:count].copy()


@kernel
def spans_of(nodes):
    """Return the intervals of sorted nodes, shape (s, 2)."""
    ends = np.empty((nodes.shape[0], 2), np.int64)
    count = 0
    for node in nodes:
        if count > 0 and ends[count - 1, 1] == node:
            ends[count - 1, 1] = node + 1
        else:
            ends[count, 0], ends[count, 1] = node, node + 1
            count += 1
    return ends[:count].copy()


@kernel
def without(nodes, others):
    """Return the sorted nodes that are not among other sorted nodes."""
    out = np.empty(nodes.shape[0], np.int64)
    count = at = 0
    for node in nodes:
        while at < others.shape[0] and others[at] < node:
            at += 1
        if at == others.shape[0] or others[at] != node:
            out[count] = node
            count += 1
    return out[:count].copy()


def chunks_around(mesh: TetMesh, nodes: np.ndarray, lanes: int) -> np.ndarray:
    """Return the chunks with an element of some nodes, `lanes` elements each, sorted, shape
    (k,).
    """
    links, count = mesh.links, -(-len(mesh.tetrahedra) // lanes)
    return np.flatnonzero(_chunks(links.first_corner, links.corner_next, nodes, lanes, count))


@kernel
def _chunks(first_corner, corner_next, nodes, lanes, count):
    out = np.zeros(count, np.bool_)
    for node in nodes:
        corner = first_corner[node]
        while corner >= 0:
            out[corner // (4 * lanes)] = True
            corner = corner_next[corner]
    return out


def nodes_of_chunks(mesh: TetMesh, chunks: np.ndarray, lanes: int) -> np.ndarray:
    """Return the nodes of the elements of some chunks, with repeats, shape (c,)."""
    elements = (chunks[:, None] * lanes + np.arange(lanes)).ravel()
    return mesh.tetrahedra[elements[elements < len(mesh.tetrahedra)]].ravel()
