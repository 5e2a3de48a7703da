"""Snapped nodes that the blade has left: which stay on the cut, and which take a side after all."""

import numpy as np

from cutting_trainer.cutting.geometry import altitude
from cutting_trainer.cutting.lookup import (
    DONE,
    EDGES,
    MINUS,
    NODES,
    PENDING,
    PLUS,
    SNAPPED,
    WAITS_MINUS,
    WAITS_PLUS,
    find_edge,
)
from cutting_trainer.cutting.sliding import can_slide, incident_tetrahedra, slides
from cutting_trainer.node_common.kernels import inner, kernel

_BOTH = 3
_ROUNDS = 5


@inner
def _demands(tables):
    """Return bits of the sides that the crossings of a snapped node ask for, by row: 1 PLUS, 2
    MINUS.
    """
    demands = np.zeros(tables.counts[NODES], np.int8)
    for row in range(tables.counts[EDGES]):
        state = tables.edge_state[row]
        if state != WAITS_PLUS and state != WAITS_MINUS:
            continue
        for i in range(2):
            own = tables.node_row[tables.edge_nodes[row, i]]
            side = tables.node_side[tables.node_row[tables.edge_nodes[row, 1 - i]]]
            wanted = PLUS if (state == WAITS_PLUS) == (i == 0) else MINUS
            demands[own] |= _BOTH if side == wanted else (1 if wanted == PLUS else 2)
    return demands


@inner
def _is_far(row, stroke):
    """Return whether a node would stay far from the surface: it cannot slide onto it."""
    limits, tables = stroke.limits, stroke.tables
    plane = tables.rest_plane[row]
    if abs(plane[3]) <= limits.off:
        return False
    star = incident_tetrahedra(tables.node_id[row], stroke.links, tables)
    return not can_slide(
        star,
        plane,
        stroke.links,
        tables,
        stroke.rest,
        stroke.fixed,
        limits.shape,
        limits.floor,
    )


@inner
def _is_small(row, stroke):
    """Return whether an element around a node is too small to be divided."""
    star = incident_tetrahedra(stroke.tables.node_id[row], stroke.links, stroke.tables)
    rest = stroke.rest
    for k in range(len(star)):
        a, b, c, d = star[k, 0], star[k, 1], star[k, 2], star[k, 3]
        if altitude(rest[a], rest[b], rest[c], rest[d]) < stroke.limits.small:
            return True
    return False


@inner
def _divides_small(row, stroke):
    """Return whether an element is too small to be divided that would be if a node took a side."""
    tables, rest = stroke.tables, stroke.rest
    node = tables.node_id[row]
    star = incident_tetrahedra(node, stroke.links, tables)
    for k in range(len(star)):
        a, b, c, d = star[k, 0], star[k, 1], star[k, 2], star[k, 3]
        if altitude(rest[a], rest[b], rest[c], rest[d]) >= stroke.limits.small:
            continue
        for i in range(1, 4):
            edge = find_edge(tables, node, star[k, i])
            if edge >= 0 and tables.edge_state[edge] in (WAITS_PLUS, WAITS_MINUS):
                return True
    return False


@inner
def _is_hindered(row, held, stroke):
    """Return whether a snapped node around the blade may yet slide and make room for a node."""
    tables = stroke.tables
    star = incident_tetrahedra(tables.node_id[row], stroke.links, tables)
    for k in range(len(star)):
        for i in range(1, 4):
            other = np.int64(tables.node_row[star[k, i]])
            if (
                other >= 0
                and tables.node_side[other] == SNAPPED
                and tables.node_state[other] != DONE
                and np.int64(star[k, i]) in held
            ):
                return True
    return False


@inner
def _take_side(row, demand, tables):
    """Take a snapped node off the cut."""
    tables.node_side[row] = PLUS if demand == 1 else MINUS
    tables.node_state[row] = 0


@inner
def _cut_edges(tables):
    """Let the crossings of edges wait no longer whose ends are on two sides now."""
    for row in range(tables.counts[EDGES]):
        if tables.edge_state[row] == WAITS_PLUS or tables.edge_state[row] == WAITS_MINUS:
            side = tables.node_side[tables.node_row[tables.edge_nodes[row, 0]]]
            if side == -tables.node_side[tables.node_row[tables.edge_nodes[row, 1]]]:
                tables.edge_state[row] = PENDING


@inner
def _settle_blocked(held, stroke):
    """Settle the snapped nodes that cannot slide as things are, and would stay far from the
    surface.

    Such a node waits for its neighbours around the blade, else it takes its side.

    Returns:
        Whether any was settled, and the nodes that wait: they are added to `held`.
    """
    tables, limits = stroke.tables, stroke.limits
    leaves = [np.int64(0) for _ in range(0)]
    waits = [np.int64(0) for _ in range(0)]
    for row in range(tables.counts[NODES]):
        if tables.node_state[row] == PENDING and np.int64(tables.node_id[row]) not in held:
            leaves.append(np.int64(row))
    rows = np.array(leaves, np.int64)
    moved, _ = slides(rows, stroke.links, tables, stroke.rest, stroke.fixed, limits)
    slid = {np.int64(-1)}
    for row in moved:
        slid.add(np.int64(row))
    demands = _demands(tables)
    settled = False
    for row in rows:
        if row in slid or abs(tables.rest_plane[row, 3]) <= limits.off:
            continue
        if _is_hindered(row, held, stroke):
            waits.append(np.int64(tables.node_id[row]))
            settled = True
        elif demands[row] != 0 and demands[row] != _BOTH and not _divides_small(row, stroke):
            _take_side(row, demands[row], tables)
            settled = True
    for node in waits:
        held.add(node)
    return settled, waits


@kernel
def settle_waiting(active, stroke, subdivides):
    """Settle the snapped nodes that the blade has left.

    A node that is not reached, or that cannot slide onto the surface, takes the side that all its
    crossings ask for, and its edges are cut where they are crossed. If they disagree, the surface
    passes on both sides of the node, and it is on the cut; so are nodes of small elements.

    Args:
        active: nodes of the tetrahedra around the blade, shape (a, 4).
        stroke: see `SnapStroke`; its tables are changed.
        subdivides: whether edges may be cut.

    Returns:
        Nodes that wait until the blade has left their neighbours, too, shape (k,).
    """
    tables = stroke.tables
    demands = _demands(tables)
    held = {np.int64(-1)}
    for k in range(len(active)):
        for i in range(4):
            held.add(np.int64(active[k, i]))
    for row in range(tables.counts[NODES]):
        state = tables.node_state[row]
        if demands[row] == 0 or tables.node_side[row] != SNAPPED or state == DONE:
            continue
        if np.int64(tables.node_id[row]) in held:
            continue
        if demands[row] == _BOTH or not subdivides or _is_small(row, stroke):
            tables.node_state[row] = PENDING
        elif state == 0 or _is_far(row, stroke):
            _take_side(row, demands[row], tables)
    _cut_edges(tables)
    waiting = [np.int64(0) for _ in range(0)]
    if subdivides and stroke.limits.off < np.inf:
        for _ in range(_ROUNDS):
            settled, waits = _settle_blocked(held, stroke)
            for node in waits:
                waiting.append(node)
            if not settled:
                break
            _cut_edges(tables)
    return np.array(waiting, np.int64)
