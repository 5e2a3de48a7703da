"""Restart delays of a node that dies: exponential back-off."""

from dataclasses import dataclass, field

INITIAL_DELAY_S, MAX_DELAY_S = 0.5, 30.0
"""Delay after the first death, and the longest delay [s]."""
HEALTHY_AFTER_S = 10.0
"""A node that has lived this long [s] starts at the first delay again."""


@dataclass
class Backoff:
    """Deaths of a node and its next start.

    Attributes:
        deaths: number of deaths in a row, each after less than `HEALTHY_AFTER_S` seconds.
        due: time of the next start on the caller's clock [s]; None: no start is due.
    """

    deaths: int = 0
    due: float | None = None
    _started: float = field(default=0.0)

    def started(self, now: float) -> None:
        """Register a start at a time [s]."""
        self._started, self.due = now, None

    def died(self, now: float) -> float:
        """Register a death at a time [s].

        Returns:
            Delay of the restart [s].
        """
        if now - self._started > HEALTHY_AFTER_S:
            self.deaths = 0
        delay = min(INITIAL_DELAY_S * 2.0**self.deaths, MAX_DELAY_S)
        self.deaths += 1
        self.due = now + delay
        return delay
