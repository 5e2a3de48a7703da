"""The last seconds of a few quantities, for plots."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class History:
    """A ring of samples.

    Args:
        width: quantities in a sample.
        length: samples that are kept.
    """

    def __init__(self, width: int, length: int) -> None:
        self._rows = np.zeros((length, 1 + width))
        self._count = 0

    def add(self, time: float, *values: float) -> None:
        """Takes a sample: its time [s] and the quantities."""
        self._rows[self._count % len(self._rows)] = (time, *values)
        self._count += 1

    def rows(self) -> Floats:
        """The samples in their order, time first, shape (n, 1 + width)."""
        if self._count <= len(self._rows):
            return self._rows[: self._count]
        at = self._count % len(self._rows)
        return np.concatenate([self._rows[at:], self._rows[:at]])


class Counter:
    """Rate of a stream, by the numbers that its publisher gives the messages.

    Args:
        window: [s] over which it is taken.
    """

    def __init__(self, window: float = 1.0) -> None:
        self._window = window
        self._seen: list[tuple[float, int]] = []

    def see(self, time: float, number: int) -> None:
        """Takes the newest number at a time [s]."""
        if self._seen and number < self._seen[-1][1]:
            self._seen.clear()  # its publisher has started anew
        self._seen.append((time, number))
        while len(self._seen) > 2 and self._seen[1][0] < time - self._window:
            self._seen.pop(0)

    def rate(self, time: float) -> float:
        """Messages a second [Hz], 0 once nothing has come for a while."""
        if len(self._seen) < 2 or time - self._seen[-1][0] > self._window:
            return 0.0
        (began, first), (ended, last) = self._seen[0], self._seen[-1]
        return (last - first) / max(ended - began, 1e-6)
