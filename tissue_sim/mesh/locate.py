"""Point location in the deformed tissue, and distances to triangles."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel

_INSIDE = -1e-9
_FARTHER = 1.0 + 1e-9


@inner
def barycentric(positions, tetrahedra, tet, point, out):
    """Return barycentric coordinates of a point in a tetrahedron.

    Args:
        positions: node positions [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        tet: which one.
        point: [m], shape (3,).
        out: output, sum 1, shape (4,).

    Returns:
        The smallest of them, or -inf for a flat tetrahedron.
    """
    o = positions[tetrahedra[tet, 0]]
    a = positions[tetrahedra[tet, 1]]
    b = positions[tetrahedra[tet, 2]]
    c = positions[tetrahedra[tet, 3]]
    ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
    bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
    cx, cy, cz = c[0] - o[0], c[1] - o[1], c[2] - o[2]
    px, py, pz = point[0] - o[0], point[1] - o[1], point[2] - o[2]
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    determinant = ax * nx + ay * ny + az * nz
    if determinant == 0.0:
        return -np.inf
    out[1] = (px * nx + py * ny + pz * nz) / determinant
    nx, ny, nz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    out[2] = (px * nx + py * ny + pz * nz) / determinant
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    out[3] = (px * nx + py * ny + pz * nz) / determinant
    out[0] = 1.0 - out[1] - out[2] - out[3]
    return min(min(out[0], out[1]), min(out[2], out[3]))


@inner
def _walk(positions, tetrahedra, neighbors, point, start, out):
    """Walk from `start` through the face the point lies farthest beyond; -1: it left the body."""
    tet = start
    for _ in range(200):
        if barycentric(positions, tetrahedra, tet, point, out) >= _INSIDE:
            return tet
        face = neighbors[tet, np.argmin(out)]
        if face < 0:
            return -1
        tet = face // 4
    return -1


@inner
def _near(positions, tetrahedra, points):
    """Return the tetrahedra whose bounding boxes meet that of some points, in order."""
    low, high = points[0].copy(), points[0].copy()
    for k in range(1, len(points)):
        for i in range(3):
            low[i], high[i] = min(low[i], points[k, i]), max(high[i], points[k, i])
    out = np.empty(len(tetrahedra), np.int64)
    count = 0
    for tet in range(len(tetrahedra)):
        meets = True
        for i in range(3):
            if not _spans(positions, tetrahedra, tet, i, low[i], high[i]):
                meets = False
                break
        if meets:
            out[count] = tet
            count += 1
    return out[:count]


@inner
def _spans(positions, tetrahedra, tet, axis, low, high):
    """Return whether a tetrahedron's bounding box meets an interval of an axis."""
    a = positions[tetrahedra[tet, 0], axis]
    b = positions[tetrahedra[tet, 1], axis]
    c = positions[tetrahedra[tet, 2], axis]
    d = positions[tetrahedra[tet, 3], axis]
    return min(min(a, b), min(c, d)) <= high and low <= max(max(a, b), max(c, d))


@inner
def _search(positions, tetrahedra, near, point, out):
    """Test every listed tetrahedron whose bounding box contains the point."""
    for tet in near:
        inside = True
        for i in range(3):
            if not _spans(positions, tetrahedra, tet, i, point[i], point[i]):
                inside = False
                break
        if inside and barycentric(positions, tetrahedra, tet, point, out) >= _INSIDE:
            return tet
    return -1


@kernel
def locate_points(positions, tetrahedra, neighbors, points, hint, found, weights):
    """Find the tetrahedra that contain some points: by a walk from the last one, else a search.

    A walk fails outside and where the body is not convex, above all across an open cut. The first
    search lists the tetrahedra near all points; later searches look at these only.

    Args:
        positions: node positions [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        neighbors: faces across, as `TetMesh.neighbors`, shape (m, 4).
        points: [m], shape (p, 3).
        hint: tetrahedron to begin with.
        found: output, the tetrahedron of each point or -1, shape (p,).
        weights: output, barycentric coordinates, shape (p, 4).
    """
    tet = min(max(hint, 0), len(tetrahedra) - 1)
    near = np.empty(0, np.int64)
    listed = False
    for k in range(len(points)):
        at = _walk(positions, tetrahedra, neighbors, points[k], tet, weights[k])
        if at < 0:
            if not listed:
                near, listed = _near(positions, tetrahedra, points), True
            at = _search(positions, tetrahedra, near, points[k], weights[k])
        found[k] = at
        if at >= 0:
            tet = at


@kernel
def distance_to_triangles(point, positions, triangles):
    """Return the distance of a point to the nearest of some triangles [m].

    Args:
        point: [m], shape (3,).
        positions: nodes [m], shape (n, 3).
        triangles: nodes of each, shape (k, 3).
    """
    return np.sqrt(_closest(point, positions, triangles)[0])


@kernel
def closest_triangle(point, positions, triangles):
    """Return the number of the triangle closest to a point.

    Args:
        point: [m], shape (3,).
        positions: [m], shape (n, 3).
        triangles: shape (k, 3), one at least.
    """
    return _closest(point, positions, triangles)[1]


@inner
def _closest(point, positions, triangles):
    """Return the smallest squared distance and the first triangle with it; 0 without triangles.

    A triangle is skipped if its bounding box is farther away than another triangle. `_FARTHER`
    allows for rounding.
    """
    least, found = np.inf, 0
    for i in range(len(triangles)):
        a, b, c = triangles[i]
        away = 0.0
        for axis in range(3):
            x, y, z = positions[a, axis], positions[b, axis], positions[c, axis]
            gap = max(min(x, y, z) - point[axis], point[axis] - max(x, y, z), 0.0)
            away += gap * gap
        if away <= _FARTHER * least:
            distance = _squared_distance(point, positions[a], positions[b], positions[c])
            if distance < least:
                least, found = distance, i
    return least, found


@inner
def _squared_distance(p, a, b, c):
    """Return the squared distance to a triangle, by Voronoi regions (Ericson 2005, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    bp = p - b
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    cp = p - c
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        nearest = a
    elif d3 >= 0.0 and d4 <= d3:
        nearest = b
    elif d6 >= 0.0 and d5 <= d6:
        nearest = c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        nearest = a + ab * (d1 / (d1 - d3))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        nearest = a + ac * (d2 / (d2 - d6))
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        nearest = b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    else:
        nearest = a + ab * (vb / (va + vb + vc)) + ac * (vc / (va + vb + vc))
    away = p - nearest
    return _dot(away, away)


@inner
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
