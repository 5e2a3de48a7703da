"""Safety chain between force law and operator's hand, as small pure functions.

Order in `force_path`: gate of NaN and range, (force law), gate of the operating state, passivity
observer and controller, slew limit, clamp to the device profile, soft start. Two promises hold for
every commanded force: its norm is at most max_force, and it differs from the last one by at most
max_slew times the time between, also on its way to zero. The second has one exception: where the
input cannot be trusted at all (a NaN, a device that jumps or is silent, FAULT), the force is zero
at once.

The latch of E-STOP is in `node_common/operating_state.py`.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import norm

OK, NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE, JUMP, ROTATION_JUMP = range(6)
POSE_FAULTS = {
    NOT_FINITE: 'the device pose is not finite',
    NOT_A_ROTATION: 'the orientation of the device is not a unit quaternion',
    OUT_OF_RANGE: 'the device is farther than 10 m from its origin: is its unit the metre?',
    JUMP: 'the device jumped: faster than 10 m/s between two poses',
    ROTATION_JUMP: 'the device jumped: it turned faster than 60 rad/s between two poses',
}
MIN_FORCE_N = 1e-150
"""[N]. The square of a smaller number underflows, so its norm is not known."""
MAX_DEVICE_DISTANCE_M = 10.0
"""[m] from the origin of the device frame. Millimetres sent as metres exceed it at once."""
MAX_DEVICE_SPEED_M_S = 10.0
"""[m/s]. A thrown hand reaches half of it."""
MAX_ROTATION_SPEED_RAD_S = 60.0
"""[rad/s]. A flick of the wrist reaches half of it."""
NOMINAL_PERIOD_S = 1e-3
"""[s] Shortest period assumed between two poses: stamps may be closer than the motion took."""
MIN_WINDOW_S = 0.008
"""[s] Window over which the whole motion is checked too: jitter of stamps averages out there."""


@inner
def pose_gate(position: np.ndarray, orientation: np.ndarray) -> int:
    """Check a device pose.

    Args:
        position: [m], device frame, shape (3,).
        orientation: quaternion x y z w, shape (4,).

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
    if norm(position) > MAX_DEVICE_DISTANCE_M:
        return OUT_OF_RANGE
    return OK


@inner
def motion_gate(pose: np.ndarray, before: np.ndarray, elapsed: float) -> int:
    """Check the motion of a device between two poses.

    Args:
        pose: position [m] and quaternion x y z w, device frame, shape (7,).
        before: the same, earlier.
        elapsed: time between the two [s].

    Returns:
        OK, JUMP or ROTATION_JUMP.
    """
    moved = cosine = 0.0
    for k in range(3):
        moved += (pose[k] - before[k]) ** 2
    if np.sqrt(moved) > MAX_DEVICE_SPEED_M_S * elapsed:
        return JUMP
    ours = theirs = 0.0
    for k in range(3, 7):
        cosine += pose[k] * before[k]
        ours += pose[k] ** 2
        theirs += before[k] ** 2
    # q and -q are the same rotation
    cosine = min(abs(cosine) / np.sqrt(ours * theirs), 1.0)
    if 2.0 * np.arccos(cosine) > MAX_ROTATION_SPEED_RAD_S * elapsed:
        return ROTATION_JUMP
    return OK


@inner
def state_gate(enabled: bool, force: np.ndarray) -> None:
    """Set the force to zero unless ENABLED. Force [N], shape (3,), changed in place."""
    if not enabled:
        force[:] = 0.0


@inner
def freshness(age: float, stale_after: float, fade: float) -> float:
    """Return the gain by the age [s] of the data.

    It is 1 up to stale_after, and 0 from stale_after + fade on.
    """
    return min(max(1.0 - (age - stale_after) / fade, 0.0), 1.0)


@inner
def soft_start(elapsed: float, duration: float) -> float:
    """Return the gain by the time since the force was enabled [s]: 0 to 1 within duration [s]."""
    return min(elapsed / duration, 1.0) if duration > 0.0 else 1.0


@inner
def observe(energy: float, force: np.ndarray, displacement: np.ndarray) -> float:
    """Return the energy of the passivity observer [J]: net energy that the hand has put in.

    Args:
        energy: before [J].
        force: on the hand, commanded since the last tick [N], or torque [N m], shape (3,).
        displacement: of the hand since then [m], or rotation vector, shape (3,).
    """
    return energy - (
        force[0] * displacement[0] + force[1] * displacement[1] + force[2] * displacement[2]
    )


@inner
def control(
    energy: float, velocity: np.ndarray, period: float, max_damping: float, force: np.ndarray
) -> float:
    """Apply the passivity controller (Hannaford and Ryu) to a force.

    Its damping removes the generated energy within a period.

    Args:
        energy: of the observer [J]; the controller acts only where it is negative.
        velocity: of the hand [m/s], and its angular velocity times a length, shape (3,) or (6,).
        period: [s].
        max_damping: bound of the damping [N s/m].
        force: on the hand [N], and its torque over that length, same shape, changed in place.

    Returns:
        The damping [N s/m].
    """
    if energy >= 0.0:
        return 0.0
    squared = 0.0
    for k in range(len(velocity)):
        squared += velocity[k] * velocity[k]
    damping = max_damping
    if squared * period * max_damping > -energy:
        damping = -energy / (squared * period)
    for k in range(len(force)):
        force[k] -= damping * velocity[k]
    return damping


@inner
def limit_slew(last: np.ndarray, largest: float, force: np.ndarray) -> None:
    """Limit the change since the last force to `largest` [N].

    Forces [N], shape (3,), changed in place.
    """
    step = np.sqrt(
        (force[0] - last[0]) ** 2 + (force[1] - last[1]) ** 2 + (force[2] - last[2]) ** 2
    )
    if step > largest:
        for k in range(3):
            force[k] = last[k] + (force[k] - last[k]) * (largest / step)


@inner
def clamp(ceiling: float, force: np.ndarray) -> None:
    """Limit the norm to `ceiling` [N], direction kept. Force [N], shape (3,), changed in place.

    A force below `MIN_FORCE_N` becomes zero.
    """
    size = norm(force)
    if size < MIN_FORCE_N:
        for k in range(3):
            force[k] *= 0.0
    elif size > ceiling:
        for k in range(3):
            force[k] *= ceiling / size


@inner
def settle(
    last: np.ndarray, max_step: float, max_force: float, gain: float, force: np.ndarray
) -> None:
    """Apply slew limit, norm clamp and gain (soft start, freshness) together.

    In a row, one of them could undo another.

    The gain lowers the wanted force and the ceiling. If the ceiling has come down, the last force
    is brought under it first, and the rest of the step leads towards the wanted force. A ceiling
    can fall faster than the force may, as when a soft start begins while force is on: it is
    followed at max_step. The result is always within max_step of the last force, and under the
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
