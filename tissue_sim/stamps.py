"""Times and revisions as messages count them, beyond their wrap-arounds. Needs no ROS."""

from typing import Any

_NANOSECONDS = 1_000_000_000
_SECONDS = 1 << 32
"""`Time.sec` is signed and wraps in 2038; taken without its sign it serves until 2106."""
REVISIONS = 1 << 64


def seconds_and_nanoseconds(time: int) -> tuple[int, int]:
    """A time since the epoch [ns] as the two fields of a message's time."""
    seconds, rest = divmod(time, _NANOSECONDS)
    seconds %= _SECONDS
    return seconds - _SECONDS if seconds >= _SECONDS // 2 else seconds, rest


def nanoseconds(time: Any) -> int:
    """A message's time as one since the epoch [ns]."""
    return int(time.sec) % _SECONDS * _NANOSECONDS + int(time.nanosec)


def newer(revision: int, than: int) -> bool:
    """Whether a revision comes after another one, or after none at all (-1)."""
    return than < 0 or 0 < (revision - than) % REVISIONS < REVISIONS // 2
