"""When a node that died is started again: soon at first, later and later if it dies again."""

from dataclasses import dataclass, field

FIRST, MOST = 0.5, 30.0
"""[s] after the first death, and at most."""
HEALTHY = 10.0
"""[s] that a node must have lived for its earlier deaths to be forgotten."""


@dataclass
class Backoff:
    """One node's deaths and what follows from them.

    Attributes:
        deaths: in a row, none of which came after a healthy life.
        due: when it is to be started again, on the caller's clock [s]; None: not at all.
    """

    deaths: int = 0
    due: float | None = None
    _started: float = field(default=0.0)

    def started(self, now: float) -> None:
        """Takes note of a start at a time [s]."""
        self._started, self.due = now, None

    def died(self, now: float) -> float:
        """Takes note of a death at a time [s].

        Returns:
            After how long [s] the node is to be started again.
        """
        if now - self._started > HEALTHY:
            self.deaths = 0
        delay = min(FIRST * 2.0**self.deaths, MOST)
        self.deaths += 1
        self.due = now + delay
        return delay
