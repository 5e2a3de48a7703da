"""Compiled search of the proxy's place and contact; `proxy.py` describes the method."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy import half_spaces
from cutting_trainer.haptic_bridge.proxy.half_spaces import SPACES
from cutting_trainer.haptic_bridge.proxy.inside_test import MAX_FAN, TIE_TOLERANCE_M, is_inside
from cutting_trainer.haptic_bridge.proxy.neighbourhood import (
    CAPACITY,
    NEAR,
    cover,
    gather,
    refresh,
    uncover,
)
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import assign, norm

PATCHES = 3
"""Triangles that a contact reports."""
MAX_PUSHES = 8
"""Largest number of triangles that share the force."""
STATE = record_type(
    [
        ('placed', 'b1'),  # the position is valid, outside of the tissue
        ('touching', 'b1'),
        ('position', 'f8', (3,)),  # [m] centre of the sphere
        ('device', 'f8', (3,)),  # [m] tip of the last tick
        ('contact', 'f8', (3,)),  # [m]
        ('normal', 'f8', (3,)),
        ('nodes', 'i8', (3 * PATCHES,)),
        ('weights', 'f8', (3 * PATCHES,)),
        ('push', 'f8', (MAX_PUSHES,)),  # [m] part of the depth that a triangle carries
        ('push_normal', 'f8', (MAX_PUSHES, 3)),
        ('push_slot', 'i8', (MAX_PUSHES,)),
        ('depth', 'f8'),  # [m]
        ('clearance', 'f8'),  # [m] the surface is at least this far from the centre
        ('over', 'f8', (3,)),  # [m] where the sphere is to go: with friction, over its anchor
        ('goal', 'f8', (3,)),  # [m] target of the search
        ('step', 'f8', (3,)),  # [m]
        ('near', NEAR, (1,)),
        ('spaces', SPACES, (1,)),
    ]
)
ARRIVED, MOVING, AT_RIM = range(3)
_TOLERANCE_M = 3e-10
"""[m] Penetration below which nothing is corrected."""
_COVER_TOLERANCE_M = 1e-10
"""[m] by which a triangle may stick out of a half-space that covers it."""
_MIN_STEP_M = 1e-7
"""[m] Step that ends the search: a hundredth of an encoder step."""
GATHER_MARGIN = 0.1
"""Shortest path, in radii, for which one set of gathered triangles suffices."""
_MAX_GATHERS = 12
_MAX_STEPS = 16
_EXIT_HEIGHT = 0.01
"""Height in radii over the surface from which a proxy that was inside is pushed out."""
_CONTACT_GAP = 0.01
"""Gap under the sphere, in radii, that counts as contact: on an edge the search ends above."""
_SHARING_MARGIN = 0.02
"""Share by which a triangle may be farther than the nearest one to carry load."""
_SAME_DIRECTION_COS = 0.9999
"""Cosine above which two directions count as one."""
_MAX_SWEEPS = 30


@inner
def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two points [m], shape (3,)."""
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@inner
def seek(
    surface: Geometry, blend: float, stride: float, margin: float, radius: float, state: np.ndarray
) -> None:
    """Move the position as close to the goal as the surface allows, in bounded time.

    Args:
        stride: approximate motion in contact [m].
        margin: shortest motion before triangles are gathered again [m].
    """
    s = state[0]
    near = s.near[0]
    steps = 0
    s.clearance = radius
    for _ in range(_MAX_GATHERS):
        ahead = distance(s.goal, s.position)
        reach = radius + max(margin, min(ahead, stride))
        gather(surface, blend, s.position, reach, np.int64(CAPACITY), s.near)
        if near.count == 0:
            if _leap(surface, blend, ahead, radius, state):
                return
            continue
        outcome = MOVING
        while outcome == MOVING and steps < _MAX_STEPS:
            outcome = _advance(radius, state)
            steps += 1
        s.clearance = min(radius, near.distance[near.order[0]])
        if outcome != AT_RIM:
            return


@inner
def _leap(surface: Geometry, blend: float, ahead: float, radius: float, state: np.ndarray) -> bool:
    """Move through free space, up to the distance of the nearest triangle; True at the goal."""
    s = state[0]
    near = s.near[0]
    if ahead + radius > near.reach:
        gather(surface, blend, s.position, ahead + radius, np.int64(1), s.near)
        if near.count > 0:
            part = (near.distance[near.order[0]] - radius) / ahead
            near.count = 0
            for axis in range(3):
                s.position[axis] += part * (s.goal[axis] - s.position[axis])
            return False
    assign(s.position, s.goal)
    return True


@inner
def _advance(radius: float, state: np.ndarray) -> int:
    """Take one straight step inside the half-spaces of the triangles nearby; return the outcome."""
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
    still = norm(y) <= _MIN_STEP_M
    part = _part_to_rim(max(near.reach - radius, 1e-3 * radius), state)
    for axis in range(3):
        s.position[axis] += part * y[axis]
    if free and part == 1.0:
        assign(s.position, s.goal)
    refresh(s.position, s.near)
    if part < 1.0:
        return AT_RIM
    return ARRIVED if free or still else MOVING


@inner
def _squeeze(radius: float, state: np.ndarray) -> None:
    """Take the step where triangles leave no room for the sphere: equal penetration of each."""
    s = state[0]
    near, spaces = s.near[0], s.spaces[0]
    half_spaces.compromise(s.spaces)
    y, gap = spaces.optimum, near.distance[near.order[0]]
    # Shorter than the gap, so that no triangle can be crossed; none where there was room.
    scale = min(1.0, 0.5 * gap / max(norm(y), 1e-300))
    if gap >= radius - _TOLERANCE_M and half_spaces.worst(s.spaces, y) > _TOLERANCE_M:
        scale = 0.0
    for axis in range(3):
        y[axis] *= scale


@inner
def _part_to_rim(rim: float, state: np.ndarray) -> float:
    """Return the part, 0 to 1, of the step within `rim` [m] of the gathering centre."""
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


@inner
def _linearise(radius: float, state: np.ndarray) -> None:
    """Add a half-space for each triangle nearby, nearest first, unless another excludes it.

    The plane is perpendicular to the direction of the closest point and a radius off. An earlier
    plane often serves the neighbours too, so that the sphere slides over edges within a plane or a
    hump unbraked.
    """
    s = state[0]
    near, spaces = s.near[0], s.spaces[0]
    uncover(s.near)
    for place in range(near.count):
        slot = near.order[place]
        if spaces.count == half_spaces.MAX_HALF_SPACES:
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
        cover(x, y, z, radius - bound - _COVER_TOLERANCE_M, s.near)


@inner
def leave_tissue(surface: Geometry, blend: float, radius: float, state: np.ndarray) -> bool:
    """Move a proxy inside the tissue to the nearest point outside; True if it was inside."""
    s = state[0]
    near = s.near[0]
    gather(surface, blend, s.position, np.inf, np.int64(MAX_FAN), s.near)
    if near.count == 0 or not is_inside(surface, s.position, s.near, s.step):
        return False
    nearest = near.order[0]
    for axis in range(3):
        s.position[axis] = near.closest[axis, nearest] + _EXIT_HEIGHT * radius * s.step[axis]
    assign(s.goal, s.position)
    seek(surface, blend, 0.0, radius, radius, state)
    return True


@inner
def report(surface: Geometry, blend: float, radius: float, state: np.ndarray) -> None:
    """Distribute the force among the triangles under the sphere, as a frictionless contact does.

    In an indentation or a crease the sphere rests on several triangles. Their pushes are not
    negative and add up to the force on the tool (least squares, by coordinate descent).
    """
    s = state[0]
    near = s.near[0]
    s.touching = False
    nearest = near.distance[near.order[0]] if near.count > 0 else np.inf
    if s.depth <= 1e-9 or nearest > (1.0 + _CONTACT_GAP) * radius:
        _foresee(surface, blend, state)
        return
    found = _touched(
        surface, max(nearest * (1.0 + _SHARING_MARGIN), nearest + TIE_TOLERANCE_M), state
    )
    residual = s.step
    for axis in range(3):
        residual[axis] = s.position[axis] - s.device[axis]
    s.push[:] = 0.0
    for _ in range(_MAX_SWEEPS):
        for i in range(found):
            n = s.push_normal[i]
            along = n[0] * residual[0] + n[1] * residual[1] + n[2] * residual[2]
            change = max(s.push[i] + along, 0.0) - s.push[i]
            s.push[i] += change
            for axis in range(3):
                residual[axis] -= change * n[axis]
    s.touching = True
    _write_patches(surface, state)


@inner
def _foresee(surface: Geometry, blend: float, state: np.ndarray) -> None:
    """Write the triangle nearest to a free sphere, at any distance: the next touch may be there."""
    s = state[0]
    near = s.near[0]
    s.nodes[:] = -1
    s.weights[:] = 0.0
    gather(surface, blend, s.position, np.inf, np.int64(1), s.near)
    if near.count == 0 or near.distance[near.order[0]] <= 1e-12:
        return
    slot = near.order[0]
    for axis in range(3):
        s.nodes[axis] = surface.triangles[near.triangle[slot], axis]
        s.weights[axis] = near.weights[axis, slot]
        s.contact[axis] = near.closest[axis, slot]
        s.normal[axis] = (s.position[axis] - s.contact[axis]) / near.distance[slot]


@inner
def _touched(surface: Geometry, within: float, state: np.ndarray) -> int:
    """List the triangles within a distance [m] that push in different directions; count them."""
    s = state[0]
    near = s.near[0]
    found = 0
    for place in range(near.count):
        slot = near.order[place]
        gap = near.distance[slot]
        if gap > within or found == MAX_PUSHES:
            break
        n = s.push_normal[found]
        for axis in range(3):
            n[axis] = near.normal[axis, slot]
            if gap > 1e-12:
                n[axis] = (s.position[axis] - near.closest[axis, slot]) / gap
        new = True
        for i in range(found):
            m = s.push_normal[i]
            if n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > _SAME_DIRECTION_COS:
                new = False
                # On an edge or a corner that triangles share, the one of the last tick stays.
                if _was_touched(surface, slot, state):
                    s.push_slot[i] = slot
        if new:
            s.push_slot[found] = slot
            found += 1
    return found


@inner
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


@inner
def _write_patches(surface: Geometry, state: np.ndarray) -> None:
    """Write the most loaded triangles, most loaded first, with the shares of their nodes."""
    s = state[0]
    near = s.near[0]
    s.nodes[:] = 0
    s.weights[:] = 0.0
    s.contact[:] = 0.0
    total = 0.0
    for patch in range(PATCHES):
        chosen = 0
        for i in range(1, MAX_PUSHES):
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
