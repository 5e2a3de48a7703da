"""Open pages without a browser: clients that read what the server sends, or never do.

Run `python -m bench.open_page URL [--pages 3]`: says `open` once all have the whole scene, reads
until its standard input is closed, then prints what came as JSON.
"""

import argparse
import importlib.metadata
import json
import subprocess
import sys
import threading
import time
from typing import Any

import msgspec
import numpy as np
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

PROTOCOL = f'viser-v{importlib.metadata.version("viser")}'


class OpenPage:
    """A page that reads everything in a thread of its own, or nothing until it is let to.

    Args:
        url: of the page.
        reads: whether it does so from the start.

    Attributes:
        windows: messages of the socket that were read.
        updates: those of them with new positions of the tissue.
        newest: the last of those, shape (n, 3).
    """

    def __init__(self, url: str, *, reads: bool = True) -> None:
        address = url.replace('http', 'ws', 1)
        # No buffer of the client's own: what it does not take waits in the sockets.
        self._socket = connect(
            address, subprotocols=[PROTOCOL], max_size=None, max_queue=1, compression=None
        )
        self.windows = self.updates = 0
        self.newest: np.ndarray | None = None
        self._reading = threading.Event()
        self._decompress = zstandard.ZstdDecompressor().decompress
        if reads:
            self.read()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def read(self) -> None:
        """Reads from now on."""
        self._reading.set()

    def close(self) -> None:
        """Leaves the page."""
        self._reading.set()
        self._socket.close()
        self._thread.join(5.0)

    def _run(self) -> None:
        self._reading.wait()
        try:
            for data in self._socket:
                assert isinstance(data, bytes)
                self.windows += 1
                self._take(data)
        except ConnectionClosed:
            return

    def _take(self, data: bytes) -> None:
        length = int.from_bytes(data[8:16], 'little')
        content: Any = msgspec.msgpack.decode(self._decompress(data[16 : 16 + length]))
        at, buffers = 16 + length, []
        for size in content['binaryBufferLengths']:
            at += -at % 8
            buffers.append(data[at : at + size])
            at += size
        found = [message.get('updates', {}).get('vertices') for message in content['messages']]
        moved = [vertices for vertices in found if vertices is not None]
        self.updates += bool(moved)  # outer surface and cut surfaces are two meshes of a frame
        for vertices in moved:
            place = vertices['__binary_index']
            self.newest = np.frombuffer(buffers[place], np.float32).reshape(-1, 3)


class OtherProcess:
    """Open pages in a process of their own; they have the whole scene when this is made.

    Args:
        url: of the page.
        pages: how many.
        nice: its niceness; with 19 it takes only what nobody else wants of a core.
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
        """Ends it; returns `rates` of each page [Hz] and `load`, processor time by time [1]."""
        said, _ = self._process.communicate()
        result: dict[str, Any] = json.loads(said)
        return result


def main() -> None:
    """Reads until the standard input ends."""
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
