"""Cut material around the blade, so that fracture is paid for only once.

The mesh shows a cut about one element behind the blade. The cut is therefore known from two
sources: the triangles opened by cuts, and the latest strips swept by the edge, which the mesh may
not contain yet.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import assign_all

BLADE_THICKNESS = 4e-4
"""Of a scalpel's blade [m]. Up to half of it away from a cut, the blade is still in that cut."""
KNOTS = 24
"""Points by which an edge is kept: its tip, its root, and between them."""
MAX_STRIPS = 48
_REACH = BLADE_THICKNESS / 2
"""[m] from a triangle up to which a point is in the cut."""
_AHEAD = 1e-4
"""[m] ahead of the edge, where the tissue is tested for a cut."""
_MAX_STRIP = 5e-4
_ROUNDING = 1e-9
_MAX_SINE_ALONG_CUT = 0.5
"""Largest sine of the angle between a motion along a cut and that cut."""
_BINS = 32
"""Parts of the edge by which triangles are listed."""


class Strips(NamedTuple):
    """The latest strips cut by the edge, moved with the tissue; kernels change them in place.

    Limitations: all of them move with the tissue at the blade. This holds near the blade; farther
        off the mesh has the cut. A motion up to 30 degrees off a cut counts as
        along it.

    Attributes:
        knots: of the edge before and after, from its tip to its root [m], shape
            (MAX_STRIPS, 2, KNOTS, 3).
        counts: number of strips, and whether the last one goes on, shape (2,).
    """

    knots: np.ndarray
    counts: np.ndarray

    @staticmethod
    def empty() -> 'Strips':
        """Return room for strips, without any."""
        return Strips(np.zeros((MAX_STRIPS, 2, KNOTS, 3)), np.zeros(2, np.int64))

    def behind(self, distance: float) -> np.ndarray | None:
        """Return the edge at a distance [m] or more before the last strip's end, all along it.

        With too few strips it is the earliest edge, without any None.

        Returns:
            Its root and tip [m], shape (2, 3).
        """
        strips = self.knots[: self.counts[0]]
        for strip in strips[::-1]:
            if np.linalg.norm(strip[0] - strips[-1, 1], axis=1).min() >= distance:
                return np.array(strip[0][[-1, 0]])
        return np.array(strips[0, 0][[-1, 0]]) if len(strips) else None


class CutFaces(NamedTuple):
    """Triangles of cuts near the edge, listed by the part of the edge that they lie beside.

    Attributes:
        planes: three affine functions of a place, as three factors and a constant: height above
            the triangle [m], and two barycentric coordinates of its foot, shape (t, 3, 4).
        line: unit vector along the edge, least coordinate along it [m], bins per metre, (5,).
        starts: where the list of each bin begins, shape (_BINS + 1,).
        listed: triangles of the bins, one after the other.
    """

    planes: np.ndarray
    line: np.ndarray
    starts: np.ndarray
    listed: np.ndarray


@inner
def add_strip(strips, before, after):
    """Add a strip cut by the edge, or lengthen the last one.

    Args:
        strips: `Strips`.
        before, after: points of the edge from its tip to its root [m], shape (KNOTS, 3).
    """
    knots, counts = strips
    count = counts[0]
    if counts[1] and _path_length(knots[count - 1, 0], after) < _MAX_STRIP:
        assign_all(knots[count - 1, 1], after)
        return
    if count == MAX_STRIPS:
        for k in range(count - 1):
            for side in range(2):
                assign_all(knots[k, side], knots[k + 1, side])
        count -= 1
    assign_all(knots[count, 0], before)
    assign_all(knots[count, 1], after)
    counts[0], counts[1] = count + 1, 1


@inner
def _path_length(before, after):
    longest = 0.0
    for k in range(len(before)):
        square = 0.0
        for c in range(3):
            square += (after[k, c] - before[k, c]) ** 2
        longest = max(longest, square)
    return np.sqrt(longest)


@inner
def faces_near(positions, opened, strips, low, high, direction):
    """Return the `CutFaces` whose bounding boxes meet a box, of the strips after the others.

    Strips are divided between their knots: first come the halves with the edge before.

    Args:
        positions: nodes now [m], shape (n, 3).
        opened: triangles of the surface that cuts have opened, shape (c, 3).
        strips: `Strips`.
        low, high: corners of the box [m], shape (3,).
        direction: unit vector along the edge, shape (3,).
    """
    knots, strip_count = strips.knots, strips.counts[0]
    found = np.empty((len(opened) + 2 * (KNOTS - 1) * strip_count, 3, 3))
    count = 0
    for k in range(len(opened)):
        for i in range(3):
            for c in range(3):
                found[count, i, c] = positions[opened[k, i], c]
        if _meets(found[count], low, high):
            count += 1
    for half in range(2):
        for k in range(strip_count):
            for i in range(KNOTS - 1):
                for c in range(3):
                    found[count, 0, c] = knots[k, 0, i + 1, c]
                    found[count, 1, c] = knots[k, half, i, c]
                    found[count, 2, c] = knots[k, 1, i + half, c]
                if _meets(found[count], low, high):
                    count += 1
    found, planes = found[:count], np.empty((count, 3, 4))
    for k in range(count):
        _write_planes(found, planes, k)
    line, starts, listed = _list_by_bin(found, low, high, direction)
    return CutFaces(planes, line, starts, listed)


@inner
def _list_by_bin(triangles, low, high, direction):
    """Return line, starts and list of `CutFaces` for triangles near a box."""
    line = np.empty(5)
    least, most = 0.0, 0.0
    for c in range(3):
        line[c] = direction[c]
        at, beyond = direction[c] * low[c], direction[c] * high[c]
        least, most = least + min(at, beyond), most + max(at, beyond)
    line[3], line[4] = least, _BINS / (most - least)
    margin = _REACH + _AHEAD + _ROUNDING
    ranges = np.empty((len(triangles), 2), np.int64)
    starts = np.zeros(_BINS + 1, np.int64)
    for k in range(len(triangles)):
        first, last = np.inf, -np.inf
        for i in range(3):
            at = 0.0
            for c in range(3):
                at += direction[c] * triangles[k, i, c]
            first, last = min(first, at), max(last, at)
        ranges[k, 0], ranges[k, 1] = _bin(line, first - margin), _bin(line, last + margin)
        for b in range(ranges[k, 0], ranges[k, 1] + 1):
            starts[b + 1] += 1
    for b in range(_BINS):
        starts[b + 1] += starts[b]
    filled, listed = starts.copy(), np.empty(starts[_BINS], np.int64)
    for k in range(len(triangles)):
        for b in range(ranges[k, 0], ranges[k, 1] + 1):
            listed[filled[b]] = k
            filled[b] += 1
    return line, starts, listed


@inner
def _bin(line, at):
    """Return the bin of a coordinate along the edge [m]; beyond the ends, the last there."""
    return int(min(max((at - line[3]) * line[4], 0.0), _BINS - 1.0))


@inner
def _meets(triangle, low, high):
    """Return whether the bounding box of a triangle meets a box."""
    for c in range(3):
        x, y, z = triangle[0, c], triangle[1, c], triangle[2, c]
        if max(max(x, y), z) < low[c] or min(min(x, y), z) > high[c]:
            return False
    return True


@inner
def _write_planes(triangles, planes, k):
    """Write the functions of `CutFaces.planes` of a triangle; no place is above a sliver."""
    x, y, z = triangles[k, 0, 0], triangles[k, 0, 1], triangles[k, 0, 2]
    u0, u1, u2 = triangles[k, 1, 0] - x, triangles[k, 1, 1] - y, triangles[k, 1, 2] - z
    v0, v1, v2 = triangles[k, 2, 0] - x, triangles[k, 2, 1] - y, triangles[k, 2, 2] - z
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if size < 1e-14:
        for row in range(3):
            _write_plane(planes, k, row, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        planes[k, 0, 3] = np.inf
        return
    n0, n1, n2 = n0 / size, n1 / size, n2 / size
    _write_plane(planes, k, 0, n0, n1, n2, x, y, z)
    a, b, c = (v1 * n2 - v2 * n1), (v2 * n0 - v0 * n2), (v0 * n1 - v1 * n0)
    _write_plane(planes, k, 1, a / size, b / size, c / size, x, y, z)
    a, b, c = (n1 * u2 - n2 * u1), (n2 * u0 - n0 * u2), (n0 * u1 - n1 * u0)
    _write_plane(planes, k, 2, a / size, b / size, c / size, x, y, z)


@inner
def _write_plane(planes, k, row, a, b, c, x, y, z):
    """Write an affine function with factors a, b, c that is zero at a place."""
    planes[k, row, 0], planes[k, row, 1], planes[k, row, 2] = a, b, c
    planes[k, row, 3] = -(a * x + b * y + c * z)


@inner
def _value(planes, k, row, x, y, z):
    at = planes[k, row, 0] * x + planes[k, row, 1] * y + planes[k, row, 2] * z
    return at + planes[k, row, 3]


@inner
def _over(planes, k, x, y, z):
    """Return whether a place is above or below a triangle, within reach."""
    if abs(_value(planes, k, 0, x, y, z)) > _REACH:
        return False
    beta, gamma = _value(planes, k, 1, x, y, z), _value(planes, k, 2, x, y, z)
    return beta >= -_ROUNDING and gamma >= -_ROUNDING and beta + gamma <= 1.0 + _ROUNDING


@inner
def look_ahead(points, ways, i, faces):
    """Return whether a point of the edge is pulled into uncut material, and guide it in a cut.

    A point is in a cut if it lies above or below a triangle, within reach. The cut's faces then
    guide it, up to the cut's end. Elsewhere, what is ahead counts as cut if it lies in a cut along
    which the point moves.

    Args:
        points: [m], shape (p, 3).
        ways: along which they are pulled [m]; of a guided point, its part along the cut remains,
            shape (p, 3).
        i: which point.
        faces: `CutFaces`.
    """
    planes, line, starts, listed = faces
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    a, b, c = ways[i, 0], ways[i, 1], ways[i, 2]
    at = _bin(line, x * line[0] + y * line[1] + z * line[2])
    near = listed[starts[at] : starts[at + 1]]
    for k in near:
        if not _over(planes, k, x, y, z):
            continue
        n0, n1, n2 = planes[k, 0, 0], planes[k, 0, 1], planes[k, 0, 2]
        off = a * n0 + b * n1 + c * n2
        u, v, w = a - off * n0, b - off * n1, c - off * n2
        if not _is_fresh(planes, near, x, y, z, u, v, w):
            ways[i, 0], ways[i, 1], ways[i, 2] = u, v, w
            return False
        break
    return _is_fresh(planes, near, x, y, z, a, b, c)


@inner
def _is_fresh(planes, near, x, y, z, a, b, c):
    """Return whether material ahead of a point is in no cut along which the point moves.

    Args:
        planes: of `CutFaces`.
        near: its triangles near the point.
        x, y, z: the point [m].
        a, b, c: its way [m].
    """
    length = np.sqrt(a * a + b * b + c * c)
    if length == 0.0:
        return False
    part = _AHEAD / length
    x, y, z = x + part * a, y + part * b, z + part * c
    for k in near:
        across = planes[k, 0, 0] * a + planes[k, 0, 1] * b + planes[k, 0, 2] * c
        if abs(across) <= _MAX_SINE_ALONG_CUT * length and _over(planes, k, x, y, z):
            return False
    return True
