"""Message times that are corrected for steps of the system clock during a recording."""

import time
from collections.abc import Callable

_STEP_NS = 50_000_000
"""[ns] Change of the offset between both clocks that counts as a step. Slewing, and late readings
on a busy machine, stay below."""


class SteadyClock:
    """Corrects times of the system clock by its steps since the start.

    Args:
        system: returns the system's time [ns since the epoch].
        steady: returns a monotonic time [ns] that goes on while the machine sleeps.

    Attributes:
        shift: sum of the clock's steps [ns].
    """

    def __init__(
        self,
        system: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME),
    ) -> None:
        self._system, self._steady = system, steady
        self.shift = 0
        self._before = 0
        self._ahead = self._system() - self._steady()

    def look(self) -> int:
        """Check for a step of the clock since the last check; return its size [ns], or 0."""
        ahead = self._system() - self._steady()
        step, self._ahead = ahead - self._ahead, ahead
        if abs(step) < _STEP_NS:
            return 0
        self._before = self.shift
        self.shift += step
        return step

    def of(self, received: int) -> int:
        """Return the corrected receive time of a message that has just arrived.

        Args:
            received: by the system's clock, before or after its last step [ns since the epoch].
        """
        if self.shift == self._before:
            return received - self.shift
        now = self._system() - self.shift
        return min((received - self.shift, received - self._before), key=lambda t: abs(now - t))
