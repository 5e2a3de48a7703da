"""Cut material around the blade, so that fracture is paid for only once.

The mesh shows a cut about one element behind the blade. The cut is therefore known from two
sources: the triangles opened by cuts, and the latest strips swept by the edge, which the mesh may
not contain yet.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel

BLADE_THICKNESS = 4e-4
"""Of a scalpel's blade [m]. Up to half of it away from a cut, the blade is still in that cut."""
KNOTS = 24
"""Points by which an edge is kept: its tip, its root, and between them."""
_MAX_STRIP = 5e-4
_MAX_STRIPS = 48
_ROUNDING = 1e-9
_MAX_SINE_ALONG_CUT = 0.5
"""Largest sine of the angle between a motion along a cut and that cut."""


class CutStrips:
    """The latest strips cut by the edge, moved with the tissue.

    Limitations: all of them move with the tissue at the blade. This holds near the blade; farther
        off the mesh has the cut. A motion up to 30 degrees off a cut counts as
        along it.
    """

    def __init__(self) -> None:
        self._strips = np.zeros((0, 2, KNOTS, 3))
        self._goes_on = False

    def carry(self, ways: np.ndarray) -> None:
        """Move the points of each strip with the tissue [m], shape (KNOTS, 3)."""
        self._strips = self._strips + ways

    def add(self, before: np.ndarray, after: np.ndarray) -> None:
        """Add a strip cut by the edge.

        Args:
            before, after: points of the edge from its tip to its root [m], shape (KNOTS, 3).
        """
        if self._goes_on and _path_length(self._strips[-1, 0], after) < _MAX_STRIP:
            self._strips = self._strips.copy()
            self._strips[-1, 1] = after
        else:
            strip = np.stack([before, after])[None]
            self._strips = np.concatenate([self._strips[1 - _MAX_STRIPS :], strip])
        self._goes_on = True

    def leave(self) -> None:
        """Begin a new strip: the edge has moved without cutting."""
        self._goes_on = False

    def forget(self) -> None:
        """Remove all strips: the edge has left the tissue."""
        self._strips = self._strips[:0]
        self._goes_on = False

    def behind(self, distance: float) -> np.ndarray | None:
        """Return the edge at a distance [m] or more before the last strip's end, all along it.

        With too few strips it is the earliest edge, without any None.

        Returns:
            Its root and tip [m], shape (2, 3).
        """
        for strip in self._strips[::-1]:
            if np.linalg.norm(strip[0] - self._strips[-1, 1], axis=1).min() >= distance:
                return np.asarray(strip[0][[-1, 0]])
        return np.asarray(self._strips[0, 0][[-1, 0]]) if len(self._strips) else None

    def near(self, opened: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the cut triangles whose bounding box meets that of some points.

        Args:
            opened: corners of the triangles opened by cuts [m], shape (c, 3, 3).
            points: [m], shape (p, 3).

        Returns:
            Their corners [m], shape (t, 3, 3).
        """
        low, high = points.min(axis=0) - BLADE_THICKNESS, points.max(axis=0) + BLADE_THICKNESS
        found = np.empty((len(opened) + 2 * (KNOTS - 1) * len(self._strips), 3, 3))
        return found[: _near(opened, np.ascontiguousarray(self._strips), low, high, found)]


@inner
def _meets(triangle, low, high):
    """Return whether the bounding box of a triangle meets a box."""
    for c in range(3):
        x, y, z = triangle[0, c], triangle[1, c], triangle[2, c]
        if max(max(x, y), z) < low[c] or min(min(x, y), z) > high[c]:
            return False
    return True


@kernel
def _near(opened, strips, low, high, found):
    """Copy the triangles that meet a box, of the strips after the others; return their number.

    Strips are divided between their knots: first come the halves with the edge before.
    """
    count = 0
    for k in range(len(opened)):
        if _meets(opened[k], low, high):
            found[count] = opened[k]
            count += 1
    for half in range(2):
        for k in range(len(strips)):
            for i in range(strips.shape[2] - 1):
                for c in range(3):
                    found[count, 0, c] = strips[k, 0, i + 1, c]
                    found[count, 1, c] = strips[k, half, i, c]
                    found[count, 2, c] = strips[k, 1, i + half, c]
                if _meets(found[count], low, high):
                    count += 1
    return count


def _path_length(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


@inner
def _normal(triangle, normal):
    """Write the unit normal of a triangle's corners; return twice its area, 0 for a sliver."""
    # No arrays of its own: an allocation takes longer than all the rest.
    x, y, z = triangle[0, 0], triangle[0, 1], triangle[0, 2]
    u0, u1, u2 = triangle[1, 0] - x, triangle[1, 1] - y, triangle[1, 2] - z
    v0, v1, v2 = triangle[2, 0] - x, triangle[2, 1] - y, triangle[2, 2] - z
    normal[0] = u1 * v2 - u2 * v1
    normal[1] = u2 * v0 - u0 * v2
    normal[2] = u0 * v1 - u1 * v0
    size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if size < 1e-14:
        return 0.0
    for c in range(3):
        normal[c] /= size
    return size


@inner
def _over(triangle, normal, size, x, y, z, reach):
    """Return whether a point is above or below a triangle, within `reach` [m]."""
    a, b, c = triangle[0], triangle[1], triangle[2]
    x, y, z = x - a[0], y - a[1], z - a[2]
    if abs(x * normal[0] + y * normal[1] + z * normal[2]) > reach:
        return False
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    # Barycentric coordinates of the foot of the perpendicular.
    beta = (y * v2 - z * v1) * normal[0] + (z * v0 - x * v2) * normal[1]
    beta = (beta + (x * v1 - y * v0) * normal[2]) / size
    gamma = (u1 * z - u2 * y) * normal[0] + (u2 * x - u0 * z) * normal[1]
    gamma = (gamma + (u0 * y - u1 * x) * normal[2]) / size
    return beta >= -_ROUNDING and gamma >= -_ROUNDING and beta + gamma <= 1.0 + _ROUNDING


@inner
def _surround(triangle, margin, spheres, k):
    """Write centre and squared radius of a sphere around a triangle, with a margin [m]."""
    largest = 0.0
    for c in range(3):
        spheres[c, k] = (triangle[0, c] + triangle[1, c] + triangle[2, c]) / 3
    for i in range(3):
        square = 0.0
        for c in range(3):
            square += (triangle[i, c] - spheres[c, k]) ** 2
        largest = max(largest, square)
    spheres[3, k] = (np.sqrt(largest) + margin) ** 2


@inner
def _beyond(spheres, k, x, y, z):
    square = (x - spheres[0, k]) ** 2 + (y - spheres[1, k]) ** 2 + (z - spheres[2, k]) ** 2
    return square > spheres[3, k]


@kernel
def look_ahead(points, ways, triangles, reach, ahead, fresh):
    """Find which points of the edge meet uncut material, and guide those in a cut along it.

    A point is in a cut if it lies above or below a triangle, within `reach`. The cut's faces then
    guide it, up to the cut's end. Elsewhere, what is ahead counts as cut if it lies in a cut along
    which the point moves.

    Args:
        points: [m], shape (p, 3).
        ways: along which they are pulled [m]; of a guided point, its part along the cut remains,
            shape (p, 3).
        triangles: corners of the cut triangles [m], shape (t, 3, 3).
        reach: largest distance from a triangle at which a point is in the cut [m].
        ahead: distance ahead of the points that is looked at [m].
        fresh: output, 1 where a point is pulled into uncut material, else 0, shape (p,).
    """
    # Others are too far from all points to be above or below any.
    margin, kept = reach + ahead + _ROUNDING, np.empty_like(triangles)
    low, high, count = np.empty(3), np.empty(3), 0
    for c in range(3):
        low[c], high[c] = points[:, c].min() - margin, points[:, c].max() + margin
    for k in range(len(triangles)):
        if _meets(triangles[k], low, high):
            kept[count] = triangles[k]
            count += 1
    triangles = kept[:count]
    normals, sizes = np.empty((count, 3)), np.empty(count)
    spheres = np.empty((4, count))
    for k in range(count):
        sizes[k] = _normal(triangles[k], normals[k])
        _surround(triangles[k], reach + _ROUNDING, spheres, k)
    along = np.empty(3)
    for i in range(len(points)):
        fresh[i] = 1.0
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(len(triangles)):
            if sizes[k] == 0.0 or _beyond(spheres, k, x, y, z):
                continue
            if _over(triangles[k], normals[k], sizes[k], x, y, z, reach):
                off = ways[i, 0] * normals[k, 0] + ways[i, 1] * normals[k, 1]
                off += ways[i, 2] * normals[k, 2]
                for c in range(3):
                    along[c] = ways[i, c] - off * normals[k, c]
                if not _is_fresh(
                    points[i], along, ahead, triangles, normals, sizes, spheres, reach
                ):
                    fresh[i] = 0.0
                    for c in range(3):
                        ways[i, c] = along[c]
                break
        if fresh[i]:
            way = ways[i]
            if not _is_fresh(points[i], way, ahead, triangles, normals, sizes, spheres, reach):
                fresh[i] = 0.0


@inner
def _is_fresh(point, way, ahead, triangles, normals, sizes, spheres, reach):
    """Return whether material ahead of a point is in no cut along which the point moves."""
    length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    if length == 0.0:
        return False
    part = ahead / length
    x, y, z = point[0] + part * way[0], point[1] + part * way[1], point[2] + part * way[2]
    for k in range(len(triangles)):
        if sizes[k] == 0.0 or _beyond(spheres, k, x, y, z):
            continue
        across = normals[k, 0] * way[0] + normals[k, 1] * way[1] + normals[k, 2] * way[2]
        if abs(across) > _MAX_SINE_ALONG_CUT * length:
            continue
        if _over(triangles[k], normals[k], sizes[k], x, y, z, reach):
            return False
    return True
