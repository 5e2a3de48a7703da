"""Coarse unknowns of a tissue: they move its far nodes, beside nodes that move on their own.

They follow the nodes in u and f. The displacement of a far node is its base, which it had when the
unknowns were 0, plus an interpolation of them. Of the far nodes only those that elements share with
free nodes are evaluated; the stiffness of all other elements is reduced to the unknowns.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner
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
    unpack,
)


class CoarseRows(NamedTuple):
    """Operands of the coarse unknowns, c of them with three coordinates each.

    Attributes:
        start: coordinate of the first unknown in u and f.
        nodes: three times the evaluated far nodes, shape (r,).
        base: their displacement while the unknowns are 0 [m], shape (3 r,).
        columns: three times their unknowns, shape (8 r,).
        weights: of these, shape (8 r,).
        used: number of each unknown's neighbours below it, itself included, shape (c,).
        neighbours: three times these, itself first, in as many slots for each, shape (c s,).
        blocks: tensors of the reduced stiffness [N/m], row-major, and a number that is read with
            the last three, shape (9 c s + 1,); the transpose serves the other row.
        force: elastic force on the unknowns while they are 0, less that of the evaluated part [N],
            shape (3 c,).
    """

    start: int
    nodes: np.ndarray
    base: np.ndarray
    columns: np.ndarray
    weights: np.ndarray
    used: np.ndarray
    neighbours: np.ndarray
    blocks: np.ndarray
    force: np.ndarray


NO_COARSE_ROWS = CoarseRows(
    0, np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros(0),
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0),
)  # fmt: skip

_U3, _U6, _U8, _U9 = (np.uint64(i) for i in (3, 6, 8, 9))
_AHEAD = np.uint64(9 * 64)
"""Prefetch distance in numbers."""


@inner(fastmath=True, error_model='numpy')
def lead_far_nodes(coarse, u, unit):
    """Write the displacement of the evaluated far nodes.

    Args:
        coarse: see `CoarseRows`.
        u: displacement by coordinate, with the unknowns [m], shape (3 (n + c),).
        unit: 1, or 0 for a product, without the base.
    """
    start = np.uint64(coarse.start)
    columns, weights, base, nodes = coarse.columns, coarse.weights, coarse.base, coarse.nodes
    for k in range(np.uint64(nodes.shape[0])):
        moved = product(load_three(base, _U3 * k), spread(unit))
        for q in range(_U8 * k, _U8 * k + _U8):
            there = load_three(u, start + np.uint64(columns[q]))
            moved = plus_product(moved, there, spread(weights[q]))
        put_three(u, np.uint64(nodes[k]), moved)


@inner(fastmath=True, error_model='numpy')
def put_coarse_forces(coarse, u, f, unit):
    """Write the forces on the unknowns; arguments: see `lead_far_nodes`.

    Args:
        f: forces [N], those on the evaluated far nodes in it, shape (3 (n + c),).
    """
    used, neighbours, blocks = coarse.used, coarse.neighbours, coarse.blocks
    start, room = np.uint64(coarse.start), np.uint64(neighbours.shape[0] // max(used.shape[0], 1))
    for a in range(np.uint64(used.shape[0])):
        here = load_three(u, start + _U3 * a)
        x, y, z = unpack(here)
        xs, ys, zs = spread(x), spread(y), spread(z)
        a0 = a1 = a2 = spread(0.0)
        for k in range(room * a, room * a + np.uint64(used[a])):
            q, there = _U9 * k, start + np.uint64(neighbours[k])
            prefetch(blocks, q + _AHEAD)
            b0, b1 = load_four(blocks, q), load_four(blocks, q + _U3)
            b2 = load_four(blocks, q + _U6)
            moved = load_three(u, there)
            a0, a1 = plus_product(a0, b0, moved), plus_product(a1, b1, moved)
            a2 = plus_product(a2, b2, moved)
            if k > room * a:
                add_three(f, there, plus_product(plus_product(product(b0, xs), b1, ys), b2, zs))
        own = three(total(a0), total(a1), total(a2))
        own = plus_product(own, load_three(coarse.force, _U3 * a), spread(unit))
        put_three(f, start + _U3 * a, own)
    columns, weights, nodes = coarse.columns, coarse.weights, coarse.nodes
    for far in range(np.uint64(nodes.shape[0])):
        here = load_three(f, np.uint64(nodes[far]))
        for slot in range(_U8 * far, _U8 * far + _U8):
            there = start + np.uint64(columns[slot])
            add_three(f, there, product(here, spread(weights[slot])))
