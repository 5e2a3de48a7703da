"""Access rules of a page: hosts, origins, a token, sizes and rates."""

import hmac
import secrets
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

from cutting_trainer.viewer.page_protocol import Role

TOKEN_VARIABLE = 'CUTTING_TRAINER_PAGE_TOKEN'
"""Environment variable with the viewer's token, set by the launcher: a restarted viewer keeps its
token, and its pages reconnect. Other users cannot read it, unlike arguments."""
INSTRUCTOR_VARIABLE = 'CUTTING_TRAINER_INSTRUCTOR_TOKEN'
"""The same for the link of the instructor."""
_LOCAL = frozenset(('localhost', '127.0.0.1', '::1'))


class PageError(ValueError):
    """The page cannot be served like this; a sentence for the user."""


class Headers(Protocol):
    """Headers of a request, of which each may come more than once."""

    def get_all(self, key: str) -> list[str]:
        """Return all values of a header."""


@dataclass(frozen=True)
class PageLimits:
    """Limits of the messages of one page, and of the number of pages.

    Attributes:
        rate, burst: messages a second [Hz], and at once; more are dropped, except E-STOP.
        flood: number of messages beyond these that closes the page.
        byte_rate, byte_burst: the same in bytes, before parsing: more close the page.
        pages: number of open pages.
        connections: number of open sockets.
        openings, opening_burst: new pages a second, and at once.
        request: time for a socket to get a file, or to become a page [s].
    """

    rate: float = 100.0
    burst: float = 200.0
    flood: int = 1000
    byte_rate: float = 32768.0
    byte_burst: float = 32768.0
    pages: int = 16
    connections: int = 64
    openings: float = 10.0
    opening_burst: float = 32.0
    request: float = 30.0


class Bucket:
    """A token bucket.

    Args:
        rate: refill a second.
        burst: capacity.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._level, self._since = burst, 0.0

    def take(self, amount: float, now: float) -> bool:
        """Return whether an amount may pass at a time [s], and take it if so."""
        self._level = min(self._burst, self._level + max(now - self._since, 0.0) * self._rate)
        self._since = now
        if amount > self._level:
            return False
        self._level -= amount
        return True


@dataclass(frozen=True)
class Gate:
    """Decides which requests are accepted.

    A name that is not in the list is rejected even where it leads to this machine: a foreign page
    could point its own name here (DNS rebinding), and the browser would treat it as the same site.

    Attributes:
        hosts: names and addresses of this server in requests, without port.
        token: of the link.
        instructor_token: of the link of the instructor.
    """

    hosts: frozenset[str]
    token: str
    instructor_token: str

    def knows(self, headers: Headers) -> bool:
        """Return whether a request has a known name of this server, and comes from its pages."""
        hosts, origins = headers.get_all('Host'), headers.get_all('Origin')
        if len(hosts) != 1 or len(origins) > 1 or _name(hosts[0]) not in self.hosts:
            return False
        return not origins or _is_own(origins[0], hosts[0])

    def refusal(self, path: str, headers: Headers, role: Role = 'trainee') -> HTTPStatus | None:
        """Return why a socket is rejected; None where it is accepted.

        A socket needs an `Origin`, which every browser sends, or none, as from a program that is no
        browser; the token of its role authorises it.
        """
        token = self.instructor_token if role == 'instructor' else self.token
        given = _query(path).get('token', [''])
        right = hmac.compare_digest(given[0].encode(), token.encode())
        return None if right and len(given) == 1 and self.knows(headers) else HTTPStatus.FORBIDDEN


def make_gate(
    host: str, allowed: Collection[str], token: str = '', instructor_token: str = ''
) -> Gate:
    """Return the gate of a page.

    Args:
        host: listening address.
        allowed: further names and addresses of the server in requests.
        token: of the link; '': a new one.
        instructor_token: of the link of the instructor; '': a new one.

    Raises:
        PageError: other machines can reach it and no name is allowed, or a name is invalid.
    """
    for name in allowed:
        if _name(name) != name.lower() or not name:
            raise PageError(
                f'{name!r} is no name of a host: give it without scheme and port, as trainer.lan'
            )
    if not is_local(host) and not allowed:
        raise PageError(
            f'on {host} other machines reach the page: say with --allow-host by which name or '
            'address they ask for it, once for each'
        )
    own = () if host in ('0.0.0.0', '::', '') else (host,)
    names = {name.lower() for name in (*allowed, *own)}
    made = (given or secrets.token_urlsafe(24) for given in (token, instructor_token))
    return Gate(_LOCAL | names, *made)


def link(host: str, port: int, allowed: Sequence[str], token: str, role: Role = 'trainee') -> str:
    """Return the address of a page of a role with its token, by the name that pages use."""
    name = allowed[0] if allowed else host
    page = 'instructor' if role == 'instructor' else ''
    return f'http://{f"[{name}]" if ":" in name else name}:{port}/{page}?token={token}'


def is_local(host: str) -> bool:
    """Return whether only this machine can reach a listening address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'


def _name(netloc: str) -> str:
    """Return a host without its port, '' where it is none."""
    if any(sign in netloc for sign in '/?#@\\'):
        return ''
    if netloc.count(':') > 1 and not netloc.startswith('['):
        return netloc.lower()  # an IPv6 address by itself
    try:
        parts = urlsplit(f'//{netloc}')
        _ = parts.port
    except ValueError:
        return ''
    return (parts.hostname or '').lower()


def _is_own(origin: str, host: str) -> bool:
    """Return whether an origin is the site of a request."""
    scheme, _, rest = origin.partition('://')
    return scheme in ('http', 'https') and rest.lower() == host.lower()


def _query(path: str) -> dict[str, list[str]]:
    try:
        return parse_qs(urlsplit(path).query, max_num_fields=4, keep_blank_values=True)
    except ValueError:
        return {}
