"""Snapped nodes slide onto the swept surface, in the rest shape (docs/cutting.md)."""

import numpy as np
from numba import njit

from cutting.geometry import altitude, height
from cutting.lookup import SNAPPED, base_of
from tissue_sim.topology import CUT

_LEAST_ALTITUDE_LEFT = 0.4
_FLAT = 1e-10
_STEEPEST = 0.2
"""Least sine between the swept surface and what a node slides along."""
_SMOOTH = 0.8
"""Least cosine between the triangles at a node and the plane that touches the surface there."""
_BEYOND = -0.3
"""Least weight of a node of the tetrahedron that a node slides into."""


@njit(cache=True)
def star_of(node, links, tables):
    """Parents, and whole tetrahedra, around a node by their nodes, that node first.

    Args:
        node: by its origin's number, and not on the cut.
        links, tables: mesh and stroke.

    Returns:
        Positively oriented, shape (s, 4).
    """
    tetrahedra, corner_next, origin = links.tetrahedra, links.corner_next, tables.origin
    owner, parent_nodes = tables.owner, tables.parent_nodes
    size = 0
    corner = links.first_corner[node]
    while corner >= 0:
        size += 1
        corner = corner_next[corner]
    star = np.empty((size, 4), np.int64)
    owners = np.empty(size, np.int64)
    count = 0
    corner = links.first_corner[node]
    while corner >= 0:
        tet = corner // 4
        corner = corner_next[corner]
        parent = np.int64(owner[tet])
        known = False
        for k in range(count):
            if parent >= 0 and owners[k] == parent:
                known = True
        if known:
            continue
        base = star[count]
        base_of(tetrahedra, origin, owner, parent_nodes, tet, base)
        for i in range(1, 4):
            if base[i] == node:
                # Two swaps keep the orientation.
                j, k = 1 + i % 3, 1 + (i + 1) % 3
                base[0], base[i] = base[i], base[0]
                base[j], base[k] = base[k], base[j]
                break
        owners[count] = parent
        count += 1
    return star[:count]


@njit(cache=True)
def rest_plane(star, normal, point, positions, rest, out):
    """The swept surface at a node, as a plane of the rest shape.

    The height above a plane of the deformed tissue is a linear function in each element; its mean
    gradient in the rest shape, by volume, is the normal there.

    Args:
        star: as from `star_of`, shape (s, 4).
        normal, point: of the plane in the deformed tissue [m], shape (3,).
        positions, rest: nodes now and at rest [m], shape (n, 3).
        out: unit normal, height of the node above the plane [m], shape (4,).
    """
    node = star[0, 0]
    above = height(normal, point, positions[node])
    gx = gy = gz = volume = 0.0
    o = rest[node]
    for k in range(len(star)):
        a, b, c = rest[star[k, 1]], rest[star[k, 2]], rest[star[k, 3]]
        ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
        bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
        cx, cy, cz = c[0] - o[0], c[1] - o[1], c[2] - o[2]
        ha = height(normal, point, positions[star[k, 1]]) - above
        hb = height(normal, point, positions[star[k, 2]]) - above
        hc = height(normal, point, positions[star[k, 3]]) - above
        ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        gx += ha * ux + hb * (cy * az - cz * ay) + hc * (ay * bz - az * by)
        gy += ha * uy + hb * (cz * ax - cx * az) + hc * (az * bx - ax * bz)
        gz += ha * uz + hb * (cx * ay - cy * ax) + hc * (ax * by - ay * bx)
        volume += ax * ux + ay * uy + az * uz
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length == 0.0:
        out[:] = 0.0
        return
    out[0], out[1], out[2] = gx / length, gy / length, gz / length
    out[3] = above * volume / length


@njit(cache=True)
def _put(x, node, rest, at, where):
    if node in at:
        row = at[node]
        for i in range(3):
            x[i] = where[row, i]
    else:
        for i in range(3):
            x[i] = rest[node, i]


@njit(cache=True)
def _volume_gradient(star, rest, at, where, out):
    """Twice the inward area at a node: what it moves at right angles to this keeps the volume."""
    a, b, c = np.empty(3), np.empty(3), np.empty(3)
    out[:] = 0.0
    for k in range(len(star)):
        _put(a, star[k, 1], rest, at, where)
        _put(b, star[k, 2], rest, at, where)
        _put(c, star[k, 3], rest, at, where)
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        out[0] += uy * vz - uz * vy
        out[1] += uz * vx - ux * vz
        out[2] += ux * vy - uy * vx


@njit(cache=True)
def _surface_normals(node, links, rest):
    """Unit normals of the surface triangles at a node, then 1 for an earlier cut, shape (k, 4)."""
    first_corner, corner_next, face_triangle = (
        links.first_corner,
        links.corner_next,
        links.face_triangle,
    )
    triangles, kind = links.triangles, links.triangle_kind
    count = 0
    corner = first_corner[node]
    while corner >= 0:
        for face in range(4):
            count += face != corner % 4 and face_triangle[corner // 4, face] >= 0
        corner = corner_next[corner]
    normals = np.empty((count, 4))
    count = 0
    corner = first_corner[node]
    while corner >= 0:
        for face in range(4):
            k = face_triangle[corner // 4, face]
            if face != corner % 4 and k >= 0:
                a, b, c = rest[triangles[k, 0]], rest[triangles[k, 1]], rest[triangles[k, 2]]
                ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
                x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                size = np.sqrt(x * x + y * y + z * z)
                normals[count, 0], normals[count, 1], normals[count, 2] = (
                    x / size,
                    y / size,
                    z / size,
                )
                normals[count, 3] = kind[k] == CUT
                count += 1
        corner = corner_next[corner]
    return normals


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _keeps_shape(way, normals, shape):
    """Whether a node that goes that way leaves the surface by no more than `shape` [m]; an
    earlier cut is kept but for rounding.
    """
    length = np.sqrt(_dot(way, way))
    for k in range(len(normals)):
        off = abs(_dot(normals[k], way))
        if off > _FLAT * length and (normals[k, 3] > 0.0 or off > shape):
            return False
    return True


@njit(cache=True)
def _along(direction, plane, way):
    """The way along a direction (of any length) to the plane; whether it is not too oblique."""
    size = np.sqrt(_dot(direction, direction))
    rise = _dot(plane, direction)
    if abs(rise) <= _STEEPEST * size or size == 0.0:
        return False
    for i in range(3):
        way[i] = -plane[3] * direction[i] / rise
    return True


@njit(cache=True)
def find_way(star, plane, links, rest, fixed, shape, at, where, way):
    """The shortest way of a node onto the swept surface that keeps the outer shape and the volume.

    Inside the tissue it is at right angles to the surface that is swept; at the tissue's surface it
    is in the plane that touches it there; at an edge of the tissue it is along that edge. The end
    of an earlier cut, where both lips meet, stays where it is.

    Args:
        star: around the node, shape (s, 4).
        plane: swept surface at rest: normal, height of the node [m], shape (4,).
        links: connectivity.
        rest: [m], shape (n, 3).
        fixed: shape (n,).
        shape: how far the node may leave the present surface [m].
        at, where: row by node, and places [m], shape (j, 3), of nodes that slide in this batch.
        way: output [m], shape (3,).

    Returns:
        Whether there is one.
    """
    node = star[0, 0]
    if fixed[node]:
        return False
    normals = _surface_normals(node, links, rest)
    if len(normals) == 0:
        return _along(plane[:3], plane, way)
    across = np.zeros(3)
    sharpest = 0.0
    turn = np.empty(3)
    for k in range(len(normals)):
        for j in range(k):
            if _dot(normals[k], normals[j]) < -0.9:
                return False
        a, b = normals[0], normals[k]
        turn[0] = a[1] * b[2] - a[2] * b[1]
        turn[1] = a[2] * b[0] - a[0] * b[2]
        turn[2] = a[0] * b[1] - a[1] * b[0]
        if _dot(turn, turn) > sharpest:
            sharpest = _dot(turn, turn)
            across[:] = turn
    inward, tangent = np.empty(3), np.empty(3)
    _volume_gradient(star, rest, at, where, inward)
    size = np.sqrt(_dot(inward, inward))
    share = _dot(inward, plane) / max(size * size, 1e-300)
    smooth = True
    for i in range(3):
        tangent[i] = plane[i] - share * inward[i]
    for k in range(len(normals)):
        smooth &= _dot(normals[k], inward) < -_SMOOTH * size
    if smooth and _along(tangent, plane, way) and _keeps_shape(way, normals, shape):
        return True
    return sharpest > 0.0 and _along(across, plane, way) and _keeps_shape(way, normals, 0.0)


@njit(cache=True)
def stays_sound(star, target, rest, floor, at, where):
    """Whether no element around a node gets much flatter when the node goes to `target` [m]."""
    corners = np.empty((4, 3))
    for k in range(len(star)):
        for i in range(4):
            _put(corners[i], star[k, i], rest, at, where)
        before = altitude(corners[0], corners[1], corners[2], corners[3])
        corners[0] = target
        after = altitude(corners[0], corners[1], corners[2], corners[3])
        if after < max(floor, _LEAST_ALTITUDE_LEFT * before):
            return False
    return True


@njit(cache=True)
def can_slide(star, plane, links, tables, rest, fixed, shape, floor):
    """Whether a node could slide onto the swept surface, when the snapped nodes around it do."""
    at: dict[int, int] = {}
    at[-1] = 0
    where = np.empty((3 * len(star), 3))
    count = 0
    for k in range(len(star)):
        for i in range(1, 4):
            node = star[k, i]
            row = tables.node_row[node]
            if row >= 0 and node not in at and tables.node_side[row] == SNAPPED:
                at[node] = count
                there = tables.rest_plane[row]
                for j in range(3):
                    where[count, j] = rest[node, j] - there[3] * there[j]
                count += 1
    way = np.empty(3)
    if not find_way(star, plane, links, rest, fixed, shape, at, where, way):
        return False
    return stays_sound(star, rest[star[0, 0]] + way, rest, floor, at, where)


@njit(cache=True)
def _express(node, target, links, rest, nodes, weights):
    """Nodes and weights for a place, in the tetrahedron at a node that it is in, or beyond, most.

    Returns:
        Whether it is in or near the cone of one.
    """
    tetrahedra, corner_next = links.tetrahedra, links.corner_next
    best = _BEYOND
    o = rest[node]
    x, y, z = target[0] - o[0], target[1] - o[1], target[2] - o[2]
    corner = links.first_corner[node]
    while corner >= 0:
        tet, i = corner // 4, corner % 4
        corner = corner_next[corner]
        j, k, m = tetrahedra[tet, i ^ 1], tetrahedra[tet, i ^ 2], tetrahedra[tet, i ^ 3]
        a, b, c = rest[j], rest[k], rest[m]
        ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
        bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
        cx, cy, cz = c[0] - o[0], c[1] - o[1], c[2] - o[2]
        ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        size = ax * ux + ay * uy + az * uz
        p = (x * ux + y * uy + z * uz) / size
        vx, vy, vz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        q = (x * vx + y * vy + z * vz) / size
        wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        r = (x * wx + y * wy + z * wz) / size
        least = min(p, q, r)
        if least > best:
            best = least
            nodes[0], nodes[1], nodes[2], nodes[3] = node, j, k, m
            weights[1] = p if abs(p) > 1e-12 else 0.0
            weights[2] = q if abs(q) > 1e-12 else 0.0
            weights[3] = r if abs(r) > 1e-12 else 0.0
            weights[0] = 1.0 - weights[1] - weights[2] - weights[3]
    return best > _BEYOND


@njit(cache=True)
def slides(rows, links, tables, rest, fixed, limits):
    """Which nodes slide onto the swept surface; a node that would spoil an element stays where it
    is.

    Args:
        rows: of nodes that are newly on the cut, shape (k,); where to is written to `tables`.
        links, tables: mesh and stroke.
        rest: [m], shape (n, 3).
        fixed: shape (n,).
        limits: see `snapping.Limits`.

    Returns:
        By moved node: its row, shape (j,), and its new rest position [m], shape (j, 3).
    """
    moved = np.empty(len(rows), np.int64)
    where = np.empty((len(rows), 3))
    at: dict[int, int] = {}
    at[-1] = 0
    count = 0
    way, target = np.empty(3), np.empty(3)
    for row in rows:
        plane = tables.rest_plane[row]
        if plane[3] == 0.0:
            continue
        node = tables.node_id[row]
        star = star_of(node, links, tables)
        if not find_way(star, plane, links, rest, fixed, limits.shape, at, where, way):
            continue
        nodes, weights = tables.slide_to[row], tables.slide[row]
        if not _express(node, rest[node] + way, links, rest, nodes, weights):
            continue
        for i in range(3):
            target[i] = 0.0
            for k in range(4):
                target[i] += weights[k] * rest[nodes[k], i]
        if stays_sound(star, target, rest, limits.floor, at, where):
            moved[count] = row
            where[count] = target
            at[node] = count
            count += 1
    return moved[:count], where[:count]
