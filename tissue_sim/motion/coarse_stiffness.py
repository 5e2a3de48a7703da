"""Stiffness of the far part of a tissue, reduced to the unknowns of a coarse grid.

A row of tensors, a smoothing domain or a chunk of corotational elements is in the sum, or it is
evaluated on its own. It is added or subtracted as a whole, and only its own elements count.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.mesh.adjacency import chunks_around
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown
from cutting_trainer.tissue_sim.motion.coarse_grid import CoarseGrid

_ROOM = 20
"""Slots of a row at first: 14 in a grid, more where cuts split unknowns."""
_LISTED = 1024
"""Largest number of unknowns that move the nodes of a row of tensors."""


@inner
def _listed(ids, values, count, unknown):
    """Return the place of an unknown in a list, and the length of the list.

    An unknown that is not there comes to the end, with values of 0.
    """
    for k in range(count):
        if ids[k] == unknown:
            return k, count
    ids[count] = unknown
    for m in range(values.shape[1]):
        values[count, m] = 0.0
    return count, count + 1


@inner
def _slot(matrix, a, b):
    """Return the slot of unknown b in row a >= b, created if there is room; else -1."""
    used, neighbours, _ = matrix
    room = neighbours.shape[0] // used.shape[0]
    if used[a] == 0:
        neighbours[room * a] = 3 * a
        used[a] = 1
    for k in range(room * a, room * a + used[a]):
        if neighbours[k] == 3 * b:
            return k
    if used[a] == room:
        return -1
    k = room * a + used[a]
    used[a] += 1
    neighbours[k] = 3 * b
    return k


@inner
def _has_room(matrix, ids, count):
    """Create the slots of all pairs; return False where a row is full."""
    for a in range(count):
        for b in range(count):
            if ids[a] >= ids[b] and _slot(matrix, ids[a], ids[b]) < 0:
                return False
    return True


@inner
def _add_point(matrix, ids, count, g, lame_lambda, lame_mu):
    """Add the stiffness of a homogeneous strain; g: gradients of the unknowns [1/m], the moduli
    times the volume [J].
    """
    blocks = matrix[2]
    for a in range(count):
        for b in range(count):
            if ids[a] < ids[b]:
                continue
            q = 9 * _slot(matrix, ids[a], ids[b])
            dot = g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2]
            for i in range(3):
                for k in range(3):
                    value = lame_lambda * g[a, i] * g[b, k] + lame_mu * g[b, i] * g[a, k]
                    blocks[q + 3 * i + k] += value + (lame_mu * dot if i == k else 0.0)


@inner
def _add_gradient(ids, count, g, columns, weights, node, x, y, z):
    """Add the gradient of a node's shape function to those of its unknowns; return their number."""
    for c in range(8):
        w = weights[node, c]
        if w == 0.0:
            continue
        k, count = _listed(ids, g, count, columns[node, c])
        g[k, 0] += w * x
        g[k, 1] += w * y
        g[k, 2] += w * z
    return count


@kernel
def _add_rows(matrix, rows, columns, weights, nodes, sign):
    """Add rows of tensors; return the index into `nodes` of the first without room, or -1."""
    ids, sums = np.empty(_LISTED, np.int64), np.empty((_LISTED, 9))
    blocks = matrix[2]
    own = np.empty(9)
    for which in range(len(nodes)):
        i = nodes[which]
        if rows.used[i] == 0 and rows.diagonal[6 * i] == 0.0:
            continue
        d = rows.diagonal[6 * i : 6 * i + 6]
        own[0], own[1], own[2] = d[0], d[1], d[2]
        own[3], own[4], own[5] = d[1], d[3], d[4]
        own[6], own[7], own[8] = d[2], d[4], d[5]
        count = 0
        for slot in range(rows.start[i] - 1, rows.start[i] + rows.used[i]):
            if slot < rows.start[i]:  # the node itself: half, because each pair is added twice
                node, share, tensor = i, 0.5 * sign, own
            else:
                node, share = rows.columns[slot] // 3, sign
                tensor = rows.blocks[9 * slot : 9 * slot + 9]
            for c in range(8):
                w = weights[node, c]
                if w == 0.0:
                    continue
                k, count = _listed(ids, sums, count, columns[node, c])
                for m in range(9):
                    sums[k, m] += share * w * tensor[m]
        for c in range(8):
            if weights[i, c] == 0.0:
                continue
            for k in range(count):
                a, b = columns[i, c], ids[k]
                if _slot(matrix, max(a, b), min(a, b)) < 0:
                    return which
        for c in range(8):
            w = weights[i, c]
            if w == 0.0:
                continue
            for k in range(count):
                a, b = columns[i, c], ids[k]
                q = 9 * _slot(matrix, max(a, b), min(a, b))
                for m in range(3):
                    for j in range(3):
                        value = w * sums[k, 3 * m + j]
                        if a >= b:
                            blocks[q + 3 * m + j] += value
                        if a <= b:
                            blocks[q + 3 * j + m] += value
    return -1


@kernel
def _add_domains(matrix, domains, columns, weights, nodes, sign):
    """Add smoothing domains; return the index into `nodes` of the first without room, or -1."""
    ids, g = np.empty(_LISTED, np.int64), np.empty((_LISTED, 3))
    for which in range(len(nodes)):
        i, count = nodes[which], 0
        for slot in range(domains.start[i], domains.start[i] + domains.used[i]):
            node, v = domains.columns[slot] // 3, domains.vectors[3 * slot : 3 * slot + 3]
            count = _add_gradient(ids, count, g, columns, weights, node, v[0], v[1], v[2])
        if not _has_room(matrix, ids, count):
            return which
        volume = sign * domains.volume[i]
        _add_point(matrix, ids, count, g, domains.lame[0] * volume, domains.lame[1] * volume)
    return -1


@kernel
def _add_elements(matrix, elements, columns, weights, chunks, sign):
    """Add chunks of elements; return the index into `chunks` of the first without room, or -1."""
    ids, g = np.empty(_LISTED, np.int64), np.empty((_LISTED, 3))
    for which in range(len(chunks)):
        for fitting in (True, False):
            for lane in range(LANES):
                at = chunks[which] * KEPT * LANES + lane
                corner = 4 * chunks[which] * LANES + lane
                if elements.data[at + 13 * LANES] == 0.0:
                    continue
                count = 0
                x0 = y0 = z0 = 0.0
                for a in range(1, 4):
                    x = elements.data[at + (3 * a - 3) * LANES]
                    y = elements.data[at + (3 * a - 2) * LANES]
                    z = elements.data[at + (3 * a - 1) * LANES]
                    x0, y0, z0 = x0 - x, y0 - y, z0 - z
                    node = elements.corners[corner + a * LANES] // 3
                    count = _add_gradient(ids, count, g, columns, weights, node, x, y, z)
                node = elements.corners[corner] // 3
                count = _add_gradient(ids, count, g, columns, weights, node, x0, y0, z0)
                if fitting and not _has_room(matrix, ids, count):
                    return which
                if not fitting:
                    mu = 0.5 * sign * elements.data[at + 13 * LANES]
                    lam = sign * elements.data[at + 14 * LANES]
                    _add_point(matrix, ids, count, g, lam, mu)
    return -1


class CoarseStiffness:
    """Reduced stiffness of all that is not evaluated on its own.

    Args:
        model: the elastic model.
        grid: interpolates its nodes.

    Attributes:
        used, neighbours, blocks: see `CoarseRows`.
    """

    def __init__(self, model: ElasticModel, grid: CoarseGrid) -> None:
        self._model = model
        self._grid = grid
        self.used = np.zeros(0, np.int64)
        self.neighbours = np.zeros(0, np.int64)
        self.blocks = np.zeros(1)
        self._rows = np.zeros(0, bool)
        self._chunks = np.zeros(0, bool)

    def evaluate_apart(self, rows: np.ndarray, nodes: np.ndarray) -> None:
        """Keep all in the sum but the rows and elements that are evaluated on their own.

        Args:
            rows: whether rows and domains of nodes are, shape (n,).
            nodes: whose elements are, shape (a,).
        """
        n, slots = len(rows), -(-len(self._model.mesh.tetrahedra) // LANES)
        self._rows, self._chunks = grown(self._rows, n), grown(self._chunks, slots)
        self._fit(_ROOM)
        wanted = ~rows
        counted = self._rows[:n]
        self._add(np.flatnonzero(counted & ~wanted), -1.0)
        self._add(np.flatnonzero(wanted & ~counted), 1.0)
        if self._of_elements:
            wanted = np.ones(slots, bool)
            wanted[chunks_around(self._model.mesh, nodes, LANES)] = False
            counted = self._chunks[:slots]
            self._add_chunks(np.flatnonzero(counted & ~wanted), -1.0)
            self._add_chunks(np.flatnonzero(wanted & ~counted), 1.0)

    def release(self, nodes: np.ndarray, tetrahedra: np.ndarray) -> None:
        """Take out parts that are about to change; the next `evaluate_apart` adds them again.

        Args:
            nodes: of rows and domains, shape (r,).
            tetrahedra: slots, shape (t,).
        """
        count = len(self._model.mesh.tetrahedra)
        last = np.arange(count // LANES, len(self._chunks))  # of elements that may be gone
        self._take(nodes, np.unique(np.concatenate([tetrahedra // LANES, last])))

    def release_around(self, rows: np.ndarray, nodes: np.ndarray) -> None:
        """Take out rows and domains, shape (r,), and the elements of some nodes, shape (a,)."""
        chunks = chunks_around(self._model.mesh, nodes, LANES) if self._of_elements else nodes[:0]
        self._take(rows, chunks)

    def _take(self, nodes: np.ndarray, chunks: np.ndarray) -> None:
        nodes = nodes[nodes < len(self._rows)]
        self._add(nodes[self._rows[nodes]], -1.0)
        if self._of_elements:
            chunks = chunks[chunks < len(self._chunks)]
            self._add_chunks(chunks[self._chunks[chunks]], -1.0)

    @property
    def diagonal(self) -> np.ndarray:
        """Diagonal of the sum [N/m], shape (3 c,)."""
        first = self._room * np.arange(len(self.used))
        out = self.blocks[9 * first[:, None] + np.array([0, 4, 8])]
        return out.ravel()

    @property
    def _of_elements(self) -> bool:
        return self._model.rotating and not self._model.lawful

    def _add(self, nodes: np.ndarray, sign: float) -> None:
        o = self._model.operands()
        self._rows[nodes] = sign > 0.0
        if len(o.rows.used):
            self._all(_add_rows, o.rows, nodes, sign)
        if self._model.smoothing is not None:
            self._all(_add_domains, o.domains, self._model.smoothing.rows(nodes), sign)

    def _add_chunks(self, chunks: np.ndarray, sign: float) -> None:
        self._chunks[chunks] = sign > 0.0
        self._all(_add_elements, self._model.operands().elements, chunks, sign)

    def _all(self, add, parts, which: np.ndarray, sign: float) -> None:  # type: ignore[no-untyped-def]
        grid = self._grid
        while len(which):
            matrix = self.used, self.neighbours, self.blocks
            full = add(matrix, parts, grid.columns, grid.weights, which, sign)
            if full < 0:
                return
            which = which[full:]
            self._fit(2 * self._room)

    @property
    def _room(self) -> int:
        return len(self.neighbours) // max(len(self.used), 1)

    def _fit(self, room: int) -> None:
        """Make room for the unknowns of the grid, and for so many neighbours of each."""
        count, known, had = self._grid.count, len(self.used), self._room
        room = max(room, had)
        if (count, room) == (known, had):
            return
        neighbours, blocks = np.zeros((count, room), np.int64), np.zeros((count, room, 9))
        neighbours[:known, :had] = self.neighbours.reshape(known, had)
        blocks[:known, :had] = self.blocks[: 9 * known * had].reshape(known, had, 9)
        self.used = grown(self.used, count)[:count].copy()
        self.neighbours, self.blocks = neighbours.ravel(), np.append(blocks.ravel(), 0.0)
