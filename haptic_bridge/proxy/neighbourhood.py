"""The triangles near a point, nearest first, with the closest point of each.

The data of the hot loops lies axis by axis, slot after slot, so that the compiler vectorises over
triangles.
"""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import LEAF_SIZE, Geometry
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import assign

CAPACITY = 256
"""Largest number of triangles kept; of more, the farthest are dropped and the reach shrinks."""
_BATCH = 128
"""Triangles that are measured at once when they are found."""
_KEPT = CAPACITY + 1
_SLOTS = _KEPT + _BATCH
NEAR = record_type(
    [
        ('count', 'i8'),
        ('reach', 'f8'),  # [m] every triangle closer than this to the centre is here
        ('centre', 'f8', (3,)),  # [m]
        ('order', 'i8', (_KEPT,)),  # slots by rising distance; behind them the one to fill next
        ('triangle', 'i8', (_SLOTS,)),
        ('corners', 'f8', (9, _SLOTS)),  # [m] at the blend: x y z of each corner
        ('arms', 'f8', (9, _SLOTS)),  # [m] from the corners to the last point
        ('edges', 'f8', (6, _SLOTS)),  # [m] from the first corner to the others
        ('sliver', 'f8', (_SLOTS,)),  # [m^4] area up to which it is treated as its three edges
        ('covered', 'f8', (_SLOTS,)),  # [m] by which a half-space excludes it; negative: by none
        ('normal', 'f8', (3, _SLOTS)),  # outward unit normal, zero where degenerate
        ('closest', 'f8', (3, _SLOTS)),  # [m] point of the triangle closest to the last point
        ('weights', 'f8', (3, _SLOTS)),  # its barycentric weights
        ('distance', 'f8', (_SLOTS,)),  # [m]
        ('stack', 'i8', (128,)),
        ('gap2', 'f8', (128,)),  # [m^2] squared distance of the boxes on the stack
    ]
)
_SLIVER = 1e-12
"""Squared sine below which a triangle is treated as its three edges."""


@kernel(error_model='numpy')
def gather(
    surface: Geometry,
    blend: float,
    point: np.ndarray,
    reach: float,
    max_count: int,
    near: np.ndarray,
) -> None:
    """Collect up to `max_count` triangles closest to a point, none farther than `reach`.

    Args:
        surface: of the tissue.
        blend: 0 at the surface's start, 1 at its end.
        point: [m], shape (3,).
        reach: [m]; may be infinite.
        max_count: largest number of triangles, up to CAPACITY.
        near: record of NEAR, shape (1,), written.
    """
    w = near[0]
    w.count, w.reach = 0, reach
    assign(w.centre, point)
    w.order[0] = 0
    stack, gap2, boxes = w.stack, w.gap2, surface.boxes
    inner = len(boxes) // 2
    batch = min(max(max_count, LEAF_SIZE), _BATCH)
    # np.int64: of a literal, Numba would compile what it calls once more for each value.
    stack[0], gap2[0], top = 0, _box_distance2(boxes, np.int64(0), point), 1
    found = np.int64(0)
    while top > 0:
        top -= 1
        i = stack[top]
        if gap2[top] >= w.reach * w.reach:
            continue
        if i >= inner:
            first = (i - inner) * LEAF_SIZE
            for triangle in range(first, min(first + LEAF_SIZE, len(surface.triangles))):
                w.triangle[_KEPT + found] = triangle
                found += 1
            if found + LEAF_SIZE > batch:
                _offer(surface, blend, point, found, max_count, near)
                found = np.int64(0)
            continue
        closer, farther = 2 * i + 1, 2 * i + 2
        here, there = _box_distance2(boxes, closer, point), _box_distance2(boxes, farther, point)
        if there < here:
            closer, farther, here, there = farther, closer, there, here
        stack[top], stack[top + 1] = farther, closer
        gap2[top], gap2[top + 1] = there, here
        top += 2
    _offer(surface, blend, point, found, max_count, near)


@inner(error_model='numpy')
def refresh(point: np.ndarray, near: np.ndarray) -> None:
    """Measure the collected triangles from another point [m], shape (3,)."""
    w = near[0]
    _measure(point, np.int64(0), w.count + 1, near)
    for place in range(w.count):
        _sort_down(w.order, w.distance, place)


@inner(error_model='numpy')
def uncover(near: np.ndarray) -> None:
    """Start a step: no half-space excludes a triangle yet."""
    w = near[0]
    for slot in range(w.count + 1):
        w.covered[slot] = -np.inf


@inner(error_model='numpy')
def cover(x: float, y: float, z: float, enough: float, near: np.ndarray) -> None:
    """Mark the triangles from which a half-space keeps the last point away.

    Args:
        x, y, z: its unit normal.
        enough: height over the highest corner along the normal [m] from which it does.
        near: record of NEAR, shape (1,); `covered` becomes 0 or more for those triangles.
    """
    w = near[0]
    arms = w.arms
    for slot in range(w.count + 1):
        a = x * arms[0, slot] + y * arms[1, slot] + z * arms[2, slot]
        b = x * arms[3, slot] + y * arms[4, slot] + z * arms[5, slot]
        c = x * arms[6, slot] + y * arms[7, slot] + z * arms[8, slot]
        w.covered[slot] = max(w.covered[slot], min(min(a, b), c) - enough)


@inner
def _box_distance2(boxes: np.ndarray, i: int, point: np.ndarray) -> float:
    total = 0.0
    for axis in range(3):
        gap = max(boxes[i, axis] - point[axis], point[axis] - boxes[i, 3 + axis], 0.0)
        total += gap * gap
    return total


@inner
def _sort_down(order: np.ndarray, distance: np.ndarray, place: int) -> None:
    slot = order[place]
    while place > 0 and distance[order[place - 1]] > distance[slot]:
        order[place] = order[place - 1]
        place -= 1
    order[place] = slot


@inner(error_model='numpy')
def _offer(
    surface: Geometry, blend: float, point: np.ndarray, found: int, max_count: int, near: np.ndarray
) -> None:
    """Take those of a batch of triangles into the list that are close enough."""
    w = near[0]
    for slot in range(_KEPT, _KEPT + found):
        for j in range(3):
            node = surface.triangles[w.triangle[slot], j]
            for axis in range(3):
                start = surface.start[node, axis]
                w.corners[3 * j + axis, slot] = start + blend * (surface.end[node, axis] - start)
    _set_edges(found, near)
    _measure(point, np.int64(_KEPT), _KEPT + found, near)
    for slot in range(_KEPT, _KEPT + found):
        if w.distance[slot] >= w.reach:
            continue
        _copy(slot, w.order[w.count], near)
        _sort_down(w.order, w.distance, w.count)
        if w.count < max_count:
            w.count += 1
            w.order[w.count] = w.count
        else:
            w.reach = w.distance[w.order[max_count]]


@inner(error_model='numpy')
def _set_edges(found: int, near: np.ndarray) -> None:
    """Set the quantities that do not depend on the point, in a batch."""
    w = near[0]
    corners, edges, normal = w.corners, w.edges, w.normal
    for i in range(found):
        slot = np.uint64(_KEPT + i)
        a, b, c = (corners[3, slot], corners[4, slot], corners[5, slot])
        p, q, r = (corners[6, slot], corners[7, slot], corners[8, slot])
        x, y, z = corners[0, slot], corners[1, slot], corners[2, slot]
        a, b, c, p, q, r = a - x, b - y, c - z, p - x, q - y, r - z
        edges[0, slot], edges[1, slot], edges[2, slot] = a, b, c
        edges[3, slot], edges[4, slot], edges[5, slot] = p, q, r
        longest2 = max(a * a + b * b + c * c, p * p + q * q + r * r)
        w.sliver[slot] = _SLIVER * (longest2 * longest2)
        x, y, z = b * r - c * q, c * p - a * r, a * q - b * p
        size2 = x * x + y * y + z * z
        scale = 1.0 / np.sqrt(size2) if size2 > _SLIVER * longest2 * longest2 else 0.0
        normal[0, slot], normal[1, slot], normal[2, slot] = x * scale, y * scale, z * scale


@inner(error_model='numpy')
def _copy(source: int, slot: int, near: np.ndarray) -> None:
    w = near[0]
    w.triangle[slot], w.sliver[slot] = w.triangle[source], w.sliver[source]
    w.distance[slot] = w.distance[source]
    for i in range(9):
        w.corners[i, slot], w.arms[i, slot] = w.corners[i, source], w.arms[i, source]
    for i in range(6):
        w.edges[i, slot] = w.edges[i, source]
    for i in range(3):
        w.normal[i, slot], w.closest[i, slot] = w.normal[i, source], w.closest[i, source]
        w.weights[i, slot] = w.weights[i, source]


@inner(error_model='numpy')
def _measure(point: np.ndarray, first: int, end: int, near: np.ndarray) -> None:
    """Set closest point, weights and distance of slots (Ericson 2005, section 5.1.5).

    All regions of a triangle are computed and one is chosen: without branches, the compiler takes
    several triangles at once.
    """
    w = near[0]
    weights = w.weights
    x, y, z = point[0], point[1], point[2]
    for slot in range(np.uint64(first), np.uint64(end)):
        d1, d2, d3, d4, d5, d6 = _products(x, y, z, slot, near)
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        area = va + vb + vc
        bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u, v, t = _pick(va <= 0.0, 0.0, 1.0 - bc, bc, va / area, vb / area, vc / area)
        ac = d2 / (d2 - d6)
        u, v, t = _pick((vb <= 0.0) & (d2 >= 0.0) & (d6 <= 0.0), 1.0 - ac, 0.0, ac, u, v, t)
        ab = d1 / (d1 - d3)
        u, v, t = _pick((vc <= 0.0) & (d1 >= 0.0) & (d3 <= 0.0), 1.0 - ab, ab, 0.0, u, v, t)
        u, v, t = _pick((d6 >= 0.0) & (d5 <= d6), 0.0, 0.0, 1.0, u, v, t)
        u, v, t = _pick((d3 >= 0.0) & (d4 <= d3), 0.0, 1.0, 0.0, u, v, t)
        u, v, t = _pick((d1 <= 0.0) & (d2 <= 0.0), 1.0, 0.0, 0.0, u, v, t)
        weights[0, slot], weights[1, slot], weights[2, slot] = u, v, t
        w.distance[slot] = area - w.sliver[slot]
    for slot in range(np.uint64(first), np.uint64(end)):
        if w.distance[slot] <= 0.0:
            _set_edge_weights(point, slot, near)
    _set_closest(x, y, z, first, end, near)


@inner(error_model='numpy')
def _products(
    x: float, y: float, z: float, slot: int, near: np.ndarray
) -> tuple[float, float, float, float, float, float]:
    """Set the arms of a slot; return the products of edges and arms, by corner."""
    w = near[0]
    p, arms, edges = w.corners, w.arms, w.edges
    a, b, c = x - p[0, slot], y - p[1, slot], z - p[2, slot]
    f, g, h = x - p[3, slot], y - p[4, slot], z - p[5, slot]
    k, m, n = x - p[6, slot], y - p[7, slot], z - p[8, slot]
    arms[0, slot], arms[1, slot], arms[2, slot] = a, b, c
    arms[3, slot], arms[4, slot], arms[5, slot] = f, g, h
    arms[6, slot], arms[7, slot], arms[8, slot] = k, m, n
    q, r, s = edges[0, slot], edges[1, slot], edges[2, slot]
    u, v, t = edges[3, slot], edges[4, slot], edges[5, slot]
    return (
        q * a + r * b + s * c,
        u * a + v * b + t * c,
        q * f + r * g + s * h,
        u * f + v * g + t * h,
        q * k + r * m + s * n,
        u * k + v * m + t * n,
    )


@inner
def _pick(
    here: bool, a: float, b: float, c: float, u: float, v: float, t: float
) -> tuple[float, float, float]:
    return (a if here else u), (b if here else v), (c if here else t)


@inner(error_model='numpy')
def _set_closest(x: float, y: float, z: float, first: int, end: int, near: np.ndarray) -> None:
    """Set closest points and distances of slots by their weights."""
    w = near[0]
    p, weights, closest = w.corners, w.weights, w.closest
    for slot in range(np.uint64(first), np.uint64(end)):
        u, v, t = weights[0, slot], weights[1, slot], weights[2, slot]
        a = u * p[0, slot] + v * p[3, slot] + t * p[6, slot]
        b = u * p[1, slot] + v * p[4, slot] + t * p[7, slot]
        c = u * p[2, slot] + v * p[5, slot] + t * p[8, slot]
        closest[0, slot], closest[1, slot], closest[2, slot] = a, b, c
        w.distance[slot] = np.sqrt((x - a) * (x - a) + (y - b) * (y - b) + (z - c) * (z - c))


@inner
def _set_edge_weights(point: np.ndarray, slot: int, near: np.ndarray) -> None:
    """Set the weights of the closest point of the three edges."""
    w = near[0]
    corners = w.corners
    best = np.inf
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        along = length2 = 0.0
        for axis in range(3):
            edge = corners[3 * j + axis, slot] - corners[3 * i + axis, slot]
            along += edge * (point[axis] - corners[3 * i + axis, slot])
            length2 += edge * edge
        t = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
        gap2 = 0.0
        for axis in range(3):
            start = corners[3 * i + axis, slot]
            q = start + t * (corners[3 * j + axis, slot] - start)
            gap2 += (point[axis] - q) ** 2
        if gap2 < best:
            best = gap2
            w.weights[i, slot], w.weights[j, slot], w.weights[k, slot] = 1.0 - t, t, 0.0
