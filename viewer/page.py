"""A page in the browser: the server, and how the page is laid out."""

import contextlib
import io
import socket
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server

_WIDTH = 330


class PageError(ValueError):
    """The page cannot be served like this; a sentence for the user."""


def open_page(host: str, port: int) -> Any:
    """Starts to serve an empty page.

    Args:
        host: address to listen on.
        port: to listen on; 0: one that is free.

    Raises:
        PageError: nobody can listen there.
    """
    try:
        with socket.create_server((host, port)) as probe:
            port = probe.getsockname()[1]
    except OSError as error:
        raise PageError(
            f'the page cannot be served on {host}, port {port} '
            f'({(error.strerror or str(error)).lower()}): give another with --port or --host'
        ) from None
    with contextlib.redirect_stdout(io.StringIO()), _strangers_refused(host):  # its banner
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.gui.configure_theme(
        control_width='large', show_logo=False, show_share_button=False, brand_color=(28, 126, 214)
    )
    server.gui.set_panel_label('Cutting trainer')
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_WIDTH)
    return server


@contextlib.contextmanager
def _strangers_refused(host: str) -> Iterator[None]:
    """What listens from now on takes no socket from another site's page: browsers let those try."""
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if is_stranger(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, 'this is for the page alone\n')
            return process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    with patch.object(websockets.asyncio.server, 'serve', guarded):
        yield


def is_stranger(headers: Mapping[str, str], host: str) -> bool:
    """Whether a request comes from a page that is not ours.

    Args:
        headers: of the request; programs that are no browsers give no `Origin`.
        host: that is listened on.
    """
    asked = urlsplit(f'//{headers.get("Host", "")}')
    if is_local(host) and not is_local(asked.hostname or ''):
        return True  # a name of somebody else's that leads to this machine
    return 'Origin' in headers and urlsplit(headers['Origin']).netloc != asked.netloc


def addresses(server: Any) -> str:
    """Where the page is, and who can get there, as a sentence."""
    host, port = server.get_host(), server.get_port()
    if is_local(host):
        return f'http://{host}:{port}'
    return (
        f'http://{host}:{port}, from every machine that reaches this one: whoever opens it can '
        'operate the session, without a password'
    )


def is_local(host: str) -> bool:
    """Whether only this machine can reach what listens there."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'
