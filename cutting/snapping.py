"""Node-first snapping (thesis 5.3.3; docs/cutting.md): which nodes the cut goes through, and
where they slide to.
"""

import numpy as np
from numba import njit

from cutting.geometry import altitude
from cutting.lookup import (
    DONE,
    MINUS,
    PENDING,
    PLUS,
    SNAPPED,
    add_edge,
    add_node,
    base_nodes,
    base_of,
    side_of,
)
from tissue_sim.topology import CUT

_EXACT = 1e-6
_LEAST_ALTITUDE_LEFT = 0.4
_FLAT = 1e-10


@njit(cache=True)
def _height(normal, point, x):
    return (
        normal[0] * (x[0] - point[0])
        + normal[1] * (x[1] - point[1])
        + normal[2] * (x[2] - point[2])
    )


@njit(cache=True)
def _oriented(normal, direction):
    """The normal, turned to the side that the stroke's normals have been on so far."""
    dot = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
    return normal if dot >= 0.0 else -normal


@njit(cache=True)
def conflicts(tables, nodes, data, direction, positions):
    """How many hits contradict the sides that nodes are on already: the blade folds back on its own
    cut.

    Args:
        tables: of the stroke.
        nodes, data: hits, as from `find_hits`.
        direction: normal of the stroke so far, shape (3,).
        positions: current nodes [m], shape (n, 3).
    """
    count = 0
    for k in range(len(nodes)):
        normal = _oriented(data[k, 1:4], direction)
        a, b = nodes[k, 0], nodes[k, 1]
        sides = side_of(tables, a), (side_of(tables, b) if b >= 0 else np.int64(0))
        if b < 0:
            count += abs(sides[0]) == 1
            continue
        if sides[0] == SNAPPED or sides[1] == SNAPPED:
            continue
        side = PLUS if _height(normal, data[k, 4:7], positions[a]) > 0.0 else MINUS
        count += sides[0] == -side or sides[1] == side
    return count


@njit(cache=True)
def _is_near(node, point, normal, links, tables, positions, rest, tau, small):
    """Whether the surface, continued as a plane, crosses an edge of a node within tau of it.

    In small elements half an edge is near enough: then only nodes are cut, and no element gets
    smaller.
    """
    height = _height(normal, point, positions[node])
    base = np.empty(4, np.int64)
    longest = 0.0
    nearest = 1.0
    tetrahedra, corner_next, origin = links.tetrahedra, links.corner_next, tables.origin
    owner, parent_nodes = tables.owner, tables.parent_nodes
    corner = links.first_corner[node]
    while corner >= 0:
        base_of(tetrahedra, origin, owner, parent_nodes, corner // 4, base)
        a, b, c, d = rest[base[0]], rest[base[1]], rest[base[2]], rest[base[3]]
        if tau < 0.5 and altitude(a, b, c, d) < small:
            tau = 0.5
        for other in base:
            if other != node:
                far = _height(normal, point, positions[other])
                longest = max(longest, abs(far))
                if far * height < 0.0:
                    nearest = min(nearest, abs(height) / (abs(height) + abs(far)))
        corner = corner_next[corner]
    return nearest < tau or (nearest <= tau and tau == 0.5) or abs(height) <= _EXACT * longest


@njit(cache=True)
def _on_lip(links, node):
    """Whether a node lies on the surface of an earlier cut."""
    face_triangle, kind, corner_next = links.face_triangle, links.triangle_kind, links.corner_next
    corner = links.first_corner[node]
    while corner >= 0:
        tet, local = corner // 4, corner % 4
        for face in range(4):
            k = face_triangle[tet, face]
            if face != local and k >= 0 and kind[k] == CUT:
                return True
        corner = corner_next[corner]
    return False


@njit(cache=True)
def may_slide(links, rest, fixed, node, other):
    """Whether a node can slide towards another without a change of the outer shape.

    The end of an earlier cut, where both lips meet, stays where it is too.
    """
    if fixed[node]:
        return False
    way = rest[other] - rest[node]
    length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    first = np.zeros(3)
    corner = links.first_corner[node]
    while corner >= 0:
        tet, local = corner // 4, corner % 4
        for face in range(4):
            k = links.face_triangle[tet, face]
            if face != local and k >= 0:
                a = rest[links.triangles[k, 0]]
                n = np.cross(rest[links.triangles[k, 1]] - a, rest[links.triangles[k, 2]] - a)
                n /= np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
                if abs(n[0] * way[0] + n[1] * way[1] + n[2] * way[2]) > _FLAT * length:
                    return False
                if n[0] * first[0] + n[1] * first[1] + n[2] * first[2] < -0.9:
                    return False
                first = n
        corner = links.corner_next[corner]
    return True


@njit(cache=True)
def _decide(node, hit, normal, direction, links, tables, positions, rest, limits):
    """Settles whether a node is on the cut, else which side it is on; returns its row."""
    row = tables.node_row[node]
    if row >= 0:
        return np.int64(row)
    point = hit[4:7]
    if _is_near(node, point, direction, links, tables, positions, rest, limits[0], limits[1]):
        row = add_node(tables, node, SNAPPED)
        tables.node_plane[row, :3] = normal
        tables.node_plane[row, 3] = _height(normal, point, positions[node])
        if _on_lip(links, node):
            tables.node_state[row] = PENDING
        return np.int64(row)
    side = PLUS if _height(normal, point, positions[node]) > 0.0 else MINUS
    return np.int64(add_node(tables, node, side))


@njit(cache=True)
def _join_old_front(a, b, hit, normal, direction, links, tables, positions, rest, limits):
    """Nodes of an earlier cut, near the surface and in an element at a and b, are on it at once.

    Otherwise a bridge is left between where one stroke ended and where the next begins.
    """
    base = np.empty(4, np.int64)
    tetrahedra, corner_next, origin = links.tetrahedra, links.corner_next, tables.origin
    owner, parent_nodes, node_row = tables.owner, tables.parent_nodes, tables.node_row
    corner = links.first_corner[a]
    while corner >= 0:
        base_of(tetrahedra, origin, owner, parent_nodes, corner // 4, base)
        corner = corner_next[corner]
        if base[0] != b and base[1] != b and base[2] != b and base[3] != b:
            continue
        for node in base:
            if (
                node_row[node] < 0
                and _on_lip(links, node)
                and _is_near(
                    node, hit[4:7], direction, links, tables, positions, rest, limits[0], limits[1]
                )
            ):
                _decide(node, hit, normal, direction, links, tables, positions, rest, limits)


@njit(cache=True)
def _reach(
    row, other, share, hit, normal, direction, links, tables, positions, rest, fixed, limits
):
    """The blade crosses an edge of a snapped node, `share` of the way to `other`."""
    node = tables.node_id[row]
    if share <= 0.5 and tables.node_state[row] == 0:
        tables.node_state[row] = PENDING
        _join_old_front(node, node, hit, normal, direction, links, tables, positions, rest, limits)
    gap = positions[other] - positions[node]
    length = share * np.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    if length < tables.slide[row, 1]:
        if other == node or may_slide(links, rest, fixed, node, other):
            tables.slide_to[row] = other if other != node else -1
            tables.slide[row, 0] = share
            tables.slide[row, 1] = length
        tables.node_plane[row, :3] = normal
        tables.node_plane[row, 3] = _height(normal, hit[4:7], positions[node])


@njit(cache=True)
def _enter_edge(a, b, hit, normal, direction, links, tables, positions, rest, limits):
    """The blade crosses an edge whose ends are on different sides."""
    add_edge(tables, a, b, hit[0], normal)
    _join_old_front(a, b, hit, normal, direction, links, tables, positions, rest, limits)


@njit(cache=True)
def register(nodes, data, direction, links, tables, positions, rest, fixed, limits):
    """Enters hits in the look-up tables; hits that contradict known sides are passed over.

    Args:
        nodes, data: hits, as from `find_hits`.
        direction: normal of the stroke so far, unit, shape (3,).
        links, tables: mesh and stroke; the tables have room for two nodes and an edge by hit and
            their rings.
        positions, rest: nodes now and at rest [m], shape (n, 3).
        fixed: shape (n,).
        limits: tau, altitude below which only nodes are cut [m], shape (2,).
    """
    for k in range(len(nodes)):
        hit = data[k]
        normal = _oriented(hit[1:4], direction)
        a, b = nodes[k, 0], nodes[k, 1]
        first = _decide(a, hit, normal, direction, links, tables, positions, rest, limits)
        if b < 0:
            if tables.node_side[first] == SNAPPED:
                _reach(
                    first,
                    a,
                    0.0,
                    hit,
                    normal,
                    direction,
                    links,
                    tables,
                    positions,
                    rest,
                    fixed,
                    limits,
                )
            continue
        second = _decide(b, hit, normal, direction, links, tables, positions, rest, limits)
        for row, other, share in ((first, b, hit[0]), (second, a, 1.0 - hit[0])):
            if tables.node_side[row] == SNAPPED:
                _reach(
                    row,
                    other,
                    share,
                    hit,
                    normal,
                    direction,
                    links,
                    tables,
                    positions,
                    rest,
                    fixed,
                    limits,
                )
        if tables.node_side[first] == -tables.node_side[second]:
            _enter_edge(a, b, hit, normal, direction, links, tables, positions, rest, limits)


@njit(cache=True)
def slides(rows, links, tables, rest, floor):
    """Which nodes slide onto the swept surface; a node that would spoil an element stays where it
    is.

    Args:
        rows: of nodes that are newly on the cut, shape (k,).
        links, tables: mesh and stroke.
        rest: [m], shape (n, 3).
        floor: smallest altitude of an element [m].

    Returns:
        By moved node: its row, shape (j,), and its new rest position [m], shape (j, 3).
    """
    moved = np.empty(len(rows), np.int64)
    where = np.empty((len(rows), 3))
    at: dict[int, int] = {}
    count = 0
    fresh = set(rows)
    base = np.empty(4, np.int64)
    corners = np.empty((4, 3))
    for row in rows:
        other = tables.slide_to[row]
        if other < 0:
            continue
        far = tables.node_row[other]
        if far >= 0 and tables.node_state[far] == DONE and far not in fresh:
            continue
        node = tables.node_id[row]
        share = tables.slide[row, 0]
        target = (1.0 - share) * rest[node] + share * rest[other]
        sound = True
        corner = links.first_corner[node]
        while corner >= 0 and sound:
            base_nodes(tables, links, corner // 4, base)
            for i in range(4):
                corners[i] = where[at[base[i]]] if base[i] in at else rest[base[i]]
            before = altitude(corners[0], corners[1], corners[2], corners[3])
            for i in range(4):
                if base[i] == node:
                    corners[i] = target
            after = altitude(corners[0], corners[1], corners[2], corners[3])
            sound = after >= max(floor, _LEAST_ALTITUDE_LEFT * before)
            corner = links.corner_next[corner]
        if sound:
            moved[count] = row
            where[count] = target
            at[node] = count
            count += 1
    return moved[:count], where[:count]
