"""One session a ROS domain: two at once would take each other's messages for their own."""

import os
import socket
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Literal

from session.errors import SessionError

Side = Literal['bridge', 'sim']
SIDES: tuple[Side, ...] = ('bridge', 'sim')
"""The two halves of a session: where the device is, and where the tissue is computed."""
LARGEST_DOMAIN = 101
"""Above it, DDS's ports reach into those that Linux gives to anybody."""
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
_FIRST_PARTICIPANT = 10
_CREDENTIALS = struct.Struct('3i')


def parse_domain(text: str) -> int | Literal['free']:
    """What the user says, else what the environment says, else 0.

    Raises:
        SessionError: it is neither `free` nor a number from 0 to `LARGEST_DOMAIN`.
    """
    if text == 'free':
        return 'free'
    number = text or os.environ.get('ROS_DOMAIN_ID') or '0'
    if not number.isdecimal() or int(number) > LARGEST_DOMAIN:
        name = '--domain' if text else 'ROS_DOMAIN_ID'
        raise SessionError(f'{name} is {number!r}: give a number from 0 to {LARGEST_DOMAIN}')
    return int(number)


@contextmanager
def reserved_domain(
    domain: int | Literal['free'], sides: Collection[Side] = SIDES
) -> Iterator[int]:
    """Keeps a domain for one session on this machine; the kernel frees it with the process.

    Args:
        domain: its number, or `free` for the first that neither a session nor other DDS uses.
        sides: of the session that run here.

    Raises:
        SessionError: a session is running in it.
    """
    if domain != 'free':
        reservation = _reserve(domain, sides)
    else:
        domain, reservation = _first_free(sides)
    with reservation:
        yield domain


def _address(domain: int, side: Side) -> str:
    return f'\0cutting_trainer.{side}.{domain}'


def _reserve(domain: int, sides: Collection[Side]) -> ExitStack:
    """Both sides of a session, or the one that runs here.

    Raises:
        SessionError: somebody else has one of them.
    """
    # An abstract socket has the life of its process and the reach of its network, as DDS has.
    with ExitStack() as stack:
        for side in sides:
            reservation = stack.enter_context(socket.socket(socket.AF_UNIX))
            try:
                reservation.bind(_address(domain, side))
            except OSError:
                raise SessionError(
                    f'a session is running in ROS domain {domain} already '
                    f'(process {_holder(domain, side)}): wait for its end, '
                    'or give this one a domain of its own with --domain free'
                ) from None
            reservation.listen()
        return stack.pop_all()


def _holder(domain: int, side: Side) -> int | str:
    with socket.socket(socket.AF_UNIX) as visitor:
        try:
            visitor.connect(_address(domain, side))
            data = visitor.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return 'unknown'
    return int(_CREDENTIALS.unpack(data)[0])


def _first_free(sides: Collection[Side]) -> tuple[int, ExitStack]:
    for domain in range(1, LARGEST_DOMAIN + 1):
        with suppress(SessionError):
            reservation = _reserve(domain, sides)
            if not _has_participants(domain):
                return domain, reservation
            reservation.close()
    raise SessionError(f'no ROS domain from 1 to {LARGEST_DOMAIN} is free: end a session first')


def _has_participants(domain: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', FIRST_PORT + PORTS_PER_DOMAIN * domain + _FIRST_PARTICIPANT))
        except OSError:
            return True
    return False
