"""Which side of the surface a point is on, from the triangles at its closest point."""

import numpy as np
from numba import njit

from haptic_bridge.half_spaces import norm
from haptic_bridge.surface import Geometry

TIED = 1e-9
"""[m] of difference in distance at which triangles count as equally near."""
LARGEST_FAN = 32
"""Triangles that may share a vertex."""


@njit(cache=True, nogil=True)
def is_inside(surface: Geometry, point: np.ndarray, near: np.ndarray, outward: np.ndarray) -> bool:
    """Whether the point is on the inner side of its closest triangles.

    The side is that of the angle-weighted pseudonormal (Baerentzen and Aanaes 2005), which is right
    at edges and vertices too. The rim of an open surface has no inner side.

    Args:
        surface: of the tissue.
        point: [m], shape (3,).
        near: triangles that `gather` has found around the point, record of NEAR, shape (1,).
        outward: unit pseudonormal, shape (3,), written.
    """
    w = near[0]
    nearest = w.order[0]
    ties = 0
    outward[:] = 0.0
    while ties < w.count:
        slot = w.order[ties]
        if w.distance[slot] > w.distance[nearest] + TIED:
            break
        angle = _angle_at_closest(w.corners[:, slot], w.weights[:, slot])
        for axis in range(3):
            outward[axis] += angle * w.normal[axis, slot]
        ties += 1
    height = 0.0
    for axis in range(3):
        height += outward[axis] * (point[axis] - w.closest[axis, nearest])
    if height >= 0.0 or _on_rim(surface, ties, near):
        return False
    outward /= norm(outward)
    return True


@njit(cache=True, nogil=True)
def _angle_at_closest(corners: np.ndarray, weights: np.ndarray) -> float:
    """Angle [rad] that a triangle takes up around its closest point."""
    for j in range(3):
        if weights[j] != 1.0:
            continue
        a, b = 3 * ((j + 1) % 3), 3 * ((j + 2) % 3)
        ab = aa = bb = 0.0
        for axis in range(3):
            here = corners[3 * j + axis]
            u, v = corners[a + axis] - here, corners[b + axis] - here
            ab += u * v
            aa += u * u
            bb += v * v
        return np.arccos(min(max(ab / np.sqrt(max(aa * bb, 1e-300)), -1.0), 1.0))
    on_edge = weights[0] == 0.0 or weights[1] == 0.0 or weights[2] == 0.0
    return np.pi if on_edge else 2.0 * np.pi


@njit(cache=True, nogil=True)
def _on_rim(surface: Geometry, ties: int, near: np.ndarray) -> bool:
    """Whether the closest point is on an edge that only one triangle has."""
    w = near[0]
    weights = w.weights[:, w.order[0]]
    if weights.min() > 0.0:
        return False
    if weights.max() < 1.0:
        return ties == 1
    for i in range(ties):
        for j in range(3):
            node = surface.triangles[w.triangle[w.order[i]], j]
            if w.weights[j, w.order[i]] == 0.0 and _uses(surface, node, ties, near) < 2:
                return True
    return False


@njit(cache=True, nogil=True)
def _uses(surface: Geometry, node: int, ties: int, near: np.ndarray) -> int:
    """How many of the nearest triangles have a node."""
    w = near[0]
    count = 0
    for i in range(ties):
        triangle = surface.triangles[w.triangle[w.order[i]]]
        if triangle[0] == node or triangle[1] == node or triangle[2] == node:
            count += 1
    return count
