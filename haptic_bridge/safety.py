"""The safety chain between the force law and the operator's hand: each link a small pure function.

Order in `force_path`: gate of NaN and range, (force law), gate of the operating state, passivity
observer and controller, slew limit, clamp to the device profile, soft start. Two promises hold for
every commanded force: its norm is at most max_force, and it differs from the last one by at most
max_slew times the time between, also on its way to zero. The second has one exception: where the
input cannot be trusted at all (a NaN, a device that jumps or is silent, FAULT), the force is zero
at once.
"""

import numpy as np
from numba import njit

OK, NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE, JUMP = range(5)
POSE_FAULTS = {
    NOT_FINITE: 'the device pose is not finite',
    NOT_A_ROTATION: 'the orientation of the device is not a unit quaternion',
    OUT_OF_RANGE: 'the device is farther than 10 m from its origin: is its unit the metre?',
    JUMP: 'the device jumped: faster than 10 m/s between two poses',
}
FARTHEST_DEVICE = 10.0
"""[m] from the origin of the device frame. Millimetres sent as metres exceed it at once."""
FASTEST_DEVICE = 10.0
"""[m/s]. A thrown hand reaches half of it."""


@njit(cache=True, nogil=True)
def norm(v: np.ndarray) -> float:
    """|v| of shape (3,); NaN where a component is."""
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, nogil=True)
def pose_gate(
    position: np.ndarray, orientation: np.ndarray, last: np.ndarray, elapsed: float
) -> int:
    """Whether a device pose can be believed.

    Args:
        position: [m], device frame, shape (3,).
        orientation: quaternion x y z w, shape (4,).
        last: position before [m], shape (3,).
        elapsed: time between the two [s]; infinite where there is none before.

    Returns:
        OK or a key of POSE_FAULTS.
    """
    size = 0.0
    for q in orientation:
        size += q * q
    if not (np.isfinite(norm(position)) and np.isfinite(size)):
        return NOT_FINITE
    if abs(size - 1.0) > 0.02:
        return NOT_A_ROTATION
    if norm(position) > FARTHEST_DEVICE:
        return OUT_OF_RANGE
    moved = 0.0
    for k in range(3):
        moved += (position[k] - last[k]) ** 2
    # 1 ms more: two stamps of a 1 kHz stream can be closer than the motion between them took.
    if np.sqrt(moved) > FASTEST_DEVICE * (elapsed + 1e-3):
        return JUMP
    return OK


@njit(cache=True, nogil=True)
def state_gate(enabled: bool, force: np.ndarray) -> None:
    """No force unless ENABLED. Force [N], shape (3,), changed in place."""
    if not enabled:
        force[:] = 0.0


@njit(cache=True, nogil=True)
def freshness(age: float, stale_after: float, fade: float) -> float:
    """Gain by the age [s] of the data: 1 up to stale_after, 0 from stale_after + fade on."""
    return min(max(1.0 - (age - stale_after) / fade, 0.0), 1.0)


@njit(cache=True, nogil=True)
def soft_start(elapsed: float, duration: float) -> float:
    """Gain by the time [s] since the force was let in: grows from 0 to 1 within duration [s]."""
    return min(elapsed / duration, 1.0) if duration > 0.0 else 1.0


@njit(cache=True, nogil=True)
def observe(energy: float, force: np.ndarray, displacement: np.ndarray) -> float:
    """Passivity observer: energy [J] that the hand has put in, net of what it got back.

    Args:
        energy: before [J].
        force: on the hand, commanded since the last tick [N], shape (3,).
        displacement: of the hand since then [m], shape (3,).
    """
    return energy - (
        force[0] * displacement[0] + force[1] * displacement[1] + force[2] * displacement[2]
    )


@njit(cache=True, nogil=True)
def control(
    energy: float, velocity: np.ndarray, period: float, max_damping: float, force: np.ndarray
) -> float:
    """Passivity controller (Hannaford and Ryu): damping that takes back within a period what was
    made.

    Args:
        energy: of the observer [J]; the controller acts only where it is negative.
        velocity: of the hand [m/s], shape (3,).
        period: [s].
        max_damping: bound of the damping [N s/m].
        force: on the hand [N], shape (3,), changed in place.

    Returns:
        The damping [N s/m].
    """
    if energy >= 0.0:
        return 0.0
    squared = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    damping = max_damping
    if squared * period * max_damping > -energy:
        damping = -energy / (squared * period)
    for k in range(3):
        force[k] -= damping * velocity[k]
    return damping


@njit(cache=True, nogil=True)
def limit_slew(last: np.ndarray, largest: float, force: np.ndarray) -> None:
    """At most `largest` [N] away from the last force. Forces [N], shape (3,), changed in place."""
    step = np.sqrt(
        (force[0] - last[0]) ** 2 + (force[1] - last[1]) ** 2 + (force[2] - last[2]) ** 2
    )
    if step > largest:
        for k in range(3):
            force[k] = last[k] + (force[k] - last[k]) * (largest / step)


@njit(cache=True, nogil=True)
def clamp(ceiling: float, force: np.ndarray) -> None:
    """Norm at most `ceiling` [N], direction kept. Force [N], shape (3,), changed in place."""
    size = norm(force)
    if size > ceiling:
        for k in range(3):
            force[k] *= ceiling / size


@njit(cache=True, nogil=True)
def settle(
    last: np.ndarray, max_step: float, max_force: float, gain: float, force: np.ndarray
) -> None:
    """Slew limit, norm clamp and gain (soft start, freshness) together, so that none undoes
    another.

    The gain lowers the wanted force and the ceiling. The last force is brought under a ceiling that
    has come down first, and what that took of the step is no longer there for the way to the wanted
    force. A ceiling that falls faster than the force may (a soft start begins while force is on) is
    followed at max_step: the result is within max_step of the last force always, and under the
    ceiling as soon as that allows.

    Args:
        last: force commanded before [N], shape (3,).
        max_step: [N].
        max_force: [N].
        gain: from 0 to 1.
        force: wanted [N], shape (3,), changed in place to the one to command.
    """
    before = norm(last)
    ceiling = min(max(gain * max_force, before - max_step), max_force)
    lowered = min(ceiling / before, 1.0) if before > 0.0 else 1.0
    start = last * lowered
    for k in range(3):
        force[k] *= gain
    limit_slew(start, max(max_step - (1.0 - lowered) * before, 0.0), force)
    clamp(ceiling, force)
