"""Ring buffers for plots, and the rate of a numbered stream."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class History:
    """A ring buffer of samples.

    Args:
        width: number of quantities in a sample.
        length: number of samples that are kept.
    """

    def __init__(self, width: int, length: int) -> None:
        self._rows = np.zeros((length, 1 + width))
        self._count = 0

    def add(self, time: float, *values: float) -> None:
        """Add a sample: its time [s] and the quantities."""
        self._rows[self._count % len(self._rows)] = (time, *values)
        self._count += 1

    def rows(self) -> Floats:
        """Return the samples in their order, time first, shape (n, 1 + width)."""
        if self._count <= len(self._rows):
            return self._rows[: self._count]
        at = self._count % len(self._rows)
        return np.concatenate([self._rows[at:], self._rows[:at]])


class StreamRate:
    """Rate of a stream, from the sequence numbers of its messages.

    Args:
        window: averaging time [s].
    """

    def __init__(self, window: float = 1.0) -> None:
        self._window = window
        self._seen: list[tuple[float, int]] = []

    def see(self, time: float, number: int) -> None:
        """Add the newest number at a time [s]."""
        if self._seen and number < self._seen[-1][1]:
            self._seen.clear()  # the publisher has restarted
        self._seen.append((time, number))
        while len(self._seen) > 2 and self._seen[1][0] < time - self._window:
            self._seen.pop(0)

    def rate(self, time: float) -> float:
        """Return the rate [Hz], 0 after a silence."""
        if len(self._seen) < 2 or time - self._seen[-1][0] > self._window:
            return 0.0
        (began, first), (ended, last) = self._seen[0], self._seen[-1]
        return (last - first) / max(ended - began, 1e-6)
