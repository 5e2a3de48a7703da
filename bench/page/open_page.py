"""Open pages without a browser: clients that read the messages of the server, or never do.

Run `python -m bench.page.open_page URL [--pages 3]`: says `open` once all have the whole scene,
reads until its standard input is closed, then prints the statistics as JSON.
"""

import argparse
import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from bench.common.waiting import until

STEP_TIMEOUT_S = 30.0
"""Timeout of any step."""


def session_address(url: str) -> str:
    """Return the address of the socket of a page's link."""
    parts = urlsplit(url)
    return f'ws://{parts.netloc}{parts.path.rstrip("/")}/session?{parts.query}'


class OpenPage:
    """Page that reads everything in a thread, or nothing until `read`.

    Args:
        url: of the page, with its token.
        reads: whether it does so from the start.
        listens: is called with every message that came, in that thread.

    Attributes:
        messages: of the socket that were read.
        updates: those of them with new positions of the tissue.
        faces: those of them with faces too.
        newest: positions of the newest outer part, shape (n, 3).
        values: newest content by type.
        counts: messages by type.
    """

    def __init__(
        self, url: str, *, reads: bool = True, listens: Callable[[Any], None] | None = None
    ) -> None:
        # The client has no buffer: unread data waits in the sockets.
        self._socket = connect(session_address(url), max_size=None, max_queue=1, compression=None)
        self.messages = self.updates = self.faces = 0
        self.newest: np.ndarray | None = None
        self.values: dict[str, Any] = {}
        self.counts: Counter[str] = Counter()
        self.closed = False
        self._listens = listens
        self._reading = threading.Event()
        if reads:
            self.read()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def read(self) -> None:
        """Read from now on."""
        self._reading.set()

    def ask(self, op: str, **fields: Any) -> None:
        """Ask the server for something."""
        self._socket.send(json.dumps({'op': op, **fields}))

    def send(self, data: str | bytes) -> None:
        """Send an invalid message."""
        self._socket.send(data)

    def wait(self, condition: Callable[[], Any], goal: str, timeout: float = STEP_TIMEOUT_S) -> Any:
        """Wait for a condition, and return its value."""
        return until(condition, goal, timeout, 0.002)

    def close(self) -> None:
        """Leave the page."""
        self._reading.set()
        self._socket.close()
        self._thread.join(5.0)

    def _run(self) -> None:
        self._reading.wait()
        try:
            for data in self._socket:
                self.messages += 1
                if isinstance(data, bytes):
                    self._take_tissue(data)
                else:
                    self._take(json.loads(data))
        except ConnectionClosed:
            pass
        finally:
            self.closed = True

    def _take(self, content: dict[str, Any]) -> None:
        self.values[content['type']] = content
        self.counts[content['type']] += 1
        if self._listens is not None:
            self._listens(content)

    def _take_tissue(self, data: bytes) -> None:
        header, parts, _, _ = read_tissue(data)
        self.counts['mesh'] += 1
        self.updates += 1
        self.faces += parts[0][1] is not None
        self.values[header['name']] = parts
        if header['name'] == 'tissue':
            self.newest = parts[0][0]


def read_tissue(
    data: bytes,
) -> tuple[dict[str, Any], list[tuple[Any, Any]], np.ndarray, np.ndarray]:
    """Return header, parts (positions, faces), cut edges and places at rest of a binary message."""
    at = 4 + int.from_bytes(data[:4], 'little')
    assert at % 4 == 0
    header = json.loads(data[4:at])
    parts = []
    for part in header['parts']:
        positions = np.frombuffer(data, '<f4', 3 * part['vertices'], at).reshape(-1, 3)
        at += positions.nbytes
        faces = None
        if part['faces'] is not None:
            faces = np.frombuffer(data, '<u4', 3 * part['faces'], at).reshape(-1, 3)
            at += faces.nbytes
        parts.append((positions, faces))
    cut_edges = np.frombuffer(data, '<f4', 3 * header['cut_edges'], at).reshape(-1, 3)
    at += cut_edges.nbytes
    rest = np.frombuffer(data, '<f4', 2 * header['rest'], at).reshape(-1, 2)
    assert at + rest.nbytes == len(data)
    return header, parts, cut_edges, rest


class OtherProcess:
    """Open pages in a process of their own; they have the whole scene when this is made.

    Args:
        url: of the page.
        pages: how many.
        nice: its niceness; with 19 it takes only idle processor time.
    """

    def __init__(self, url: str, pages: int, nice: int) -> None:
        command = ['nice', '-n', str(nice), sys.executable, '-m', __spec__.name, url]
        self._process = subprocess.Popen(
            [*command, '--pages', str(pages)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b'open\n'

    def close(self) -> dict[str, Any]:
        """End it; return `rates` of each page [Hz] and `load`, processor time by time [1]."""
        said, _ = self._process.communicate()
        result: dict[str, Any] = json.loads(said)
        return result


def main() -> None:
    """Read until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('url')
    parser.add_argument('--pages', type=int, default=1)
    given = parser.parse_args()
    pages = [OpenPage(given.url) for _ in range(given.pages)]
    while any(page.newest is None for page in pages):
        time.sleep(0.05)
    print('open', flush=True)
    before, began, busy = [page.updates for page in pages], time.monotonic(), time.process_time()
    sys.stdin.read()
    seconds = time.monotonic() - began
    rates = [(page.updates - count) / seconds for page, count in zip(pages, before, strict=True)]
    print(json.dumps({'rates': rates, 'load': (time.process_time() - busy) / seconds}))


if __name__ == '__main__':
    main()
