"""Node-first snapping (thesis 5.3.3; docs/cutting.md): selection of the nodes on the cut."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.geometry import altitude, height
from cutting_trainer.cutting.lookup import (
    DONE,
    EDGES,
    MINUS,
    PENDING,
    PLUS,
    SNAPPED,
    WAITS_MINUS,
    WAITS_PLUS,
    Tables,
    add_edge,
    add_node,
    base_of,
    side_of,
)
from cutting_trainer.cutting.sliding import can_slide, incident_tetrahedra, rest_plane
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.topology import CUT, Links

_EXACT = 1e-6


class SnapLimits(NamedTuple):
    """Limits for snapping a node to the cut.

    Attributes:
        tau: a crossing nearer to a node than this share of its edge is snapped to the node.
        off: largest distance from the surface of a node on the cut that cannot slide onto it [m].
        thin: such a node stays on the cut where an element would otherwise be flatter than this
            [m].
        small: altitude of an element below which only nodes are cut [m].
        floor: smallest altitude of a new element [m].
        shape: largest distance of a node from the surface of the tissue [m].
    """

    tau: float
    off: float
    thin: float
    small: float
    floor: float
    shape: float


class SnapStroke(NamedTuple):
    """A step of a stroke, as operand of the kernels.

    Attributes:
        direction: normal of the stroke so far, unit, shape (3,).
        links, tables: mesh and stroke.
        positions, rest: nodes now and at rest [m], shape (n, 3).
        fixed: shape (n,).
        limits: see `SnapLimits`.
    """

    direction: np.ndarray
    links: Links
    tables: Tables
    positions: np.ndarray
    rest: np.ndarray
    fixed: np.ndarray
    limits: SnapLimits


@inner
def _oriented(normal, direction):
    """Return the normal, oriented as the stroke's previous normals."""
    dot = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
    return normal if dot >= 0.0 else -normal


@inner
def _nearness(star, point, stroke):
    """Return the proximity of a node to the crossings of its edges with the surface, continued as a
    plane.

    Args:
        star: around the node, see `incident_tetrahedra`.
        point: of the surface [m], shape (3,).
        stroke: a `SnapStroke`.

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


@inner
def _is_near(node, point, stroke):
    """Return whether a node snaps to the cut: the surface crosses one of its edges within tau of
    it.

    A node that could not slide onto the surface must be nearer. In small elements half an edge is
    near enough: then only nodes are cut, and no element gets smaller.
    """
    limits = stroke.limits
    star = incident_tetrahedra(node, stroke.links, stroke.tables)
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


@inner
def _on_cut_face(links, node):
    """Return whether a node lies on the surface of an earlier cut."""
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


@inner
def _decide(node, hit, stroke):
    """Decide whether a node is on the cut, else on which side; return its row."""
    tables = stroke.tables
    row = np.int64(tables.node_row[node])
    if row >= 0:
        return row
    if not _is_near(node, hit[4:7], stroke):
        above = height(hit[1:4], hit[4:7], stroke.positions[node])
        return np.int64(add_node(tables, node, PLUS if above > 0.0 else MINUS))
    row = np.int64(add_node(tables, node, np.int64(SNAPPED)))
    _lay_plane(row, hit, stroke)
    if _on_cut_face(stroke.links, node):
        tables.node_state[row] = PENDING
    return row


@inner
def _lay_plane(row, hit, stroke):
    """Store the surface at a snapped node."""
    tables, positions = stroke.tables, stroke.positions
    node = tables.node_id[row]
    for axis in range(3):
        tables.node_plane[row, axis] = hit[1 + axis]
    tables.node_plane[row, 3] = height(hit[1:4], hit[4:7], positions[node])
    star = incident_tetrahedra(node, stroke.links, tables)
    rest_plane(star, hit[1:4], hit[4:7], positions, stroke.rest, tables.rest_plane[row])


@inner
def _can_join(tables, node):
    """Return whether a node with a side can still be put on the cut: none of its edges is cut."""
    for row in range(tables.counts[EDGES]):
        if tables.edge_state[row] == DONE and (
            tables.edge_nodes[row, 0] == node or tables.edge_nodes[row, 1] == node
        ):
            return False
    return True


@inner
def _parts_nothing(tables, node):
    """Return whether no edge leads from a node with a side to a node on the other one."""
    for row in range(tables.counts[EDGES]):
        waits = tables.edge_state[row] == WAITS_PLUS or tables.edge_state[row] == WAITS_MINUS
        if not waits and (tables.edge_nodes[row, 0] == node or tables.edge_nodes[row, 1] == node):
            return False
    return True


@inner
def _contradicts(node, side, hit, normal, near, stroke):
    """Return whether a hit puts a node on another side than it has.

    A node nearly on the surface is put on the cut instead: the surface is curved, and has passed an
    edge of it twice, or follows an earlier cut. Another one takes the other side where only
    crossings at nodes on the cut have told its own: the surface has curved since.
    """
    tables = stroke.tables
    row = tables.node_row[node]
    if row < 0 or tables.node_side[row] == SNAPPED or tables.node_side[row] == side:
        return False
    above = abs(height(normal, hit[4:7], stroke.positions[node]))
    if above > near or not _can_join(tables, node):
        if side == SNAPPED or not _parts_nothing(tables, node):
            return True
        tables.node_side[row] = side
        return False
    tables.node_side[row] = SNAPPED
    tables.node_state[row] = PENDING
    _lay_plane(row, hit, stroke)
    for k in range(tables.counts[EDGES]):
        for i in range(2):
            if tables.edge_nodes[k, i] == node and tables.edge_state[k] == PENDING:
                low_plus = (side == MINUS) == (i == 0)
                tables.edge_state[k] = WAITS_PLUS if low_plus else WAITS_MINUS
    return False


@kernel
def conflicts(nodes, data, near, stroke):
    """Return the number of hits that contradict known sides of nodes: the blade folds back on its
    own cut.

    Args:
        nodes, data: hits, as from `find_hits`.
        near: distance from the surface within which a node may be put on the cut instead [m].
        stroke: with tables that are changed for these nodes.
    """
    tables, direction, positions = stroke.tables, stroke.direction, stroke.positions
    count = 0
    for k in range(len(nodes)):
        normal = _oriented(data[k, 1:4], direction)
        a, b = nodes[k, 0], nodes[k, 1]
        if b < 0:
            count += _contradicts(a, SNAPPED, data[k], normal, near, stroke)
            continue
        if side_of(tables, a) == SNAPPED or side_of(tables, b) == SNAPPED:
            continue
        side = PLUS if height(normal, data[k, 4:7], positions[a]) > 0.0 else MINUS
        one = _contradicts(a, side, data[k], normal, near, stroke)
        count += one or _contradicts(b, -side, data[k], normal, near, stroke)
    return count


@inner
def _join_old_front(a, b, hit, stroke):
    """Snap the nodes of an earlier cut near the surface, in an element at a and b.

    Otherwise a bridge would remain between the end of one stroke and the start of the next.
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
            if (
                node_row[node] < 0
                and _on_cut_face(links, node)
                and _is_near(node, hit[4:7], stroke)
            ):
                _decide(node, hit, stroke)


@inner
def _reach(row, other, share, hit, stroke):
    """Update a snapped node whose edge the blade crosses, at `share` of the path to `other`."""
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


@inner
def _waits(tables, row):
    """Return whether a node is snapped, but not on the cut yet."""
    return tables.node_side[row] == SNAPPED and tables.node_state[row] != DONE


@kernel
def register(nodes, data, stroke):
    """Add hits to the look-up tables; hits that contradict known sides are ignored.

    Args:
        nodes, data: hits, as from `find_hits`; their normals are turned to the stroke's side.
        stroke: with tables that have room for two nodes and an edge per hit and their incident
            tetrahedra.
    """
    tables = stroke.tables
    for k in range(len(nodes)):
        hit = data[k]
        normal = _oriented(hit[1:4], stroke.direction)
        for axis in range(3):
            hit[1 + axis] = normal[axis]
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
            add_edge(tables, a, b, hit[0], hit[1:4], PENDING)
            _join_old_front(a, b, hit, stroke)
        elif _waits(tables, first) or _waits(tables, second):
            low = stroke.positions[min(a, b)]
            above = height(hit[1:4], hit[4:7], low) > 0.0
            add_edge(tables, a, b, hit[0], hit[1:4], WAITS_PLUS if above else WAITS_MINUS)
