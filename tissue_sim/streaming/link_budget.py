"""Data rate limit for meshes on a slow link: deltas are skipped, and the next one covers all."""

from functools import cache
from operator import attrgetter
from typing import Any

_BURST_S = 0.5
"""Time whose bytes may be sent at once after a pause."""


class LinkBudget:
    """Limit of bytes per second.

    Args:
        rate: [bytes/s]; 0: no limit.

    Attributes:
        held_back: messages that were not sent because of the limit.
        sent: bytes sent.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._left = rate * _BURST_S
        self._last = 0.0
        self.held_back = 0
        self.sent = 0

    def allows(self, now: float) -> bool:
        """Return whether a message may be sent at a time [s].

        A refused message counts as held back.
        """
        self._left = min(self._left + self._rate * (now - self._last), self._rate * _BURST_S)
        self._last = now
        allowed = not self._rate or self._left > 0
        self.held_back += not allowed
        return allowed

    def spend(self, message: Any) -> None:
        """Count the bytes of a message that was sent; only arrays count."""
        arrays = _arrays(type(message))  # type: ignore[arg-type]
        size = sum(len(value) * value.itemsize for value in arrays(message))
        self.sent += size
        self._left -= size


@cache
def _arrays(message_type: Any) -> 'attrgetter[Any]':
    """Return a getter for the arrays of a message type with two or more."""
    fields = message_type.get_fields_and_field_types()
    return attrgetter(*(name for name, kind in fields.items() if kind.startswith('sequence<')))
