"""Projection of a point onto an intersection of half-spaces in 3D.

Each half-space i holds all y with normal_i . y >= bound_i. The closest point is found plane by
plane (Seidel 1991): a new plane that the optimum so far violates must hold the new optimum, which
is then found in one dimension less. At most three planes are active; no tuning, bounded work.
"""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import assign

MAX_HALF_SPACES = 64
"""Half-spaces."""
SPACES = record_type(
    [
        ('count', 'i8'),
        ('normal', 'f8', (MAX_HALF_SPACES, 3)),  # unit
        ('bound', 'f8', (MAX_HALF_SPACES,)),  # [m]
        ('goal', 'f8', (3,)),  # [m] the point to project
        ('optimum', 'f8', (3,)),  # [m] its projection
        ('feasible', 'b1'),
    ]
)
TOLERANCE_M = 1e-12
"""[m] Violation of a half-space that is accepted."""
_PARALLEL = 1e-20
"""Squared sine of the angle of planes that count as one."""
_OPPOSED = 1e-12
"""Squared sine of the angle of planes, facing each other, that count as a gap without an end."""
_SOFTNESS = 1e-9
"""Weight of the goal against the half-spaces where these contradict each other."""


@kernel
def begin(spaces: np.ndarray, goal: np.ndarray) -> None:
    """Start with the whole space; goal [m], shape (3,)."""
    s = spaces[0]
    s.count, s.feasible = 0, True
    assign(s.goal, goal)
    assign(s.optimum, goal)


@inner
def value(spaces: np.ndarray, i: int, y: np.ndarray) -> float:
    """Return how far y lies inside of half-space i [m]; negative: outside."""
    n = spaces[0].normal[i]
    return n[0] * y[0] + n[1] * y[1] + n[2] * y[2] - spaces[0].bound[i]


@kernel
def add(spaces: np.ndarray, x: float, y: float, z: float, bound: float) -> None:
    """Add a half-space with unit normal (x, y, z), and move the optimum into it."""
    s = spaces[0]
    i = s.count
    s.normal[i, 0], s.normal[i, 1], s.normal[i, 2], s.bound[i] = x, y, z, bound
    s.count += 1
    if not s.feasible or value(spaces, i, s.optimum) >= -TOLERANCE_M:
        return
    assign(s.optimum, s.goal)
    _shift(s.optimum, x, y, z, -value(spaces, i, s.goal))
    for j in range(i):
        if value(spaces, j, s.optimum) < -TOLERANCE_M and not _to_line(spaces, i, j):
            s.feasible = False
            return


@inner
def worst(spaces: np.ndarray, y: np.ndarray) -> float:
    """Return the largest violation of a half-space at y [m]."""
    largest = 0.0
    for i in range(spaces[0].count):
        largest = max(largest, -value(spaces, i, y))
    return largest


@inner
def _shift(y: np.ndarray, u: float, v: float, w: float, times: float) -> None:
    y[0] += times * u
    y[1] += times * v
    y[2] += times * w


@inner
def _to_line(spaces: np.ndarray, i: int, j: int) -> bool:
    """Move the optimum to the line of planes i and j, inside the first j; False if it cannot."""
    s = spaces[0]
    a, b = s.normal[i], s.normal[j]
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    # Part of b along plane i: exact to the last digits however small the angle.
    u, v, w = b[0] - cosine * a[0], b[1] - cosine * a[1], b[2] - cosine * a[2]
    sine2 = u * u + v * v + w * w
    if sine2 < _PARALLEL or (cosine < 0.0 and sine2 < _OPPOSED):
        return cosine > 0.0
    assign(s.optimum, s.goal)
    _shift(s.optimum, a[0], a[1], a[2], -value(spaces, i, s.optimum))
    _shift(s.optimum, u, v, w, -value(spaces, j, s.optimum) / sine2)
    scale = 1.0 / np.sqrt(sine2)
    x = (a[1] * w - a[2] * v) * scale
    y = (a[2] * u - a[0] * w) * scale
    z = (a[0] * v - a[1] * u) * scale
    low, high = -np.inf, np.inf
    for k in range(j):
        n = s.normal[k]
        slope = n[0] * x + n[1] * y + n[2] * z
        missing = -value(spaces, k, s.optimum)
        if slope > 1e-9:
            low = max(low, missing / slope)
        elif slope < -1e-9:
            high = min(high, missing / slope)
        elif missing > 1e-9:
            return False
    if low > high + TOLERANCE_M:
        return False
    t = min(max(0.0, low), high)
    _shift(s.optimum, x, y, z, t)
    return True


@kernel
def compromise(spaces: np.ndarray) -> None:
    """Compute the optimum of contradictory half-spaces: least squares of the violations.

    Where the half-spaces leave a direction free, the optimum is the goal's along it.
    """
    s = spaces[0]
    s.optimum[:] = 0.0
    for _ in range(8):
        # (softness I + sum n n^T) y = softness goal + sum bound n, over the violated ones.
        xx = yy = zz = _SOFTNESS
        xy = xz = yz = 0.0
        p, q, r = _SOFTNESS * s.goal[0], _SOFTNESS * s.goal[1], _SOFTNESS * s.goal[2]
        for i in range(s.count):
            if value(spaces, i, s.optimum) > TOLERANCE_M:
                continue
            x, y, z = s.normal[i, 0], s.normal[i, 1], s.normal[i, 2]
            xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
            xy, xz, yz = xy + x * y, xz + x * z, yz + y * z
            p, q, r = p + s.bound[i] * x, q + s.bound[i] * y, r + s.bound[i] * z
        cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        scale = 1.0 / (xx * cx + xy * cy + xz * cz)
        s.optimum[0] = scale * (cx * p + cy * q + cz * r)
        s.optimum[1] = scale * (cy * p + (xx * zz - xz * xz) * q + (xy * xz - xx * yz) * r)
        s.optimum[2] = scale * (cz * p + (xy * xz - xx * yz) * q + (xx * yy - xy * xy) * r)
