"""Compiled steps of the proxy; `proxy.py` says what they do together."""

import numpy as np
from numba import njit

from haptic_bridge import half_spaces
from haptic_bridge.half_spaces import SPACES
from haptic_bridge.inside import LARGEST_FAN, TIED, is_inside
from haptic_bridge.neighbourhood import CAPACITY, NEAR, cover, gather, refresh, uncover
from haptic_bridge.surface import Geometry

PATCHES = 3
"""Triangles that a contact names."""
MOST_PUSHES = 8
"""Triangles that share the force."""
STATE = np.dtype(
    [
        ('placed', 'b1'),  # the position is one outside of the tissue
        ('touching', 'b1'),
        ('position', 'f8', (3,)),  # [m] centre of the sphere
        ('device', 'f8', (3,)),  # [m] tip of the last tick
        ('contact', 'f8', (3,)),  # [m]
        ('normal', 'f8', (3,)),
        ('nodes', 'i8', (3 * PATCHES,)),
        ('weights', 'f8', (3 * PATCHES,)),
        ('push', 'f8', (MOST_PUSHES,)),  # [m] part of the depth that a triangle holds
        ('push_normal', 'f8', (MOST_PUSHES, 3)),
        ('push_slot', 'i8', (MOST_PUSHES,)),
        ('depth', 'f8'),  # [m]
        ('clearance', 'f8'),  # [m] the surface is at least this far from the centre
        ('goal', 'f8', (3,)),  # [m] where the search goes
        ('step', 'f8', (3,)),  # [m]
        ('near', NEAR, (1,)),
        ('spaces', SPACES, (1,)),
    ]
)
ARRIVED, MOVING, AT_RIM = range(3)
_TOLERANCE = 3e-10
"""[m] of penetration that is not worth a correction."""
_COVERED = 1e-10
"""[m] by which a triangle may stick out of a half-space that covers it."""
_STILL = 1e-7
"""[m] of a step that ends the search: a hundredth of what an encoder resolves."""
_MARGIN = 0.1
"""Way in radii that the triangles gathered at once are enough for, at least."""
_MOST_GATHERS = 12
_MOST_STEPS = 16
_MOST_SUBSTEPS = 8
_ENTRY = 0.01
"""Height in radii over the surface from which a proxy that was inside is pushed out."""
_TOUCH = 0.01
"""Gap under the sphere, in radii, that still is contact: on an edge the search ends just above."""
_SHARING = 0.02
"""How much farther than the nearest, in parts, a triangle may be to take its share."""
_SAME = 0.9999
"""Cosine of directions that count as one."""
_MOST_SWEEPS = 30


@njit(cache=True, nogil=True)
def follow_device(
    surface: Geometry, blend: float, device: np.ndarray, radius: float, state: np.ndarray
) -> None:
    """Moves the proxy towards the device [m], shape (3,), and says what it touches.

    Args:
        surface: of the tissue.
        blend: 0 at the surface's start, 1 at its end.
        device: tip [m], shape (3,).
        radius: of the proxy [m].
        state: record of STATE, shape (1,), written.
    """
    s = state[0]
    if not s.placed:
        s.position[:] = device
        s.device[:] = device
        s.nodes[:] = -1
        s.placed = True
        _leave_tissue(surface, blend, radius, state)
    stride = 2.0 * _distance(device, s.device)
    s.device[:] = device
    s.goal[:] = device
    _seek(surface, blend, min(stride, 2.0 * radius), _MARGIN * radius, radius, state)
    s.depth = _distance(device, s.position)
    _report(surface, blend, radius, state)


@njit(cache=True, nogil=True)
def carry(
    surface: Geometry, start: float, end: float, motion: float, radius: float, state: np.ndarray
) -> None:
    """Lets the surface push the proxy on its way between two blends, in steps that cannot skip it.

    Args:
        surface: of the tissue.
        start, end: blends.
        motion: largest way of a node between them [m].
        radius: of the proxy [m].
        state: record of STATE, shape (1,), written.
    """
    s = state[0]
    if not s.placed:
        return
    wanted = np.ceil(motion / max(0.5 * s.clearance, 1e-9))
    steps = int(min(max(wanted, 1.0), _MOST_SUBSTEPS))
    for i in range(1, steps + 1):
        blend = start + (end - start) * i / steps
        if motion / steps >= s.clearance and _leave_tissue(surface, blend, radius, state):
            continue
        if i < steps or wanted > 1:
            s.goal[:] = s.position
            _seek(surface, blend, 0.0, _MARGIN * radius, radius, state)


@njit(cache=True, nogil=True)
def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@njit(cache=True, nogil=True)
def _seek(
    surface: Geometry, blend: float, stride: float, margin: float, radius: float, state: np.ndarray
) -> None:
    """Moves the position as close to the goal as the surface lets it in a bounded time.

    Args:
        stride: about how far it may have to move in contact [m].
        margin: how far it may move before it looks around again, at least [m].
    """
    s = state[0]
    near = s.near[0]
    steps = 0
    s.clearance = radius
    for _ in range(_MOST_GATHERS):
        ahead = _distance(s.goal, s.position)
        reach = radius + max(margin, min(ahead, stride))
        gather(surface, blend, s.position, reach, CAPACITY, s.near)
        if near.count == 0:
            if _leap(surface, blend, ahead, radius, state):
                return
            continue
        outcome = MOVING
        while outcome == MOVING and steps < _MOST_STEPS:
            outcome = _advance(radius, state)
            steps += 1
        s.clearance = min(radius, near.distance[near.order[0]])
        if outcome != AT_RIM:
            return


@njit(cache=True, nogil=True)
def _leap(surface: Geometry, blend: float, ahead: float, radius: float, state: np.ndarray) -> bool:
    """Moves through free space, as far as the nearest triangle is away; True at the goal."""
    s = state[0]
    near = s.near[0]
    if ahead + radius > near.reach:
        gather(surface, blend, s.position, ahead + radius, 1, s.near)
        if near.count > 0:
            part = (near.distance[near.order[0]] - radius) / ahead
            near.count = 0
            for axis in range(3):
                s.position[axis] += part * (s.goal[axis] - s.position[axis])
            return False
    s.position[:] = s.goal
    return True


@njit(cache=True, nogil=True)
def _advance(radius: float, state: np.ndarray) -> int:
    """One straight step inside of half-spaces that the triangles nearby leave free."""
    s = state[0]
    near, spaces = s.near[0], s.spaces[0]
    for axis in range(3):
        s.step[axis] = s.goal[axis] - s.position[axis]
    half_spaces.begin(s.spaces, s.step)
    _linearise(radius, state)
    y = spaces.optimum
    if not spaces.feasible:
        _squeeze(radius, state)
    free = y[0] == s.step[0] and y[1] == s.step[1] and y[2] == s.step[2]
    still = half_spaces.norm(y) <= _STILL
    part = _part_to_rim(max(near.reach - radius, 1e-3 * radius), state)
    for axis in range(3):
        s.position[axis] += part * y[axis]
    if free and part == 1.0:
        s.position[:] = s.goal
    refresh(s.position, s.near)
    if part < 1.0:
        return AT_RIM
    return ARRIVED if free or still else MOVING


@njit(cache=True, nogil=True)
def _squeeze(radius: float, state: np.ndarray) -> None:
    """The step where triangles leave no room for the sphere: as much in one as in another."""
    s = state[0]
    near, spaces = s.near[0], s.spaces[0]
    half_spaces.compromise(s.spaces)
    y, gap = spaces.optimum, near.distance[near.order[0]]
    # Shorter than the gap, so that no triangle can be crossed; none where there was room.
    scale = min(1.0, 0.5 * gap / max(half_spaces.norm(y), 1e-300))
    if gap >= radius - _TOLERANCE and half_spaces.worst(s.spaces, y) > _TOLERANCE:
        scale = 0.0
    for axis in range(3):
        y[axis] *= scale


@njit(cache=True, nogil=True)
def _part_to_rim(rim: float, state: np.ndarray) -> float:
    """Part of the step that stays within `rim` [m] of where the triangles were gathered, 0 to 1."""
    s = state[0]
    near, y = s.near[0], s.spaces[0].optimum
    a = b = c = 0.0
    for axis in range(3):
        offset = s.position[axis] - near.centre[axis]
        a += y[axis] * y[axis]
        b += y[axis] * offset
        c += offset * offset
    c -= rim * rim
    if a + 2.0 * b + c <= 0.0:
        return 1.0
    return min(max((-b + np.sqrt(max(b * b - a * c, 0.0))) / a, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _linearise(radius: float, state: np.ndarray) -> None:
    """Gives every triangle nearby, nearest first, a half-space unless another already excludes it.

    The plane is square to the closest point and a radius off. That an earlier one often does for
    the neighbours too is what lets the sphere slide over edges within a plane or a hump unbraked.
    """
    s = state[0]
    near, spaces = s.near[0], s.spaces[0]
    uncover(s.near)
    for place in range(near.count):
        slot = near.order[place]
        if spaces.count == half_spaces.MOST:
            near.reach = min(near.reach, near.distance[slot])
            return
        if near.covered[slot] >= 0.0:
            continue
        q, gap = near.closest[:, slot], near.distance[slot]
        x, y, z = near.normal[0, slot], near.normal[1, slot], near.normal[2, slot]
        if gap > 1e-12:
            x, y, z = (
                (s.position[0] - q[0]) / gap,
                (s.position[1] - q[1]) / gap,
                (s.position[2] - q[2]) / gap,
            )
        bound = radius - gap
        half_spaces.add(s.spaces, x, y, z, bound)
        cover(x, y, z, radius - bound - _COVERED, s.near)


@njit(cache=True, nogil=True)
def _leave_tissue(surface: Geometry, blend: float, radius: float, state: np.ndarray) -> bool:
    """Puts a proxy that is inside of the tissue outside at the nearest point; True if it was."""
    s = state[0]
    near = s.near[0]
    gather(surface, blend, s.position, np.inf, LARGEST_FAN, s.near)
    if near.count == 0 or not is_inside(surface, s.position, s.near, s.step):
        return False
    nearest = near.order[0]
    for axis in range(3):
        s.position[axis] = near.closest[axis, nearest] + _ENTRY * radius * s.step[axis]
    s.goal[:] = s.position
    _seek(surface, blend, 0.0, radius, radius, state)
    return True


@njit(cache=True, nogil=True)
def _report(surface: Geometry, blend: float, radius: float, state: np.ndarray) -> None:
    """Shares the force among the triangles under the sphere, as a frictionless contact does.

    In a dent or a crease the sphere rests on several triangles: their pushes, none of which pulls,
    add up to the force on the tool (least squares, by coordinate descent).
    """
    s = state[0]
    near = s.near[0]
    s.touching = False
    nearest = near.distance[near.order[0]] if near.count > 0 else np.inf
    if s.depth <= 1e-9 or nearest > (1.0 + _TOUCH) * radius:
        _foresee(surface, blend, state)
        return
    found = _touched(surface, max(nearest * (1.0 + _SHARING), nearest + TIED), state)
    residual = s.step
    for axis in range(3):
        residual[axis] = s.position[axis] - s.device[axis]
    s.push[:] = 0.0
    for _ in range(_MOST_SWEEPS):
        for i in range(found):
            n = s.push_normal[i]
            along = n[0] * residual[0] + n[1] * residual[1] + n[2] * residual[2]
            change = max(s.push[i] + along, 0.0) - s.push[i]
            s.push[i] += change
            for axis in range(3):
                residual[axis] -= change * n[axis]
    s.touching = True
    _write_patches(surface, state)


@njit(cache=True, nogil=True)
def _foresee(surface: Geometry, blend: float, state: np.ndarray) -> None:
    """Names the triangle that a free sphere is nearest to, however far: it may touch there next."""
    s = state[0]
    near = s.near[0]
    s.nodes[:] = -1
    s.weights[:] = 0.0
    gather(surface, blend, s.position, np.inf, 1, s.near)
    if near.count == 0 or near.distance[near.order[0]] <= 1e-12:
        return
    slot = near.order[0]
    for axis in range(3):
        s.nodes[axis] = surface.triangles[near.triangle[slot], axis]
        s.weights[axis] = near.weights[axis, slot]
        s.contact[axis] = near.closest[axis, slot]
        s.normal[axis] = (s.position[axis] - s.contact[axis]) / near.distance[slot]


@njit(cache=True, nogil=True)
def _touched(surface: Geometry, within: float, state: np.ndarray) -> int:
    """Lists the triangles within a distance [m] that push in different directions; their number."""
    s = state[0]
    near = s.near[0]
    found = 0
    for place in range(near.count):
        slot = near.order[place]
        gap = near.distance[slot]
        if gap > within or found == MOST_PUSHES:
            break
        n = s.push_normal[found]
        for axis in range(3):
            n[axis] = near.normal[axis, slot]
            if gap > 1e-12:
                n[axis] = (s.position[axis] - near.closest[axis, slot]) / gap
        new = True
        for i in range(found):
            m = s.push_normal[i]
            if n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > _SAME:
                new = False
                # On an edge or a corner that triangles share, the one of the last tick stays.
                if _was_touched(surface, slot, state):
                    s.push_slot[i] = slot
        if new:
            s.push_slot[found] = slot
            found += 1
    return found


@njit(cache=True, nogil=True)
def _was_touched(surface: Geometry, slot: int, state: np.ndarray) -> bool:
    s = state[0]
    triangle = surface.triangles[s.near[0].triangle[slot]]
    for patch in range(PATCHES):
        kept = True
        for axis in range(3):
            kept = kept and triangle[axis] == s.nodes[3 * patch + axis]
        if kept:
            return True
    return False


@njit(cache=True, nogil=True)
def _write_patches(surface: Geometry, state: np.ndarray) -> None:
    """Writes the most loaded triangles, most loaded first, with the shares of their nodes."""
    s = state[0]
    near = s.near[0]
    s.nodes[:] = 0
    s.weights[:] = 0.0
    s.contact[:] = 0.0
    total = 0.0
    for patch in range(PATCHES):
        chosen = 0
        for i in range(1, MOST_PUSHES):
            if s.push[i] > s.push[chosen]:
                chosen = i
        push = s.push[chosen]
        if patch > 0 and push <= 0.0:
            break
        push = max(push, 1e-300)
        s.push[chosen] = 0.0
        total += push
        slot = s.push_slot[chosen]
        for axis in range(3):
            s.nodes[3 * patch + axis] = surface.triangles[near.triangle[slot], axis]
            s.weights[3 * patch + axis] = push * near.weights[axis, slot]
            s.contact[axis] += push * near.closest[axis, slot]
    for i in range(3 * PATCHES):
        s.weights[i] /= total
    for axis in range(3):
        s.contact[axis] /= total
        s.normal[axis] = (s.position[axis] - s.device[axis]) / s.depth
