"""Where the blade moves in material that is cut already: fracture is paid for once.

The mesh shows a cut about one element behind the blade. What has been cut is therefore known from
two sources: the triangles that cuts have opened, and the strips that the edge has slipped over last
but that the mesh may not have yet.
"""

import numpy as np
from numba import njit

from tissue_sim.mesh import TetMesh
from tissue_sim.topology import CUT

THICKNESS = 4e-4
"""Of a scalpel's blade [m]: half of it away from a cut the blade is still in that cut."""
_LONGEST_STRIP = 5e-4
_STRIPS = 64
_ROUNDING = 1e-9
_ALONG = 0.5
"""Largest sine of the angle between a motion and the cut that it goes along."""


class Fracture:
    """The strips that the edge has cut last, carried along with the tissue.

    Limitations: they are carried as one rigid piece with the tissue at the blade, which holds near
        the blade; farther off the mesh has the cut. A motion counts as one along a cut up to 30
        degrees off it.
    """

    def __init__(self) -> None:
        self._strips = np.zeros((0, 2, 2, 3))
        self._goes_on = False

    def carry(self, way: np.ndarray) -> None:
        """The tissue has moved by a way [m], shape (3,)."""
        self._strips += way

    def add(self, before: np.ndarray, after: np.ndarray) -> None:
        """The edge has cut its way.

        Args:
            before, after: root and tip of the edge [m], shape (2, 3).
        """
        if self._goes_on and _way(self._strips[-1, 0], after) < _LONGEST_STRIP:
            self._strips[-1, 1] = after
        else:
            strip = np.stack([before, after])[None]
            self._strips = np.concatenate([self._strips[1 - _STRIPS :], strip])
        self._goes_on = True

    def leave(self) -> None:
        """The edge has moved without cutting: the next strip is a new one."""
        self._goes_on = False

    def forget(self) -> None:
        """The edge has left the tissue, to come back elsewhere."""
        self._strips = self._strips[:0]
        self._goes_on = False

    def behind(self, distance: float) -> np.ndarray | None:
        """The edge, shape (2, 3), a distance [m] or more before the last strip's end.

        The earliest that is remembered where there are not enough strips; None without any.
        """
        for strip in self._strips[::-1]:
            if _way(strip[0], self._strips[-1, 1]) >= distance:
                return strip[0]
        return self._strips[0, 0] if len(self._strips) else None

    def near(self, mesh: TetMesh, positions: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Triangles that are cut, of which the box meets that of some points.

        Args:
            mesh: the tissue.
            positions: current nodes [m], shape (n, 3).
            points: [m], shape (p, 3).

        Returns:
            Their corners [m], shape (t, 3, 3).
        """
        root, tip = self._strips[:, :, 0], self._strips[:, :, 1]
        corners = np.concatenate(
            [
                positions[mesh.triangles[mesh.triangle_kind == CUT]],
                np.stack([root[:, 0], tip[:, 0], tip[:, 1]], axis=1),
                np.stack([root[:, 0], tip[:, 1], root[:, 1]], axis=1),
            ]
        )
        low, high = points.min(axis=0) - THICKNESS, points.max(axis=0) + THICKNESS
        meets = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
        return np.ascontiguousarray(corners[meets.all(axis=1)])


def _way(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


@njit(cache=True)
def _normal(triangle, normal):
    """Writes the unit normal of a triangle's corners; returns twice its area, 0 for a sliver."""
    a = triangle[0]
    u, v = triangle[1] - a, triangle[2] - a
    normal[0] = u[1] * v[2] - u[2] * v[1]
    normal[1] = u[2] * v[0] - u[0] * v[2]
    normal[2] = u[0] * v[1] - u[1] * v[0]
    size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if size < 1e-14:
        return 0.0
    normal /= size
    return size


@njit(cache=True)
def _over(triangle, normal, size, x, y, z, reach):
    """Whether a place is above or below a triangle, within `reach` [m]."""
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


@njit(cache=True)
def cut_normal(points, triangles, reach):
    """Mean unit normal of what is cut at some points, shape (3,); zero where most are in no cut.

    Args:
        points: [m], shape (p, 3).
        triangles: corners of what is cut [m], shape (t, 3, 3).
        reach: how far off a triangle a point is still in the cut [m].
    """
    total, normal = np.zeros(3), np.empty(3)
    found = np.zeros(len(points), np.bool_)
    for k in range(len(triangles)):
        size = _normal(triangles[k], normal)
        if size == 0.0:
            continue
        for i in range(len(points)):
            if not found[i] and _over(
                triangles[k], normal, size, points[i, 0], points[i, 1], points[i, 2], reach
            ):
                found[i] = True
                same = total[0] * normal[0] + total[1] * normal[1] + total[2] * normal[2] >= 0.0
                total += normal if same else -normal
    size = np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
    if 2 * found.sum() < len(points) or size == 0.0:
        return np.zeros(3)
    return total / size


@njit(cache=True)
def count_fresh(points, ahead, motion, triangles, reach):
    """How many points move on into material that is not cut yet.

    Args:
        points: [m], shape (p, 3).
        ahead: added to each of them [m], shape (3,).
        motion: unit vector, shape (3,).
        triangles: corners of what is cut [m], shape (t, 3, 3).
        reach: how far off a triangle a point is still in the cut [m].

    Returns:
        The count. A point is in a cut if a triangle along which it moves has it above or below
        itself, within `reach`.
    """
    fresh, normal = len(points), np.empty(3)
    paid = np.zeros(len(points), np.bool_)
    for k in range(len(triangles)):
        size = _normal(triangles[k], normal)
        across = normal[0] * motion[0] + normal[1] * motion[1] + normal[2] * motion[2]
        if size == 0.0 or abs(across) > _ALONG:
            continue
        for i in range(len(points)):
            x, y, z = points[i, 0] + ahead[0], points[i, 1] + ahead[1], points[i, 2] + ahead[2]
            if not paid[i] and _over(triangles[k], normal, size, x, y, z, reach):
                paid[i] = True
                fresh -= 1
    return fresh
