"""Web server of the pages: static files, and a WebSocket for each page.

One thread owns all mutable state: the values, the pages, their rate limits. Other threads hand
values over by `call_soon_threadsafe`, so that no thread iterates over state that another changes.
A page's messages are checked in the loop that receives them, E-STOP first and without any queue.
A newer value replaces one that a page has not received, so that a slow page delays nobody.
"""

import asyncio
import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.protocol import State

from cutting_trainer.viewer.access_control import Bucket, Gate, PageError, PageLimits
from cutting_trainer.viewer.allowed_requests import Controls
from cutting_trainer.viewer.page_protocol import (
    MAX_MESSAGE,
    ROLES,
    AnyMessage,
    EStop,
    Mode,
    Ping,
    ProtocolError,
    Role,
    parse,
)
from cutting_trainer.viewer.page_state import PageState, ReceivedVersions, TissueFrame
from cutting_trainer.viewer.static_files import answer, read_files

SESSIONS: dict[str, Role] = {'/session': 'trainee', '/instructor/session': 'instructor'}
"""Roles by the path of the socket."""
_CHUNK = 4096
"""[bytes] read of one socket before the others are served."""
_KEEPALIVE_S, _CLOSING_S, _OPENING_S = 10.0, 1.0, 5.0
_START_TIMEOUT_S = 10.0
_FLOODED, _NOT_TEXT, _FULL = 'too many messages', 'only text is understood', 'too many pages'
_SILENT = logging.Logger('viewer.page', logging.CRITICAL + 1)
"""Logger of websockets: clients could fill the log of the node, a line a connection."""


class _Connection(ServerConnection):
    """A socket that counts its bytes before they are parsed."""

    def connection_made(self, transport: Any) -> None:
        pages: PageServer = self.pages
        self.bytes = Bucket(pages.limits.byte_rate, pages.limits.byte_burst)
        transport.max_size = _CHUNK
        super().connection_made(transport)
        pages.sockets.add(self)
        if len(pages.sockets) > pages.limits.connections:
            transport.abort()
        self._deadline = self.loop.call_later(pages.limits.request, self._expire)

    def _expire(self) -> None:
        if self.state is not State.OPEN:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        if self.bytes.take(len(data), time.monotonic()):
            super().data_received(data)
        else:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._deadline.cancel()
        self.pages.sockets.discard(self)
        super().connection_lost(exc)

    pages: 'PageServer'


class _Page:
    """One open page.

    Args:
        connection: its socket.
        limits: of its messages.
        role: of who looks at it.
    """

    def __init__(self, connection: ServerConnection, limits: PageLimits, role: Role) -> None:
        self.connection, self.role = connection, role
        self.seen = ReceivedVersions()
        self.news = asyncio.Event()
        self.news.set()
        self.replies: dict[str, str] = {}
        self.messages = Bucket(limits.rate, limits.burst)
        self.dropped = Bucket(limits.flood, limits.flood)

    def reply(self, kind: str, **content: object) -> None:
        """Queue an answer to this page alone: the newest of each kind."""
        self.replies[kind] = json.dumps({'type': kind, **content})
        self.news.set()


class PageServer:
    """Serves the pages of one session, in a thread of its own.

    Args:
        host: listening address.
        port: listening port; 0: one that is free.
        gate: access rules.
        mode: live or replay.
        controls: requests that are allowed now; see `allow`.
        act: executes the request of a page; called in the server's thread, must not block. Its
            exceptions are kept in `failures`.
        limits: of each page, and of all.

    Raises:
        PageError: the address cannot be listened on.
    """

    def __init__(
        self,
        host: str,
        port: int,
        gate: Gate,
        mode: Mode,
        controls: Controls,
        act: Callable[[AnyMessage], None],
        limits: PageLimits | None = None,
    ) -> None:
        self.limits = limits or PageLimits()
        self.sockets: set[ServerConnection] = set()
        self.failures: list[str] = []
        self._gate, self._mode, self._act = gate, mode, act
        self._controls = controls
        self._ticked = time.monotonic()
        self._state = PageState()
        self._pages: set[_Page] = set()
        self._openings = Bucket(self.limits.openings, self.limits.opening_burst)
        self._files = read_files()
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._ends = asyncio.Event()
        self._serves = threading.Event()
        self._thread = threading.Thread(target=self._run, name='pages', daemon=True)
        self._thread.start()
        self._serves.wait(_START_TIMEOUT_S)
        self.allow(controls)

    # For any thread

    @property
    def pages(self) -> int:
        """Return the number of open pages."""
        return len(self._pages)

    def tick(self) -> None:
        """Record that the session is updated: each `pong` states the time since then."""
        self._ticked = time.monotonic()

    def put(self, kind: str, /, **content: object) -> None:
        """Show the newest content of a message type to all pages."""
        text = json.dumps({'type': kind, **content}, allow_nan=False)
        self._hand_over(kind, text)

    def put_tissue(self, frame: TissueFrame) -> None:
        """Show a tissue to all pages."""
        self._hand_over(frame.name, frame)

    def allow(self, controls: Controls) -> None:
        """Set the allowed requests, and publish them to the pages."""
        self._controls = controls
        self.put('controls', refused={role: controls.refused(role) for role in ROLES})

    def stop(self) -> None:
        """Close all pages and the server."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ends.set)
            self._thread.join(_CLOSING_S + _OPENING_S)

    def _hand_over(self, key: str, value: str | TissueFrame) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._take, key, value)

    # In the server's thread only

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        kind = type('Connection', (_Connection,), {'pages': self})
        async with serve(
            self._page,
            sock=self._socket,
            create_connection=kind,
            process_request=self._request,
            compression=None,
            max_size=MAX_MESSAGE,
            max_queue=4,
            open_timeout=_OPENING_S,
            ping_interval=_KEEPALIVE_S,
            ping_timeout=_KEEPALIVE_S,
            close_timeout=_CLOSING_S,
            server_header=None,
            logger=_SILENT,
        ):
            self._serves.set()
            await self._ends.wait()

    def _take(self, key: str, value: str | TissueFrame) -> None:
        if self._state.put(key, value):
            for page in self._pages:
                page.news.set()

    def _request(self, _: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None where a socket is accepted."""
        if not self._gate.knows(request.headers):
            return answer(HTTPStatus.FORBIDDEN, 'localhost')
        host = request.headers['Host']
        path = urlsplit(request.path).path
        role = SESSIONS.get(path)
        if role is None:
            content = self._files.get(path)
            status = HTTPStatus.OK if content else HTTPStatus.NOT_FOUND
            return answer(status, host, content)
        if why := self._gate.refusal(request.path, request.headers, role):
            return answer(why, host)
        if not self._openings.take(1.0, time.monotonic()):
            return answer(HTTPStatus.SERVICE_UNAVAILABLE, host)
        return None

    async def _page(self, connection: ServerConnection) -> None:
        if len(self._pages) >= self.limits.pages:
            await connection.close(1013, _FULL)
            return
        assert connection.request is not None
        role = SESSIONS[urlsplit(connection.request.path).path]
        page = _Page(connection, self.limits, role)
        self._pages.add(page)
        sender = asyncio.create_task(self._send_updates(page))
        try:
            await self._receive(page)
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(page)
            sender.cancel()

    async def _send_updates(self, page: _Page) -> None:
        """Send one page its missing values, as fast as it receives them."""
        try:
            while True:
                await page.news.wait()
                page.news.clear()
                while page.replies:
                    await page.connection.send(page.replies.pop(next(iter(page.replies))))
                for message in self._state.due(page.seen):
                    await page.connection.send(message)
        except ConnectionClosed:
            return

    async def _receive(self, page: _Page) -> None:
        """Process the messages of a page one by one, and yield to the other pages after each."""
        while True:
            data = await page.connection.recv()
            if not isinstance(data, str):
                await page.connection.close(1003, _NOT_TEXT)
                return
            now = time.monotonic()
            message = self._parse(data)
            if isinstance(message, EStop) or page.messages.take(1.0, now):
                self._judge(page, message)
            elif not page.dropped.take(1.0, now):
                await page.connection.close(1008, _FLOODED)
                return
            await asyncio.sleep(0)

    def _parse(self, text: str) -> AnyMessage | ProtocolError:
        try:
            return parse(text, self._mode)
        except ProtocolError as error:
            return error

    def _judge(self, page: _Page, message: AnyMessage | ProtocolError) -> None:
        if isinstance(message, ProtocolError):
            page.reply('refused', op='', why=str(message))
            return
        if isinstance(message, Ping):
            page.reply('pong', id=message.id, age=round(time.monotonic() - self._ticked, 3))
            return
        why = '' if isinstance(message, EStop) else self._controls.refusal(message, page.role)
        if why:
            page.reply('refused', op=message.op, why=why)
            return
        try:
            self._act(message)
        except Exception as error:  # a failed action must not close the page that asked
            page.reply('refused', op=message.op, why='The trainer could not do this: see its log.')
            if len(self.failures) < self.limits.pages:
                self.failures.append(f'{message.op}: {type(error).__name__}: {error}')
        if isinstance(message, EStop):
            # Answered also where a stop holds already: the page repeats it until it is confirmed.
            page.seen.versions.pop('state', None)
            page.news.set()


def _listen(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises:
        PageError: the address cannot be listened on.
    """
    family = socket.AF_INET6 if ':' in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise PageError(
            f'the page cannot be served on {host}, port {port} '
            f'({(error.strerror or str(error)).lower()}): give another with --port or --host'
        ) from None
