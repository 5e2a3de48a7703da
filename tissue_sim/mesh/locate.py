"""Point location in the deformed tissue, and distances to triangles."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import dot

_INSIDE = -1e-9
_MAX_WALK = 24
"""Tetrahedra that a walk visits; in a strained tissue it may go in circles."""
_FARTHER = 1.0 + 1e-9
_SKIN = 5e-3
"""[m] by which `NearElements` lists more than is asked for."""


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
    # No views: counting the references to them takes longer than the arithmetic.
    o, i, j, k = tetrahedra[tet, 0], tetrahedra[tet, 1], tetrahedra[tet, 2], tetrahedra[tet, 3]
    x, y, z = positions[o, 0], positions[o, 1], positions[o, 2]
    ax, ay, az = positions[i, 0] - x, positions[i, 1] - y, positions[i, 2] - z
    bx, by, bz = positions[j, 0] - x, positions[j, 1] - y, positions[j, 2] - z
    cx, cy, cz = positions[k, 0] - x, positions[k, 1] - y, positions[k, 2] - z
    px, py, pz = point[0] - x, point[1] - y, point[2] - z
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
    for _ in range(_MAX_WALK):
        if barycentric(positions, tetrahedra, tet, point, out) >= _INSIDE:
            return tet
        face = neighbors[tet, np.argmin(out)]
        if face < 0:
            return -1
        tet = face // 4
    return -1


@inner
def _spans(positions, tetrahedra, tet, axis, low, high):
    """Return whether a tetrahedron's bounding box meets an interval of an axis."""
    a = positions[tetrahedra[tet, 0], axis]
    b = positions[tetrahedra[tet, 1], axis]
    c = positions[tetrahedra[tet, 2], axis]
    d = positions[tetrahedra[tet, 3], axis]
    return min(min(a, b), min(c, d)) <= high and low <= max(max(a, b), max(c, d))


@inner
def _search(positions, tetrahedra, near, boxes, point, out):
    """Test every listed tetrahedron whose bounding box contains the point."""
    x, y, z = point[0], point[1], point[2]
    for k in range(len(near)):
        inside = boxes[k, 0] <= x <= boxes[k, 3] and boxes[k, 1] <= y <= boxes[k, 4]
        if not (inside and boxes[k, 2] <= z <= boxes[k, 5]):
            continue
        if barycentric(positions, tetrahedra, near[k], point, out) >= _INSIDE:
            return near[k]
    return -1


@kernel
def list_near(positions, tetrahedra, among, low, high):
    """Return the tetrahedra whose bounding boxes meet a box, in order.

    Args:
        positions: node positions [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        among: tetrahedra to test, shape (k,).
        low, high: corners of the box [m], shape (3,).
    """
    out = np.empty(len(among), np.int64)
    count = 0
    for tet in among:
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
def _list_around(positions, tetrahedra, among, points):
    """Return the tetrahedra whose bounding boxes meet that of some points, and their boxes."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(len(points)):
        for i in range(3):
            low[i], high[i] = min(low[i], points[k, i]), max(high[i], points[k, i])
    near = list_near(positions, tetrahedra, among, low, high)
    boxes = np.empty((len(near), 6))
    for k in range(len(near)):
        for i in range(3):
            a, b = positions[tetrahedra[near[k], 0], i], positions[tetrahedra[near[k], 1], i]
            c, d = positions[tetrahedra[near[k], 2], i], positions[tetrahedra[near[k], 3], i]
            boxes[k, i] = min(min(a, b), min(c, d))
            boxes[k, 3 + i] = max(max(a, b), max(c, d))
    return near, boxes


@kernel
def locate_points(positions, tetrahedra, neighbors, among, points, hint, found, weights):
    """Find the tetrahedra that contain some points: by a walk from the last one, else a search.

    A walk fails outside and where the body is not convex, above all across an open cut. The first
    search lists the tetrahedra near all points; later searches look at these only.

    Args:
        positions: node positions [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        neighbors: faces across, as `TetMesh.neighbors`, shape (m, 4).
        among: tetrahedra that are searched, shape (k,).
        points: [m], shape (p, 3).
        hint: tetrahedron to begin with.
        found: output, the tetrahedron of each point or -1, shape (p,).
        weights: output, barycentric coordinates, shape (p, 4).
    """
    tet = min(max(hint, 0), len(tetrahedra) - 1)
    near, boxes, listed = among, np.empty((0, 6)), False
    for k in range(len(points)):
        at = _walk(positions, tetrahedra, neighbors, points[k], tet, weights[k])
        if at < 0:
            if not listed:
                near, boxes = _list_around(positions, tetrahedra, among, points)
                listed = True
            at = _search(positions, tetrahedra, near, boxes, points[k], weights[k])
        found[k] = at
        if at >= 0:
            tet = at


def find_tetrahedra(
    positions: np.ndarray, tetrahedra: np.ndarray, neighbors: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which tetrahedra contain some points, as `locate_points` does among all.

    Returns:
        The tetrahedron of each point or -1, shape (p,), and barycentric coordinates, shape (p, 4).
    """
    found, weights = np.empty(len(points), np.int64), np.empty((len(points), 4))
    every = np.arange(len(tetrahedra))
    locate_points(positions, tetrahedra, neighbors, every, points, 0, found, weights)
    return found, weights


class NearElements:
    """Tetrahedra near a box, listed again only after nodes or box have moved (a Verlet list).

    Args:
        tetrahedra: of the mesh, which keeps its connectivity, shape (m, 4).
    """

    def __init__(self, tetrahedra: np.ndarray) -> None:
        self._tetrahedra = tetrahedra
        self._listed = np.arange(len(tetrahedra))
        self._before: np.ndarray | None = None
        self._low = self._high = np.zeros(3)

    def find(self, positions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the tetrahedra whose bounding boxes meet a box, in order.

        Args:
            positions: nodes now [m], shape (n, 3).
            low, high: corners of the box [m], shape (3,).
        """
        moved = np.inf if self._before is None else np.abs(positions - self._before).max()
        if (low - moved < self._low).any() or (high + moved > self._high).any():
            self._before, self._low, self._high = positions, low - _SKIN, high + _SKIN
            every = np.arange(len(self._tetrahedra))
            self._listed = list_near(positions, self._tetrahedra, every, self._low, self._high)
        near: np.ndarray = list_near(positions, self._tetrahedra, self._listed, low, high)
        return near


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
def distances_to_triangles(points, positions, triangles):
    """Return the distances of points to the nearest of some triangles [m], shape (p,).

    Args:
        points: [m], shape (p, 3).
        positions: nodes [m], shape (n, 3).
        triangles: nodes of each, shape (k, 3); without any, distances are infinite.
    """
    out = np.empty(len(points))
    for k in range(len(points)):
        out[k] = np.sqrt(_closest(points[k], positions, triangles)[0])
    return out


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
    d1, d2 = dot(ab, ap), dot(ac, ap)
    bp = p - b
    d3, d4 = dot(ab, bp), dot(ac, bp)
    cp = p - c
    d5, d6 = dot(ab, cp), dot(ac, cp)
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
    return dot(away, away)
