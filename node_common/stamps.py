"""Times and revisions in messages, compared beyond their wrap-around. Needs no ROS."""

from typing import Any

_NANOSECONDS = 1_000_000_000
_SECONDS = 1 << 32
"""`Time.sec` is signed and wraps in 2038; taken without its sign it serves until 2106."""
REVISION_MODULUS = 1 << 64


def seconds_and_nanoseconds(time: int) -> tuple[int, int]:
    """Return a time since the epoch [ns] as the two fields of a time message."""
    seconds, rest = divmod(time, _NANOSECONDS)
    seconds %= _SECONDS
    return seconds - _SECONDS if seconds >= _SECONDS // 2 else seconds, rest


def nanoseconds(time: Any) -> int:
    """Return a time message as time since the epoch [ns]."""
    return int(time.sec) % _SECONDS * _NANOSECONDS + int(time.nanosec)


def newer(revision: int, than: int) -> bool:
    """Return whether a revision follows another one, or none at all (-1)."""
    return than < 0 or 0 < (revision - than) % REVISION_MODULUS < REVISION_MODULUS // 2
