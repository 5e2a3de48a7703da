"""Stiffness rows of some nodes of a large tissue, numbered consecutively.

In the arrays of the whole tissue these nodes are a small part in many pieces, and the symmetric
halves of the stiffness put forces on neighbours that do not need them. In this module, complete
rows of the moving nodes lie side by side. A substep reads nothing else and takes little more than
half the time.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.contact.coupling import Springs
from cutting_trainer.tissue_sim.elasticity.simd import (
    load_four,
    load_three,
    plus_product,
    prefetch,
    put_three,
    spread,
    three,
    total,
)
from cutting_trainer.tissue_sim.elasticity.tensor_mass import StiffnessRows

MAX_LOCAL_NODES = 2000
"""Nodes up to which complete rows are cheaper than symmetric halves: with more, they exceed the
second cache."""
_AHEAD = np.uint64(9 * 64)
"""Prefetch distance in numbers: a tenth less time from 500 nodes on."""


class LocalRows(NamedTuple):
    """Complete rows of the stiffness.

    Attributes:
        first: first slot of each row, and the end of the last, shape (a + 1,); (0,): no rows.
        columns: three times the local node of each tensor, shape (c,).
        blocks: tensors K_ij [N/m], row-major, node tensors among them, and a number that is read
            with the last three, shape (9 c + 1,).
    """

    first: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray


NO_LOCAL_ROWS = LocalRows(np.zeros(0, np.int64), np.zeros(0, np.uint32), np.zeros(0))


class Locality(NamedTuple):
    """Numbering of the selected nodes.

    Attributes:
        moving: number of nodes with rows; they come first.
        at: coordinates of all nodes in the tissue, neighbours last, shape (3 (a + r),).
        local: local number of each node of the tissue, or -1, shape (n,).
        rows: of the nodes.
    """

    moving: int
    at: np.ndarray
    local: np.ndarray
    rows: LocalRows

    def springs(self, springs: Springs) -> Springs:
        """Return the couplings of the tools with local node numbers."""
        return springs._replace(nodes=self.local[springs.nodes])


def locality(
    rows: StiffnessRows, nodes: np.ndarray, around: np.ndarray, others: np.ndarray, size: int
) -> Locality:
    """Select some nodes of a tissue.

    Args:
        rows: symmetric halves of the tissue's stiffness.
        nodes: nodes with rows, sorted, shape (a,).
        around: these and all their neighbours, sorted, shape (b,).
        others: further nodes to include, shape (o,).
        size: nodes of the tissue, n.
    """
    local = np.full(size, -1)
    local[around] = local[others] = len(nodes)
    local[nodes] = -1
    rim = np.flatnonzero(local >= 0)
    members = np.concatenate([nodes, rim])
    local[members] = np.arange(len(members))
    first, columns, blocks = _gather(rows, around, local, len(nodes))
    at = (3 * members[:, None] + np.arange(3)).ravel()
    return Locality(len(nodes), at, local, LocalRows(first, columns, blocks))


@kernel
def _gather(rows, around, local, count):
    """Return complete rows of the nodes whose local number is below `count`."""
    first = np.zeros(count + 1, np.int64)
    for node in around:
        i = local[node]
        if i < count:
            first[i + 1] += 1
        for slot in range(rows.start[node], rows.start[node] + rows.used[node]):
            j = local[rows.columns[slot] // 3]
            if i < count:
                first[i + 1] += 1
            if 0 <= j < count:
                first[j + 1] += 1
    for i in range(count):
        first[i + 1] += first[i]
    end = first[:count].copy()
    columns, blocks = np.empty(first[count], np.uint32), np.empty(9 * first[count] + 1)
    blocks[-1] = 0.0
    for node in around:
        i = local[node]
        if i < count:
            d, q = rows.diagonal[6 * node : 6 * node + 6], 9 * end[i]
            columns[end[i]] = 3 * i
            blocks[q], blocks[q + 1], blocks[q + 2] = d[0], d[1], d[2]
            blocks[q + 3], blocks[q + 4], blocks[q + 5] = d[1], d[3], d[4]
            blocks[q + 6], blocks[q + 7], blocks[q + 8] = d[2], d[4], d[5]
            end[i] += 1
        for slot in range(rows.start[node], rows.start[node] + rows.used[node]):
            j = local[rows.columns[slot] // 3]
            block = rows.blocks[9 * slot : 9 * slot + 9]
            if i < count:
                columns[end[i]] = 3 * j
                blocks[9 * end[i] : 9 * end[i] + 9] = block
                end[i] += 1
            if 0 <= j < count:
                columns[end[j]] = 3 * i
                for k in range(3):
                    for m in range(3):
                        blocks[9 * end[j] + 3 * m + k] = block[3 * k + m]
                end[j] += 1
    return first, columns, blocks


_U3, _U6, _U9 = (np.uint64(i) for i in (3, 6, 9))


@inner(fastmath=True, error_model='numpy')
def local_product(rows, u, f):
    """Write the product K u of complete rows.

    Args:
        rows: see `LocalRows`.
        u: displacement by local coordinate [m], shape (3 (a + r),).
        f: output [N], of the a nodes with rows, shape (>= 3 a,).
    """
    first, columns, blocks = rows.first, rows.columns, rows.blocks
    for i in range(first.shape[0] - 1):
        a0 = a1 = a2 = spread(0.0)
        for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
            there, q = load_three(u, np.uint64(columns[k])), _U9 * k
            prefetch(blocks, q + _AHEAD)
            a0 = plus_product(a0, load_four(blocks, q), there)
            a1 = plus_product(a1, load_four(blocks, q + _U3), there)
            a2 = plus_product(a2, load_four(blocks, q + _U6), there)
        put_three(f, _U3 * np.uint64(i), three(total(a0), total(a1), total(a2)))
