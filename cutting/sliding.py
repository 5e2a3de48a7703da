"""Sliding of snapped nodes onto the swept surface, in the rest shape (docs/cutting.md)."""

import numpy as np

from cutting_trainer.cutting.geometry import altitude, height
from cutting_trainer.cutting.lookup import SNAPPED, base_of
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import assign, cross, dot, norm
from cutting_trainer.tissue_sim.mesh.topology import CUT, FACE_NODES

_MIN_ALTITUDE_LEFT = 0.4
_FLAT = 1e-10
_MAX_INCLINATION = 0.2
"""Smallest sine between the swept surface and the direction of sliding."""
_MIN_EDGE_SINE = 1e-5
"""Smallest sine between the triangles at an edge of the tissue; less is rounding."""
_SMOOTH = 0.8
"""Smallest cosine between the triangles at a node and the tangent plane of the surface there."""
_PASSES = 4
"""Times that nodes which could not slide try again."""
_BEYOND = -0.3
"""Smallest weight of a node of the tetrahedron into which a node slides."""


@inner
def incident_tetrahedra(node, links, tables):
    """Return the parents and whole tetrahedra around a node by their nodes, that node first.

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


@inner
def rest_plane(star, normal, point, positions, rest, out):
    """Compute the swept surface at a node, as a plane of the rest shape.

    The height above a plane of the deformed tissue is linear in each element. Its volume-weighted
    mean gradient in the rest shape is the normal.

    Args:
        star: as from `incident_tetrahedra`, shape (s, 4).
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


@inner
def _put(x, node, rest, at, where):
    if node in at:
        row = at[node]
        for i in range(3):
            x[i] = where[row, i]
    else:
        for i in range(3):
            x[i] = rest[node, i]


@inner
def _volume_gradient(star, rest, at, where, out):
    """Compute twice the inward area at a node: motion orthogonal to it preserves the volume."""
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


@inner
def _parts_regions(links, tet, face):
    """Return whether a face leads to a region of a higher number: one of two does."""
    if links.region.shape[0] == 0 or links.neighbors[tet, face] < 0:
        return False
    return links.region[links.neighbors[tet, face] // 4] > links.region[tet]


@inner
def _surface_normals(node, links, rest, at, where):
    """Return unit normals of the triangles at a node that keep their shape, shape (k, 4).

    They are those of the surface, then 0, those of an earlier cut, then 1, and those between two
    regions, then 2. Nodes that have a row in `at` lie at that row of `where`.
    """
    first_corner, corner_next, face_triangle = (
        links.first_corner,
        links.corner_next,
        links.face_triangle,
    )
    kind = links.triangle_kind
    count = 0
    corner = first_corner[node]
    while corner >= 0:
        for face in range(4):
            count += face != corner % 4 and (
                face_triangle[corner // 4, face] >= 0 or _parts_regions(links, corner // 4, face)
            )
        corner = corner_next[corner]
    normals = np.empty((count, 4))
    count = 0
    a, b, c = np.empty(3), np.empty(3), np.empty(3)
    corner = first_corner[node]
    while corner >= 0:
        for face in range(4):
            k, tet = face_triangle[corner // 4, face], corner // 4
            between = _parts_regions(links, tet, face)
            if face != corner % 4 and (k >= 0 or between):
                _put(a, links.tetrahedra[tet, FACE_NODES[face, 0]], rest, at, where)
                _put(b, links.tetrahedra[tet, FACE_NODES[face, 1]], rest, at, where)
                _put(c, links.tetrahedra[tet, FACE_NODES[face, 2]], rest, at, where)
                ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
                x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                size = np.sqrt(x * x + y * y + z * z)
                normals[count, 0], normals[count, 1], normals[count, 2] = (
                    x / size,
                    y / size,
                    z / size,
                )
                normals[count, 3] = 2.0 if between else 1.0 if kind[k] == CUT else 0.0
                count += 1
        corner = corner_next[corner]
    return normals


@inner
def _keeps_shape(way, normals, shape):
    """Return whether a sliding node leaves the surface by at most `shape` [m], and an earlier cut
    only by rounding.
    """
    length = norm(way)
    for k in range(len(normals)):
        off = abs(dot(normals[k], way))
        if off > _FLAT * length and (normals[k, 3] > 0.0 or off > shape):
            return False
    return True


@inner
def _along(direction, plane, least, way):
    """Compute the path along a direction to the plane.

    Return whether it is not too oblique, and the direction longer than `least`: a shorter one is
    rounding.
    """
    size = norm(direction)
    rise = dot(plane, direction)
    if abs(rise) <= _MAX_INCLINATION * size or size <= least:
        return False
    for i in range(3):
        way[i] = -plane[3] * direction[i] / rise
    return True


@inner
def find_slide(star, plane, links, rest, fixed, shape, at, where, outline, way):
    """Find the shortest path of a node onto the swept surface that preserves outer shape and
    volume.

    Inside the tissue it is orthogonal to the swept surface. At the tissue's surface it lies in the
    tangent plane, and at an edge of the tissue along that edge. The end of an earlier cut, where
    both cut faces meet, stays in place. Between two regions it lies in their common face, which
    keeps its shape.

    Args:
        star: around the node, shape (s, 4).
        plane: swept surface at rest: normal, height of the node [m], shape (4,).
        links: connectivity.
        rest: [m], shape (n, 3).
        fixed: shape (n,).
        shape: largest distance of the node from the present surface [m].
        at, where: row by node, and places [m], shape (j, 3), of nodes that slide in this batch.
        outline: as `at`, of the nodes whose slide has changed the tissue's surface already.
        way: output [m], shape (3,).

    Returns:
        Whether a path exists.
    """
    node = star[0, 0]
    if fixed[node]:
        return False
    normals = _surface_normals(node, links, rest, outline, where)
    if len(normals) == 0:
        return _along(plane[:3], plane, 0.0, way)
    across = np.zeros(3)
    sharpest = 0.0
    turn = np.empty(3)
    for k in range(len(normals)):
        for j in range(k):
            if dot(normals[k], normals[j]) < -0.9:
                return False
        a, b = normals[0], normals[k]
        cross(a, b, turn)
        if dot(turn, turn) > sharpest:
            sharpest = dot(turn, turn)
            assign(across, turn)
    inward, tangent = np.empty(3), np.empty(3)
    _volume_gradient(star, rest, at, where, inward)
    if normals[:, 3].min() == 2.0:  # within the tissue, where volume does not change
        for i in range(3):
            inward[i] = -normals[:, i].sum()
    size = norm(inward)
    share = dot(inward, plane) / max(size * size, 1e-300)
    smooth = True
    for i in range(3):
        tangent[i] = plane[i] - share * inward[i]
    for k in range(len(normals)):
        smooth &= dot(normals[k], inward) < -_SMOOTH * size
    if (
        smooth
        and _along(tangent, plane, _MAX_INCLINATION, way)
        and _keeps_shape(way, normals, shape)
    ):
        return True
    return _along(across, plane, _MIN_EDGE_SINE, way) and _keeps_shape(way, normals, 0.0)


@inner
def stays_sound(star, target, rest, floor, at, where):
    """Return whether no element around a node gets much flatter when it moves to `target` [m]."""
    corners = np.empty((4, 3))
    for k in range(len(star)):
        for i in range(4):
            _put(corners[i], star[k, i], rest, at, where)
        before = altitude(corners[0], corners[1], corners[2], corners[3])
        corners[0] = target
        after = altitude(corners[0], corners[1], corners[2], corners[3])
        if after < max(floor, _MIN_ALTITUDE_LEFT * before):
            return False
    return True


@inner
def can_slide(star, plane, links, tables, rest, fixed, shape, floor):
    """Return whether a node could slide onto the swept surface if the snapped nodes around it
    do.
    """
    at: dict[int, int] = {}
    at[-1] = 0
    outline: dict[int, int] = {}
    outline[-1] = 0
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
    if not find_slide(star, plane, links, rest, fixed, shape, at, where, outline, way):
        return False
    return stays_sound(star, rest[star[0, 0]] + way, rest, floor, at, where)


@inner
def _express(node, target, links, rest, nodes, weights):
    """Compute nodes and weights for a place, in the tetrahedron at a node that contains it or is
    nearest.

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


@kernel
def slides(rows, links, tables, rest, fixed, limits):
    """Return the sliding nodes; a node that would spoil an element stays in place.

    Args:
        rows: of nodes newly on the cut, shape (k,); the target is written to `tables`.
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
    stays = np.ones(len(rows), np.bool_)
    for _ in range(_PASSES):  # each makes room for its neighbours
        before = count
        for k in range(len(rows)):
            row = rows[k]
            plane = tables.rest_plane[row]
            if not stays[k] or plane[3] == 0.0:
                continue
            node = tables.node_id[row]
            star = incident_tetrahedra(node, links, tables)
            if not find_slide(star, plane, links, rest, fixed, limits.shape, at, where, at, way):
                continue
            nodes, weights = tables.slide_to[row], tables.slide[row]
            if not _express(node, rest[node] + way, links, rest, nodes, weights):
                continue
            for i in range(3):
                target[i] = 0.0
                for j in range(4):
                    target[i] += weights[j] * rest[nodes[j], i]
            if stays_sound(star, target, rest, limits.floor, at, where):
                moved[count] = row
                where[count] = target
                at[node] = count
                count += 1
                stays[k] = False
        if count == before:
            break
    return moved[:count], where[:count]
