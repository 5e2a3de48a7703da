"""Division of a region's work into parts: its rows, domains and elements, and its nodes.

A part has nodes that are near each other in memory, as far as those of the mesh are in space. Then
few parts have forces at the same nodes.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.elasticity.rotation import LANES

MAX_PARTS, _NODES_OF_PART = 16, 800
"""Parts into which the work is divided at most, and moving nodes for each: of smaller parts, most
nodes belong to several. Their number does not depend on that of the threads, and so no bit does."""


class Shared(NamedTuple):
    """Things of all parts, one part after the other.

    Attributes:
        values: intervals or numbers.
        begins: place of the first one of each of p parts, and of the end, shape (p + 1,).
    """

    values: np.ndarray
    begins: np.ndarray


class Division(NamedTuple):
    """Division of the work into parts.

    Attributes:
        rows, domains, chunks: `awake`, `spans` and `chunks` of the operands of each part.
        reach: nodes that it reads and writes.
        moved: nodes that it moves, in intervals at each of which the same parts have forces.
        givers: of all nodes: which parts have forces there, as bits, shape (n,).
        counters: those of the law, shape (p, 2).
        candidates: likewise, in as many places as the part has elements.
    """

    rows: Shared
    domains: Shared
    chunks: Shared
    reach: Shared
    moved: Shared
    givers: np.ndarray
    counters: np.ndarray
    candidates: np.ndarray


@inner(error_model='numpy')
def of_part(shared, part):
    """Return the things of one part."""
    return shared.values[shared.begins[part] : shared.begins[part + 1]]


@inner
def parts_of(division):
    """Return the number of parts."""
    return division.rows.begins.shape[0] - 1


@kernel
def shared_out(spans, cost, parts):
    """Divide intervals into parts that cost about the same.

    Args:
        spans: intervals, shape (s, 2).
        cost: of each index, 0 or more, to which 1 is added; there is nothing after the last, shape
            (n,).
        parts: their number.

    Returns:
        Their intervals, shape (k, 2), and the first of each, see `Shared`.
    """
    total = 0.0
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(spans[s, 1], cost.shape[0])):
            total += 1.0 + cost[i]
    out, begins = np.empty((spans.shape[0] + parts, 2), np.int64), np.zeros(parts + 1, np.int64)
    count, part, spent = 0, 0, 0.0
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(spans[s, 1], cost.shape[0])):
            starts = i == spans[s, 0]
            while part < parts - 1 and spent * parts >= total * (part + 1):
                part += 1
                begins[part] = count
                starts = True
            spent += 1.0 + cost[i]
            if starts:
                out[count, 0] = i
                count += 1
            out[count - 1, 1] = i + 1
    begins[part + 1 :] = count
    return out[:count].copy(), begins


@kernel
def _reached(operands, rows, domains, chunks, count):
    """Return which parts have forces at each node or read it, as bits, shape (count,)."""
    out = np.zeros(count, np.int64)
    for part in range(rows.begins.shape[0] - 1):
        bit = np.int64(1) << part
        _mark_rows(operands.rows, of_part(rows, part), bit, out, True)
        _mark_rows(operands.domains, of_part(domains, part), bit, out, False)
        for chunk in of_part(chunks, part):
            for corner in range(4 * LANES * chunk, 4 * LANES * (chunk + 1)):
                out[operands.elements.corners[corner] // 3] |= bit
    return out


@inner
def _mark_rows(rows, spans, bit, out, are_nodes):
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(spans[s, 1], rows.used.shape[0])):
            if are_nodes:
                out[i] |= bit
            for k in range(rows.start[i], rows.start[i] + rows.used[i]):
                out[rows.columns[k] // 3] |= bit


@kernel
def _reach_of_parts(givers, parts):
    """Return the intervals of nodes that each part reaches."""
    begins, before = np.zeros(parts + 1, np.int64), np.int64(0)
    for here in givers:
        if here != before:
            for part in range(parts):
                begins[part + 1] += (here & ~before) >> part & 1
        before = here
    begins[:] = np.cumsum(begins)
    out, at, before = np.empty((begins[parts], 2), np.int64), begins[:parts].copy(), np.int64(0)
    for node in range(givers.shape[0] + 1):
        here = givers[node] if node < givers.shape[0] else np.int64(0)
        if here != before:
            for part in range(parts):
                bit = np.int64(1) << part
                if here & ~before & bit:
                    out[at[part], 0] = node
                elif before & ~here & bit:
                    out[at[part], 1] = node
                    at[part] += 1
        before = here
    return out, begins


@kernel
def _places(chunks, corners):
    """Return the sum of the nodes of each chunk: which are near in it are near in the mesh."""
    out = np.zeros(chunks.shape[0], np.int64)
    for k in range(chunks.shape[0]):
        for corner in range(4 * LANES * chunks[k], 4 * LANES * (chunks[k] + 1)):
            out[k] += corners[corner]
    return out


@kernel
def _alike(moved, givers):
    """Return the intervals of each part divided where the givers change."""
    nodes = 0
    for s in range(moved.values.shape[0]):
        nodes += moved.values[s, 1] - moved.values[s, 0]
    out, begins, count = np.empty((nodes, 2), np.int64), np.zeros_like(moved.begins), 0
    for part in range(begins.shape[0] - 1):
        begins[part] = count
        spans = of_part(moved, part)
        for s in range(spans.shape[0]):
            for node in range(spans[s, 0], spans[s, 1]):
                if node == spans[s, 0] or givers[node] != givers[node - 1]:
                    out[count, 0] = node
                    count += 1
                out[count - 1, 1] = node + 1
    begins[-1] = count
    return out[:count].copy(), begins


def division_of(operands: Operands, spans: np.ndarray, count: int) -> Division:
    """Return the division of the work of a region.

    Args:
        operands: for the forces on its nodes.
        spans: intervals of moving nodes, shape (s, 2).
        count: of nodes, with coarse unknowns.
    """
    moving = int(np.sum(spans[:, 1] - spans[:, 0]))
    parts = min(max(moving // _NODES_OF_PART, 2), MAX_PARTS)
    rows = Shared(*shared_out(operands.awake, operands.rows.used, parts))
    domains = Shared(*shared_out(operands.spans, operands.domains.used, parts))
    # In the order of their nodes: then few parts have forces at the same ones.
    order = np.argsort(_places(operands.chunks, operands.elements.corners), kind='stable')
    begins = len(order) * np.arange(parts + 1) // parts
    chunks = Shared(operands.chunks[order], begins)
    givers = _reached(operands, rows, domains, chunks, count)
    moved = Shared(*shared_out(spans, np.zeros(count, np.int64), parts))
    return Division(
        rows,
        domains,
        chunks,
        Shared(*_reach_of_parts(givers, parts)),
        Shared(*_alike(moved, givers)),
        givers,
        np.zeros((parts, 2), np.int64),
        np.zeros(len(operands.chunks) * LANES, np.int64),
    )
