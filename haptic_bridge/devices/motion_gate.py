"""Check of a stream of device poses: can it be the motion of a device that a hand holds?"""

import numpy as np

from cutting_trainer.haptic_bridge import safety

_SECOND = 1e-9


class MotionGate:
    """Compares each pose with the one before, and with one some milliseconds earlier.

    Two stamps of a 1 kHz stream can be closer than the motion between them took, so that a step
    counts as at least `NOMINAL_PERIOD` long. Over a few poses such steps add up: there the stamps
    are trusted but for one period.
    """

    def __init__(self) -> None:
        self._last, self._anchor = np.zeros(7), np.zeros(7)
        self._last_ns = self._anchor_ns = 0

    def judge(self, pose: np.ndarray, stamp_ns: int, *, known: bool) -> int:
        """Return OK, JUMP or TURN of `safety`; a pose that is OK becomes the one before.

        Args:
            pose: position [m] and quaternion x y z w, shape (7,).
            stamp_ns: of the pose [ns], later than the one before.
            known: the pose before is that of the same motion.
        """
        if not (known and self._last_ns):
            self._anchor[:] = pose
            self._anchor_ns = stamp_ns
        else:
            step = (stamp_ns - self._last_ns) * _SECOND
            window = (stamp_ns - self._anchor_ns) * _SECOND + safety.NOMINAL_PERIOD_S
            code = safety.motion_gate(pose, self._last, max(step, safety.NOMINAL_PERIOD_S))
            code = code or safety.motion_gate(pose, self._anchor, window)
            if code != safety.OK:
                return int(code)
            if window > safety.MIN_WINDOW_S:
                self._anchor[:] = self._last
                self._anchor_ns = self._last_ns
        self._last[:] = pose
        self._last_ns = stamp_ns
        return safety.OK
