"""Check of a stream of device poses: can it be the motion of a device that a hand holds?"""

import numpy as np

from cutting_trainer.haptic_bridge import safety
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.node_common.kernels import kernel

_SECOND = 1e-9
GATE = record_type(
    [('last', 'f8', (7,)), ('last_ns', 'i8'), ('anchor', 'f8', (7,)), ('anchor_ns', 'i8')]
)


@kernel(nogil=True)
def judge(gate: np.ndarray, pose: np.ndarray, stamp_ns: int, known: bool) -> int:
    """Compare a pose with the one before and one some milliseconds earlier.

    Two stamps of a 1 kHz stream can be closer than the motion between them took, so that a step
    counts as at least `NOMINAL_PERIOD_S` long. Over a few poses such steps add up: there the stamps
    are trusted but for one period.

    Args:
        gate: dtype GATE, shape (1,), zero at first; a pose that is OK becomes the one before.
        pose: position [m] and quaternion x y z w, shape (7,).
        stamp_ns: of the pose [ns], later than the one before.
        known: the pose before is that of the same motion.

    Returns:
        OK or a key of `safety.POSE_FAULTS`.
    """
    g = gate[0]
    code = safety.pose_gate(pose[:3], pose[3:])
    if code != safety.OK:
        return code
    if known and g.last_ns != 0:
        step = (stamp_ns - g.last_ns) * _SECOND
        window = (stamp_ns - g.anchor_ns) * _SECOND + safety.NOMINAL_PERIOD_S
        code = safety.motion_gate(pose, g.last, max(step, safety.NOMINAL_PERIOD_S))
        if code == safety.OK:
            code = safety.motion_gate(pose, g.anchor, window)
        if code != safety.OK:
            return code
        if window > safety.MIN_WINDOW_S:
            g.anchor[:] = g.last
            g.anchor_ns = g.last_ns
    else:
        g.anchor[:] = pose
        g.anchor_ns = stamp_ns
    g.last[:] = pose
    g.last_ns = stamp_ns
    return safety.OK
