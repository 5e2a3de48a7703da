"""The triangles near a point, nearest first, with the closest point of each."""

import numpy as np
from numba import njit

from haptic_bridge.surface import LEAF, Geometry

CAPACITY = 256
"""Most triangles that are kept; of more, the farthest are dropped and the reach shrinks."""
_SLOTS = CAPACITY + 1
NEAR = np.dtype(
    [
        ('count', 'i8'),
        ('reach', 'f8'),  # [m] every triangle closer than this to the centre is here
        ('centre', 'f8', (3,)),  # [m]
        ('order', 'i8', (_SLOTS,)),  # slots by rising distance; behind them the one to fill next
        ('triangle', 'i8', (_SLOTS,)),
        ('corners', 'f8', (_SLOTS, 3, 3)),  # [m] at the blend
        ('normal', 'f8', (_SLOTS, 3)),  # outward unit normal, zero where degenerate
        ('closest', 'f8', (_SLOTS, 3)),  # [m] point of the triangle closest to the last point
        ('weights', 'f8', (_SLOTS, 3)),  # its barycentric weights
        ('distance', 'f8', (_SLOTS,)),  # [m]
        ('stack', 'i8', (128,)),
    ]
)
_SLIVER = 1e-12
"""Squared sine below which a triangle is treated as its three edges."""


@njit(cache=True, nogil=True)
def gather(
    surface: Geometry, blend: float, point: np.ndarray, reach: float, most: int, near: np.ndarray
) -> None:
    """Collects the at most `most` triangles closest to a point, none as far as `reach`.

    Args:
        surface: of the tissue.
        blend: 0 at the surface's start, 1 at its end.
        point: [m], shape (3,).
        reach: [m]; may be infinite.
        most: up to CAPACITY.
        near: record of NEAR, shape (1,), written.
    """
    w = near[0]
    w.count, w.reach = 0, reach
    w.centre[:] = point
    w.order[0] = 0
    stack, boxes = w.stack, surface.boxes
    inner = len(boxes) // 2
    stack[0], top = 0, 1
    while top > 0:
        top -= 1
        i = stack[top]
        if _box_distance2(boxes, i, point) >= w.reach * w.reach:
            continue
        if i >= inner:
            first = (i - inner) * LEAF
            for triangle in range(first, min(first + LEAF, len(surface.triangles))):
                _offer(surface, blend, point, triangle, most, near)
            continue
        closer, farther = 2 * i + 1, 2 * i + 2
        if _box_distance2(boxes, farther, point) < _box_distance2(boxes, closer, point):
            closer, farther = farther, closer
        stack[top], stack[top + 1] = farther, closer
        top += 2


@njit(cache=True, nogil=True)
def refresh(point: np.ndarray, near: np.ndarray) -> None:
    """Measures the collected triangles from another point [m], shape (3,)."""
    w = near[0]
    for place in range(w.count):
        slot = w.order[place]
        _measure(point, slot, near)
        _sort_down(w.order, w.distance, place)


@njit(cache=True, nogil=True)
def _box_distance2(boxes: np.ndarray, i: int, point: np.ndarray) -> float:
    total = 0.0
    for axis in range(3):
        gap = max(boxes[i, axis] - point[axis], point[axis] - boxes[i, 3 + axis], 0.0)
        total += gap * gap
    return total


@njit(cache=True, nogil=True)
def _sort_down(order: np.ndarray, distance: np.ndarray, place: int) -> None:
    slot = order[place]
    while place > 0 and distance[order[place - 1]] > distance[slot]:
        order[place] = order[place - 1]
        place -= 1
    order[place] = slot


@njit(cache=True, nogil=True)
def _offer(
    surface: Geometry, blend: float, point: np.ndarray, triangle: int, most: int, near: np.ndarray
) -> None:
    """Takes a triangle into the list if it is close enough."""
    w = near[0]
    slot = w.order[w.count]
    corners = w.corners[slot]
    for j in range(3):
        node = surface.triangles[triangle, j]
        for axis in range(3):
            start = surface.start[node, axis]
            corners[j, axis] = start + blend * (surface.end[node, axis] - start)
    _measure(point, slot, near)
    if w.distance[slot] >= w.reach:
        return
    w.triangle[slot] = triangle
    _set_normal(corners, w.normal[slot])
    _sort_down(w.order, w.distance, w.count)
    if w.count < most:
        w.count += 1
        w.order[w.count] = w.count
    else:
        w.reach = w.distance[w.order[most]]


@njit(cache=True, nogil=True)
def _set_normal(corners: np.ndarray, normal: np.ndarray) -> None:
    ab = (
        corners[1, 0] - corners[0, 0],
        corners[1, 1] - corners[0, 1],
        corners[1, 2] - corners[0, 2],
    )
    ac = (
        corners[2, 0] - corners[0, 0],
        corners[2, 1] - corners[0, 1],
        corners[2, 2] - corners[0, 2],
    )
    x = ab[1] * ac[2] - ab[2] * ac[1]
    y = ab[2] * ac[0] - ab[0] * ac[2]
    z = ab[0] * ac[1] - ab[1] * ac[0]
    size2 = x * x + y * y + z * z
    longest2 = max(
        ab[0] * ab[0] + ab[1] * ab[1] + ab[2] * ab[2], ac[0] * ac[0] + ac[1] * ac[1] + ac[2] * ac[2]
    )
    scale = 1.0 / np.sqrt(size2) if size2 > _SLIVER * longest2 * longest2 else 0.0
    normal[0], normal[1], normal[2] = x * scale, y * scale, z * scale


@njit(cache=True, nogil=True)
def _measure(point: np.ndarray, slot: int, near: np.ndarray) -> None:
    """Sets closest point, weights and distance of one triangle (Ericson 2005, section 5.1.5)."""
    w = near[0]
    corners, closest = w.corners[slot], w.closest[slot]
    u, v, t = _weights(point, corners, w.weights[slot])
    total = 0.0
    for axis in range(3):
        closest[axis] = u * corners[0, axis] + v * corners[1, axis] + t * corners[2, axis]
        total += (point[axis] - closest[axis]) ** 2
    w.distance[slot] = np.sqrt(total)


@njit(cache=True, nogil=True)
def _weights(
    point: np.ndarray, corners: np.ndarray, weights: np.ndarray
) -> tuple[float, float, float]:
    d1 = d2 = d3 = d4 = d5 = d6 = ab2 = ac2 = 0.0
    for axis in range(3):
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        ab, ac, p = b - a, c - a, point[axis]
        d1 += ab * (p - a)
        d2 += ac * (p - a)
        d3 += ab * (p - b)
        d4 += ac * (p - b)
        d5 += ab * (p - c)
        d6 += ac * (p - c)
        ab2 += ab * ab
        ac2 += ac * ac
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    area = va + vb + vc
    if area <= _SLIVER * max(ab2, ac2) ** 2:
        _edge_weights(point, corners, weights)
    elif d1 <= 0.0 and d2 <= 0.0:
        weights[:] = (1.0, 0.0, 0.0)
    elif d3 >= 0.0 and d4 <= d3:
        weights[:] = (0.0, 1.0, 0.0)
    elif d6 >= 0.0 and d5 <= d6:
        weights[:] = (0.0, 0.0, 1.0)
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        weights[:] = (1.0 - t, t, 0.0)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        weights[:] = (1.0 - t, 0.0, t)
    elif va <= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        weights[:] = (0.0, 1.0 - t, t)
    else:
        weights[:] = (va / area, vb / area, vc / area)
    return weights[0], weights[1], weights[2]


@njit(cache=True, nogil=True)
def _edge_weights(point: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> None:
    """Weights of the closest point of the three edges."""
    best = np.inf
    for i in range(3):
        j = (i + 1) % 3
        along = length2 = 0.0
        for axis in range(3):
            edge = corners[j, axis] - corners[i, axis]
            along += edge * (point[axis] - corners[i, axis])
            length2 += edge * edge
        t = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
        gap2 = 0.0
        for axis in range(3):
            q = corners[i, axis] + t * (corners[j, axis] - corners[i, axis])
            gap2 += (point[axis] - q) ** 2
        if gap2 < best:
            best = gap2
            weights[:] = 0.0
            weights[i] = 1.0 - t
            weights[j] = t
