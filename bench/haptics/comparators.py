"""Contact models to compare with the proxy: penalty method and god-object, same interface.

They show the known defects (docs/haptics.md).
"""

import numpy as np
from numba import njit

from cutting_trainer.haptic_bridge.proxy.inside_test import MAX_FAN, is_inside
from cutting_trainer.haptic_bridge.proxy.kernels import STATE
from cutting_trainer.haptic_bridge.proxy.neighbourhood import CAPACITY, gather, refresh
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy, Touch
from cutting_trainer.haptic_bridge.proxy.surface import Geometry, Surface

_PLANE_OFFSET_M = 1e-7
"""[m] Distance of the god-object from its planes, so that rounding drops it through none."""
_MAX_ROUNDS = 4


class Penalty:
    """The penalty method (thesis 6.1.1): pushes out by the shortest path, whatever the entry was.

    Limitations: forgets where the tool came from, so it pops through walls thinner than twice the
    depth, and its direction flips where two sides are equally near.

    Args:
        radius: of the sphere [m].
    """

    def __init__(self, radius: float) -> None:
        self.radius = radius
        self._state = np.zeros(1, STATE)
        self.touch = Touch(self._state)

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def step(self, surface: Surface, blend: float, device: np.ndarray) -> Touch:
        """Find the shortest path out, see `Proxy.step`."""
        _step_out(surface.geometry, blend, np.asarray(device, float), self.radius, self._state)
        return self.touch


class GodObject:
    """A point that triangles hold back on its way to the device (Zilles and Salisbury 1995).

    Up to three planes that the straight path would cross hold it; of these it takes the point that
    is nearest to the device.

    Limitations: a point without radius, so it touches later than the sphere by the radius; it
    follows no moving surface, and a surface that passes over it loses it; it can slip through the
    gap between triangles that round-off leaves.

    Args:
        radius: not used; here for the common interface [m].
    """

    def __init__(self, radius: float) -> None:
        self.radius = radius
        self._state = np.zeros(1, STATE)
        self._state['nodes'] = -1
        self.touch = Touch(self._state)

    def reset(self) -> None:
        """Start at the device."""
        self._state['placed'] = False

    def step(self, surface: Surface, blend: float, device: np.ndarray) -> Touch:
        """Move the god-object towards the device, see `Proxy.step`."""
        _follow(surface.geometry, blend, np.asarray(device, float), self._state)
        return self.touch


CONTACTS: dict[str, type[Proxy] | type[Penalty] | type[GodObject]] = {
    'proxy': Proxy,
    'penalty': Penalty,
    'god_object': GodObject,
}


@njit(cache=True, nogil=True)
def _write(surface: Geometry, slot: int, weights: np.ndarray, state: np.ndarray) -> None:
    """Write the contact: a triangle of the neighbourhood and its point with the given weights."""
    s = state[0]
    near = s.near[0]
    s.nodes[:] = 0
    s.weights[:] = 0.0
    s.contact[:] = 0.0
    for j in range(3):
        s.nodes[j] = surface.triangles[near.triangle[slot], j]
        s.weights[j] = weights[j]
        for axis in range(3):
            s.contact[axis] += weights[j] * near.corners[3 * j + axis, slot]


@njit(cache=True, nogil=True)
def _step_out(
    surface: Geometry, blend: float, device: np.ndarray, radius: float, state: np.ndarray
) -> None:
    s = state[0]
    near = s.near[0]
    s.touching = False
    s.depth = 0.0
    s.position[:] = device
    s.weights[:] = 0.0
    gather(surface, blend, device, np.inf, MAX_FAN, s.near)
    if near.count == 0:
        return
    slot = near.order[0]
    inside = is_inside(surface, device, s.near, s.step)
    gap = near.distance[slot]
    if not inside and gap <= 1e-12:
        return
    for axis in range(3):
        s.normal[axis] = s.step[axis]
        if gap > 1e-12:
            s.normal[axis] = (device[axis] - near.closest[axis, slot]) / gap
            s.normal[axis] *= -1.0 if inside else 1.0
    _write(surface, slot, near.weights[:, slot], state)
    height = -gap if inside else gap
    if height >= radius:
        return
    s.touching = True
    s.depth = radius - height
    for axis in range(3):
        s.position[axis] = device[axis] + s.depth * s.normal[axis]


@njit(cache=True, nogil=True)
def _follow(surface: Geometry, blend: float, device: np.ndarray, state: np.ndarray) -> None:
    s = state[0]
    near, goal, p = s.near[0], s.goal, s.position
    if not s.placed:
        p[:] = device
        s.placed = True
    s.touching = False
    s.depth = 0.0
    length = 0.0
    for axis in range(3):
        goal[axis] = 0.5 * (p[axis] + device[axis])
        length += (device[axis] - p[axis]) ** 2
    length = np.sqrt(length)
    gather(surface, blend, goal, 1.5 * length + 1e-6, CAPACITY, s.near)
    goal[:] = device
    planes = np.empty((3, 3))
    slots = np.empty(3, np.int64)
    held = 0
    weights = np.empty(3)
    for _ in range(_MAX_ROUNDS):
        slot = _first_crossed(p, goal, slots, held, weights, s.near)
        if slot < 0 or held == 3:
            break
        planes[held] = near.normal[:, slot]
        slots[held] = slot
        held += 1
        goal[:] = _nearest_on(p, device, planes, held, slots, s.near)
    if held == 0:
        p[:] = device
        return
    if slot < 0:
        p[:] = goal
    depth = 0.0
    for axis in range(3):
        s.step[axis] = p[axis] - device[axis]
        depth += s.step[axis] ** 2
    s.depth = np.sqrt(depth)
    if s.depth <= 1e-9:
        return
    s.touching = True
    for axis in range(3):
        s.normal[axis] = s.step[axis] / s.depth
    refresh(p, s.near)
    _write(surface, slots[0], near.weights[:, slots[0]], state)


@njit(cache=True, nogil=True)
def _first_crossed(
    start: np.ndarray,
    end: np.ndarray,
    slots: np.ndarray,
    held: int,
    weights: np.ndarray,
    nears: np.ndarray,
) -> int:
    """Return the triangle that the path from start to end meets first from outside, or -1."""
    near = nears[0]
    best, found = 1.0 + 1e-9, -1
    for place in range(near.count):
        slot = near.order[place]
        known = False
        for i in range(held):
            known = known or slots[i] == slot
        n, corners = near.normal[:, slot], near.corners[:, slot]
        above = below = 0.0
        for axis in range(3):
            above += n[axis] * (start[axis] - corners[axis])
            below += n[axis] * (end[axis] - corners[axis])
        if (
            known
            or below >= 0.5 * _PLANE_OFFSET_M
            or above < -_PLANE_OFFSET_M
            or above - below <= 1e-15
        ):
            continue
        t = max(above, 0.0) / (above - below)
        if t >= best or not _is_within(start, end, t, corners, n):
            continue
        best, found = t, slot
    return found


@njit(cache=True, nogil=True)
def _is_within(
    start: np.ndarray, end: np.ndarray, t: float, corners: np.ndarray, n: np.ndarray
) -> bool:
    """Return whether the point at parameter t of the path is within a triangle of normal n."""
    for i in range(3):
        a, j = corners[3 * i : 3 * i + 3], (i + 1) % 3
        b = corners[3 * j : 3 * j + 3]
        e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        q0 = start[0] + t * (end[0] - start[0]) - a[0]
        q1 = start[1] + t * (end[1] - start[1]) - a[1]
        q2 = start[2] + t * (end[2] - start[2]) - a[2]
        side = n[0] * (e1 * q2 - e2 * q1) + n[1] * (e2 * q0 - e0 * q2) + n[2] * (e0 * q1 - e1 * q0)
        if side < -1e-12:
            return False
    return True


@njit(cache=True, nogil=True)
def _nearest_on(
    start: np.ndarray,
    device: np.ndarray,
    planes: np.ndarray,
    held: int,
    slots: np.ndarray,
    nears: np.ndarray,
) -> np.ndarray:
    """Return the point nearest to the device on all held planes, by Lagrange multipliers."""
    near = nears[0]
    system = np.zeros((held, held))
    wanted = np.zeros(held)
    for i in range(held):
        for axis in range(3):
            wanted[i] += planes[i, axis] * (near.corners[axis, slots[i]] - device[axis])
        wanted[i] += _PLANE_OFFSET_M
        for j in range(held):
            for axis in range(3):
                system[i, j] += planes[i, axis] * planes[j, axis]
        system[i, i] += 1e-9
    multipliers = np.linalg.solve(system, wanted)
    point = device.copy()
    for i in range(held):
        for axis in range(3):
            point[axis] += multipliers[i] * planes[i, axis]
    return point
