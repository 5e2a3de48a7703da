"""How much of the tissue goes over a thin link: deltas are left out, the next one says it all."""

from functools import cache
from operator import attrgetter
from typing import Any

_SAVED = 0.5
"""[s] of bytes that may be sent at once after a pause."""


class LinkBudget:
    """Bytes that may be sent in a second.

    Args:
        rate: [bytes/s]; 0: as many as there are.

    Attributes:
        held_back: messages that were not sent for it.
        sent: bytes.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._left = rate * _SAVED
        self._last = 0.0
        self.held_back = 0
        self.sent = 0

    def allows(self, now: float) -> bool:
        """Whether a message may be sent at a time [s]; one that may not counts as held back."""
        self._left = min(self._left + self._rate * (now - self._last), self._rate * _SAVED)
        self._last = now
        allowed = not self._rate or self._left > 0
        self.held_back += not allowed
        return allowed

    def spend(self, message: Any) -> None:
        """Takes note of a message that was sent; arrays are what counts."""
        arrays = _arrays(type(message))  # type: ignore[arg-type]
        size = sum(len(value) * value.itemsize for value in arrays(message))
        self.sent += size
        self._left -= size


@cache
def _arrays(message_type: Any) -> 'attrgetter[Any]':
    """What takes the arrays out of a message of a type; it has two or more."""
    fields = message_type.get_fields_and_field_types()
    return attrgetter(*(name for name, kind in fields.items() if kind.startswith('sequence<')))
