"""Tensor-mass method: node and edge tensors of the stiffness, gathered from the nodes' elements.

Cotin 2000; thesis 4.3. The stiffness is stored as the symmetric 3x3 tensor of each node and the
tensor of each edge (i, j), j < i, in the row of i; the transpose serves row j. Row after row, the
force on a node is first written and later added to, so no array needs clearing. Rows are packed,
because memory between them would be loaded with them. A row that outgrows its slots moves behind
the last one.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.simd import (
    add_three,
    load_four,
    load_three,
    plus_product,
    prefetch,
    product,
    put_three,
    spread,
    three,
    total,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown
from cutting_trainer.tissue_sim.mesh.topology import of_region

ONE_MATERIAL = np.ones(1)
"""Relative stiffness by region of a tissue of one material."""


class Tensors(NamedTuple):
    """Arrays of the model; row i of a node spans `start[i]` to `start[i] + used[i]`.

    Attributes:
        diagonal: node tensors [N/m], xx xy xz yy yz zz, shape (n, 6).
        start, used, room: first slot, used slots and slots of each row, shape (n,).
        columns: three times the node j of each edge tensor, with some after the last row, shape
            (c,).
        blocks: edge tensors K_ij [N/m], row-major, shape (9 c,).
    """

    diagonal: np.ndarray
    start: np.ndarray
    used: np.ndarray
    room: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray


class StiffnessRows(NamedTuple):
    """Operands of `put_rows`: the `Tensors` of the present nodes, `diagonal` flat."""

    start: np.ndarray
    used: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray
    diagonal: np.ndarray


@inner
def shape_gradients(rest, tetrahedra, tet, gradients):
    """Return gradients of the four linear shape functions of a tetrahedron.

    They are the M vectors of the thesis over 6 V; eq. 4.8 as printed lacks a factor (-1)^j.

    Args:
        rest: rest positions [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        tet: which one.
        gradients: output [1/m], shape (4, 3).

    Returns:
        Signed volume [m^3].
    """
    o, p, q, r = tetrahedra[tet, 0], tetrahedra[tet, 1], tetrahedra[tet, 2], tetrahedra[tet, 3]
    ax, ay, az = rest[p, 0] - rest[o, 0], rest[p, 1] - rest[o, 1], rest[p, 2] - rest[o, 2]
    bx, by, bz = rest[q, 0] - rest[o, 0], rest[q, 1] - rest[o, 1], rest[q, 2] - rest[o, 2]
    cx, cy, cz = rest[r, 0] - rest[o, 0], rest[r, 1] - rest[o, 1], rest[r, 2] - rest[o, 2]
    g = gradients
    g[1, 0], g[1, 1], g[1, 2] = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    g[2, 0], g[2, 1], g[2, 2] = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    g[3, 0], g[3, 1], g[3, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    determinant = ax * g[1, 0] + ay * g[1, 1] + az * g[1, 2]
    for i in range(3):
        for k in range(1, 4):
            g[k, i] /= determinant
        g[0, i] = -(g[1, i] + g[2, i] + g[3, i])
    return determinant / 6.0


@kernel
def longer(room):
    """Return the new number of slots for a row that has outgrown its own."""
    return room + room // 2 + 8


@inner
def move_row(start, used, room, columns, values, filled, node):
    """Move a row behind the last one, with more slots.

    Args:
        start, used, room: see `Tensors`.
        columns: of all rows, shape (c,).
        values: as many for each column, shape (w c,).
        filled: slots allocated to rows, shape (1,).
        node: which row.

    Returns:
        False: the arrays are too short.
    """
    width = values.shape[0] // columns.shape[0]
    size, at, first = longer(room[node]), filled[0], start[node]
    if at + size >= columns.shape[0]:  # one to spare: see `put_rows`
        return False
    for k in range(used[node]):
        columns[at + k] = columns[first + k]
        for i in range(width):
            values[width * (at + k) + i] = values[width * (first + k) + i]
    start[node], room[node], filled[0] = at, size, at + size
    return True


@kernel
def _pack(start, used, room, count, columns, values, packed_columns, packed_values):
    width, at = values.shape[0] // columns.shape[0], 0
    for node in range(count):
        first = start[node]
        for k in range(used[node]):
            packed_columns[at + k] = columns[first + k]
            for i in range(width):
                packed_values[width * (at + k) + i] = values[width * (first + k) + i]
        start[node], room[node] = at, used[node]
        at += used[node]
    room[count:] = 0


def packed(
    start: np.ndarray,
    used: np.ndarray,
    room: np.ndarray,
    count: int,
    columns: np.ndarray,
    values: np.ndarray,
    filled: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and values with packed rows, if one slot in nine is idle.

    Values and order stay the same, and therefore all results. It may be called between any two
    frames, and costs a copy.

    Args:
        start, used, room: see `Tensors`; changed, shape (>= count,).
        count: of nodes.
        columns: of all rows, shape (c,).
        values: as many for each column, shape (w c,).
        filled: slots allocated to rows; changed, shape (1,).

    Returns:
        The given arrays, or new ones with as much spare room again.
    """
    slots = int(used[:count].sum())
    if filled[0] <= slots + slots // 8 + 1024:
        return columns, values
    width = len(values) // len(columns)
    most = 2 * slots
    out = np.zeros(most, columns.dtype), np.zeros(width * most)
    _pack(start, used, room, count, columns, values, *out)
    filled[0] = slots
    return out


@inner
def _edge_slot(tensors, filled, node, column):
    """Return the slot of an edge in the row of `node`, created if there is room.

    -1 without room.
    """
    first = tensors.start[node]
    for slot in range(first, first + tensors.used[node]):
        if tensors.columns[slot] == column:
            return slot
    if tensors.used[node] == tensors.room[node]:
        t = tensors
        if not move_row(t.start, t.used, t.room, t.columns, t.blocks, filled, node):
            return -1
    slot = tensors.start[node] + tensors.used[node]
    tensors.used[node] += 1
    tensors.columns[slot] = column
    for i in range(9):
        tensors.blocks[9 * slot + i] = 0.0
    return slot


@kernel
def gather_rows(tensors, filled, links, rest, nodes, lame_lambda, lame_mu, relative):
    """Compute the rows of some nodes from their elements.

    Thesis eq. 4.7, transposed as it must be:
    K_jk = V (lambda g_j g_k^T + mu g_k g_j^T + mu (g_j . g_k) I) is the force on j by the
    displacement of k.

    Args:
        tensors: written for `nodes` only.
        filled: slots allocated to rows; grows with moved rows, shape (1,).
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        nodes: which rows, shape (r,).
        lame_lambda, lame_mu: [Pa].
        relative: stiffness by region, relative to these.

    Returns:
        Index into `nodes` of the first whose row does not fit in the arrays, or -1.
    """
    g = np.empty((4, 3))
    for which in range(len(nodes)):
        node = nodes[which]
        tensors.used[node] = 0
        for i in range(6):
            tensors.diagonal[node, i] = 0.0
        corner = links.first_corner[node]
        while corner >= 0:
            tet, a = corner // 4, corner % 4
            volume = shape_gradients(rest, links.tetrahedra, tet, g) * of_region(
                links, tet, relative
            )
            dot = volume * lame_mu * (g[a, 0] * g[a, 0] + g[a, 1] * g[a, 1] + g[a, 2] * g[a, 2])
            both = volume * (lame_lambda + lame_mu)
            tensors.diagonal[node, 0] += both * g[a, 0] * g[a, 0] + dot
            tensors.diagonal[node, 1] += both * g[a, 0] * g[a, 1]
            tensors.diagonal[node, 2] += both * g[a, 0] * g[a, 2]
            tensors.diagonal[node, 3] += both * g[a, 1] * g[a, 1] + dot
            tensors.diagonal[node, 4] += both * g[a, 1] * g[a, 2]
            tensors.diagonal[node, 5] += both * g[a, 2] * g[a, 2] + dot
            for b in range(4):
                other = links.tetrahedra[tet, b]
                if other < node:
                    slot = _edge_slot(tensors, filled, node, 3 * other)
                    if slot < 0:
                        return which
                    dot = g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2]
                    for i in range(3):
                        for k in range(3):
                            value = lame_lambda * g[a, i] * g[b, k] + lame_mu * g[b, i] * g[a, k]
                            if i == k:
                                value += lame_mu * dot
                            tensors.blocks[9 * slot + 3 * i + k] += volume * value
            corner = links.corner_next[corner]
    return -1


_AHEAD = np.uint64(9 * 128)
"""Prefetch distance of `put_rows` in numbers: 9 kB, a quarter of the first cache. It halves the
time for 200,000 tetrahedra, which exceed the second cache."""
_U1, _U2, _U3, _U4, _U5, _U6, _U9 = (np.uint64(i) for i in (1, 2, 3, 4, 5, 6, 9))


@inner(fastmath=True, error_model='numpy')
def put_rows(rows, awake, u, f):
    """Write the product K u with the symmetric halves of K.

    Indices are unsigned: a sign test for each access costs a third. The arrays are longer than
    their rows, because the last three numbers are read as four.

    Args:
        rows: see `StiffnessRows`.
        awake: intervals of evaluated rows, ascending, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        f: output [N], written at these nodes and added to at their neighbours, shape (3 n,).
    """
    start, used, columns = rows.start, rows.used, rows.columns
    blocks, diagonal = rows.blocks, rows.diagonal
    for s in range(awake.shape[0]):
        _put_interval(start, used, columns, blocks, diagonal, awake[s, 0], awake[s, 1], u, f)


@inner(fastmath=True, error_model='numpy')
def _put_interval(start, used, columns, blocks, diagonal, low, high, u, f):
    for i in range(low, min(high, used.shape[0])):
        row = _U3 * np.uint64(i)
        x, y, z = u[row], u[row + _U1], u[row + _U2]
        q = _U6 * np.uint64(i)
        xx, xy, xz = diagonal[q], diagonal[q + _U1], diagonal[q + _U2]
        yy, yz, zz = diagonal[q + _U3], diagonal[q + _U4], diagonal[q + _U5]
        own_x = xx * x + xy * y + xz * z
        own_y = xy * x + yy * y + yz * z
        own_z = xz * x + yz * y + zz * z
        xs, ys, zs = spread(x), spread(y), spread(z)
        a0 = a1 = a2 = spread(0.0)
        first = np.uint64(start[i])
        for k in range(first, first + np.uint64(used[i])):
            j = np.uint64(columns[k])
            q = _U9 * np.uint64(k)
            prefetch(blocks, q + _AHEAD)
            # Rows of the tensor; the spare lane holds the first number of the next one.
            b0, b1 = load_four(blocks, q), load_four(blocks, q + _U3)
            b2, there = load_four(blocks, q + _U6), load_three(u, j)
            a0 = plus_product(a0, b0, there)
            a1 = plus_product(a1, b1, there)
            a2 = plus_product(a2, b2, there)
            add_three(f, j, plus_product(plus_product(product(b0, xs), b1, ys), b2, zs))
        put_three(f, row, three(own_x + total(a0), own_y + total(a1), own_z + total(a2)))


class TensorMass:
    """Stiffness tensors of a mesh under cuts.

    Args:
        mesh: the mesh; followed by `update`.
        lame_lambda, lame_mu: [Pa].
        relative: stiffness by region, relative to these.
    """

    def __init__(
        self,
        mesh: TetMesh,
        lame_lambda: float,
        lame_mu: float,
        relative: np.ndarray = ONE_MATERIAL,
    ) -> None:
        self._mesh = mesh
        self._relative = relative
        self._lame = (lame_lambda, lame_mu)
        n = self._mesh.node_count
        room = np.zeros(n, np.int64)
        tets = np.sort(self._mesh.tetrahedra, axis=1).astype(np.int64)
        pairs = np.concatenate([tets[:, [i, j]] for i in range(4) for j in range(i + 1, 4)])
        edges = np.unique(pairs[:, 0] * n + pairs[:, 1])
        room += np.bincount(edges % n, minlength=n)
        start = np.concatenate([[0], np.cumsum(room)[:-1]])
        slots = int(room.sum())
        # Spare room is free until used: no cut has to move all of the array.
        more, most = n + n // 4, 2 * slots
        self.tensors = Tensors(
            np.zeros((more, 6)),
            grown(start, more),
            np.zeros(more, np.int64),
            grown(room, more),
            np.zeros(most, np.uint32),
            np.zeros(9 * most),
        )
        self._filled = np.array([slots])
        self._gather(np.arange(n))

    def update(self, nodes: np.ndarray) -> None:
        """Recompute the rows of the nodes touched by a change of connectivity.

        Args:
            nodes: `Touched.nodes` of the batch, shape (r,).
        """
        n = self._mesh.node_count
        t = self.tensors
        known = len(t.room)
        self.tensors = t._replace(
            diagonal=grown(t.diagonal, n),
            start=grown(t.start, n),
            used=grown(t.used, n),
            room=grown(t.room, n),
        )
        if len(self.tensors.room) > known:
            self.tensors.room[known:] = 0
        self._gather(np.asarray(nodes, np.int64))
        t = self.tensors
        rows = t.start, t.used, t.room, n
        columns, blocks = packed(*rows, t.columns, t.blocks, self._filled)
        self.tensors = t._replace(columns=columns, blocks=blocks)

    def _gather(self, nodes: np.ndarray) -> None:
        mesh, remaining = self._mesh, nodes
        while len(remaining):
            full = gather_rows(
                self.tensors, self._filled, mesh.links, mesh.rest, remaining, *self._lame,
                self._relative,
            )  # fmt: skip
            if full < 0:
                return
            remaining = remaining[full:]
            t = self.tensors
            size = int(self._filled[0]) + longer.py_func(int(t.room[remaining[0]])) + 1
            columns = grown(t.columns, size)
            self.tensors = t._replace(columns=columns, blocks=grown(t.blocks, 9 * len(columns)))

    @property
    def operands(self) -> StiffnessRows:
        """Return the operands of `put_rows`."""
        n = self._mesh.node_count
        t = self.tensors
        return StiffnessRows(t.start[:n], t.used[:n], t.columns, t.blocks, t.diagonal[:n].ravel())
