"""Inside test: the side of the surface on which a point is, from its closest triangles."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import norm

TIE_TOLERANCE_M = 1e-9
"""[m] Difference of distances below which triangles count as equally near."""
MAX_FAN = 32
"""Largest number of triangles that may share a vertex."""


@inner
def is_inside(surface: Geometry, point: np.ndarray, near: np.ndarray, outward: np.ndarray) -> bool:
    """Return whether the point is on the inner side of its closest triangles.

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
        if w.distance[slot] > w.distance[nearest] + TIE_TOLERANCE_M:
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


@inner
def _angle_at_closest(corners: np.ndarray, weights: np.ndarray) -> float:
    """Return the angle [rad] of a triangle at its closest point."""
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


@inner
def _on_rim(surface: Geometry, ties: int, near: np.ndarray) -> bool:
    """Return whether the closest point is on an edge of only one triangle."""
    w = near[0]
    weights = w.weights[:, w.order[0]]
    a, b, c = weights[0], weights[1], weights[2]
    if min(a, b, c) > 0.0:
        return False
    if max(a, b, c) < 1.0:
        return ties == 1
    for i in range(ties):
        for j in range(3):
            node = surface.triangles[w.triangle[w.order[i]], j]
            if w.weights[j, w.order[i]] == 0.0 and _uses(surface, node, ties, near) < 2:
                return True
    return False


@inner
def _uses(surface: Geometry, node: int, ties: int, near: np.ndarray) -> int:
    """Return how many of the nearest triangles have a node."""
    w = near[0]
    count = 0
    for i in range(ties):
        triangle = surface.triangles[w.triangle[w.order[i]]]
        if triangle[0] == node or triangle[1] == node or triangle[2] == node:
            count += 1
    return count
