"""A page in the browser: the server, and how the page is laid out."""

import contextlib
import io
import socket
from ipaddress import ip_address
from typing import Any

import viser

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
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.gui.configure_theme(
        control_width='large', show_logo=False, show_share_button=False, brand_color=(28, 126, 214)
    )
    server.gui.set_panel_label('Cutting trainer')
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_WIDTH)
    return server


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
