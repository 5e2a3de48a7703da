"""Reservation of a ROS domain: two sessions in one domain would mix their messages."""

import os
import socket
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Literal

from cutting_trainer.session.errors import SessionError

Side = Literal['bridge', 'sim']
SIDES: tuple[Side, ...] = ('bridge', 'sim')
"""Hosts of a session: the one with the device, and the one that computes the tissue."""
MAX_DOMAIN = 101
"""Above this domain, DDS uses ports of Linux's ephemeral range."""
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
_FIRST_PARTICIPANT = 10
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
"""Variable that says how far nodes may find one another."""
_CREDENTIALS = struct.Struct('3i')


def parse_domain(text: str) -> int | Literal['free']:
    """Return the domain of the user's text, else of the environment, else 0.

    Raises:
        SessionError: it is neither `free` nor a number from 0 to `MAX_DOMAIN`, or the environment
            keeps nodes from finding one another.
    """
    if os.environ.get(RANGE) == 'OFF':
        raise SessionError(
            f'{RANGE} is OFF: the nodes of a session cannot find one another; unset it, or set it '
            'to LOCALHOST'
        )
    if text == 'free':
        return 'free'
    number = text or os.environ.get('ROS_DOMAIN_ID') or '0'
    if not number.isdecimal() or int(number) > MAX_DOMAIN:
        name = '--domain' if text else 'ROS_DOMAIN_ID'
        raise SessionError(f'{name} is {number!r}: give a number from 0 to {MAX_DOMAIN}')
    return int(number)


@contextmanager
def reserved_domain(
    domain: int | Literal['free'], sides: Collection[Side] = SIDES
) -> Iterator[int]:
    """Reserve a domain for one session on this machine; the kernel frees it with the process.

    Args:
        domain: its number, or `free` for the first that neither a session nor other DDS uses.
        sides: sides of the session that run here.

    Raises:
        SessionError: a session is running in the domain.
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
    """Reserve a domain for some sides of a session.

    Raises:
        SessionError: another process has reserved one of them.
    """
    # Like DDS, an abstract socket ends with its process and is local to its network namespace.
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
    for domain in range(1, MAX_DOMAIN + 1):
        with suppress(SessionError):
            reservation = _reserve(domain, sides)
            if not has_participants(domain):
                return domain, reservation
            reservation.close()
    raise SessionError(f'no ROS domain from 1 to {MAX_DOMAIN} is free: end a session first')


def has_participants(domain: int) -> bool:
    """Return whether some DDS of this machine is in a domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', FIRST_PORT + PORTS_PER_DOMAIN * domain + _FIRST_PARTICIPANT))
        except OSError:
            return True
    return False
