"""Node-first snapping (thesis 5.3.3; docs/cutting.md): which nodes the cut goes through."""

from typing import NamedTuple

import numpy as np
from numba import njit

from cutting.geometry import altitude, height
from cutting.lookup import (
    MINUS,
    PENDING,
    PLUS,
    SNAPPED,
    Tables,
    add_edge,
    add_node,
    base_of,
    side_of,
)
from cutting.sliding import can_slide, rest_plane, star_of
from tissue_sim.topology import CUT, Links

_EXACT = 1e-6


class Limits(NamedTuple):
    """What decides whether a node goes to the cut.

    Attributes:
        tau: a crossing nearer to a node than this share of its edge goes to the node.
        off: how far from the surface a node on the cut may stay that cannot slide onto it [m].
        thin: no such node is left off the cut for an element that would be flatter than this [m].
        small: altitude of an element below which only nodes are cut [m].
        floor: smallest altitude of a new element [m].
        shape: how far a node may leave the surface of the tissue [m].
    """

    tau: float
    off: float
    thin: float
    small: float
    floor: float
    shape: float


class Stroke(NamedTuple):
    """A step of a stroke, for the kernels of this module.

    Attributes:
        direction: normal of the stroke so far, unit, shape (3,).
        links, tables: mesh and stroke.
        positions, rest: nodes now and at rest [m], shape (n, 3).
        fixed: shape (n,).
        limits: see `Limits`.
    """

    direction: np.ndarray
    links: Links
    tables: Tables
    positions: np.ndarray
    rest: np.ndarray
    fixed: np.ndarray
    limits: Limits


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
        side = PLUS if height(normal, data[k, 4:7], positions[a]) > 0.0 else MINUS
        count += sides[0] == -side or sides[1] == side
    return count


@njit(cache=True)
def _nearness(star, point, stroke):
    """How near to a node the surface, continued as a plane, crosses its edges.

    Args:
        star: around the node, see `star_of`.
        point: of the surface [m], shape (3,).
        stroke: a `Stroke`.

    Returns:
        Least share of an edge, 1 if none is crossed; and the least altitude around the node [m].
    """
    positions, rest, direction = stroke.positions, stroke.rest, stroke.direction
    above = height(direction, point, positions[star[0, 0]])
    longest = 0.0
    nearest = 1.0
    smallest = np.inf
    for k in range(len(star)):
        a, b, c, d = star[k, 0], star[k, 1], star[k, 2], star[k, 3]
        smallest = min(smallest, altitude(rest[a], rest[b], rest[c], rest[d]))
        for i in range(1, 4):
            far = height(direction, point, positions[star[k, i]])
            longest = max(longest, abs(far))
            if far * above < 0.0:
                nearest = min(nearest, abs(above) / (abs(above) + abs(far)))
    return (0.0 if abs(above) <= _EXACT * longest else nearest), smallest


@njit(cache=True)
def _is_near(node, point, stroke):
    """Whether a node goes to the cut: the surface crosses one of its edges within tau of it.

    Where it could not slide onto the surface, it has to be nearer. In small elements half an edge
    is near enough: then only nodes are cut, and no element gets smaller.
    """
    limits = stroke.limits
    star = star_of(node, stroke.links, stroke.tables)
    nearest, smallest = _nearness(star, point, stroke)
    if limits.tau == 0.5 or smallest < limits.small:
        return nearest <= 0.5
    if nearest >= limits.tau or nearest == 0.0:
        return nearest < limits.tau
    plane = np.empty(4)
    rest_plane(star, stroke.direction, point, stroke.positions, stroke.rest, plane)
    if abs(plane[3]) < limits.off or nearest * smallest < limits.thin:
        return True
    return can_slide(
        star,
        plane,
        stroke.links,
        stroke.tables,
        stroke.rest,
        stroke.fixed,
        limits.shape,
        limits.floor,
    )


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
def _decide(node, hit, stroke):
    """Settles whether a node is on the cut, else which side it is on; returns its row."""
    tables = stroke.tables
    row = np.int64(tables.node_row[node])
    if row >= 0:
        return row
    if not _is_near(node, hit[4:7], stroke):
        above = height(hit[1:4], hit[4:7], stroke.positions[node])
        return np.int64(add_node(tables, node, PLUS if above > 0.0 else MINUS))
    row = np.int64(add_node(tables, node, SNAPPED))
    _lay_plane(row, hit, stroke)
    if _on_lip(stroke.links, node):
        tables.node_state[row] = PENDING
    return row


@njit(cache=True)
def _lay_plane(row, hit, stroke):
    """Remembers the surface at a snapped node."""
    tables, positions = stroke.tables, stroke.positions
    node = tables.node_id[row]
    tables.node_plane[row, :3] = hit[1:4]
    tables.node_plane[row, 3] = height(hit[1:4], hit[4:7], positions[node])
    star = star_of(node, stroke.links, tables)
    rest_plane(star, hit[1:4], hit[4:7], positions, stroke.rest, tables.rest_plane[row])


@njit(cache=True)
def _join_old_front(a, b, hit, stroke):
    """Nodes of an earlier cut, near the surface and in an element at a and b, are on it at once.

    Otherwise a bridge is left between where one stroke ended and where the next begins.
    """
    links, tables = stroke.links, stroke.tables
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
            if node_row[node] < 0 and _on_lip(links, node) and _is_near(node, hit[4:7], stroke):
                _decide(node, hit, stroke)


@njit(cache=True)
def _reach(row, other, share, hit, stroke):
    """The blade crosses an edge of a snapped node, `share` of the way to `other`."""
    tables, positions = stroke.tables, stroke.positions
    node = tables.node_id[row]
    if share <= 0.5 and tables.node_state[row] == 0:
        tables.node_state[row] = PENDING
        _join_old_front(node, node, hit, stroke)
    gap = positions[other] - positions[node]
    length = share * np.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    if length < tables.node_near[row]:
        tables.node_near[row] = length
        _lay_plane(row, hit, stroke)
        if other == node:
            tables.rest_plane[row, 3] = 0.0


@njit(cache=True)
def register(nodes, data, stroke):
    """Enters hits in the look-up tables; hits that contradict known sides are passed over.

    Args:
        nodes, data: hits, as from `find_hits`; their normals are turned to the stroke's side.
        stroke: with tables that have room for two nodes and an edge by hit and their rings.
    """
    tables = stroke.tables
    for k in range(len(nodes)):
        hit = data[k]
        hit[1:4] = _oriented(hit[1:4], stroke.direction)
        a, b = nodes[k, 0], nodes[k, 1]
        first = _decide(a, hit, stroke)
        if b < 0:
            if tables.node_side[first] == SNAPPED:
                _reach(first, a, 0.0, hit, stroke)
            continue
        second = _decide(b, hit, stroke)
        for row, other, share in ((first, b, hit[0]), (second, a, 1.0 - hit[0])):
            if tables.node_side[row] == SNAPPED:
                _reach(row, other, share, hit, stroke)
        if tables.node_side[first] == -tables.node_side[second]:
            add_edge(tables, a, b, hit[0], hit[1:4])
            _join_old_front(a, b, hit, stroke)
