"""Open pages without a browser: clients that read what the server sends, fast, slowly or never."""

import importlib.metadata
import threading
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
        updates: new positions of a mesh among them.
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
        for message in content['messages']:
            vertices = message.get('updates', {}).get('vertices')
            if vertices is not None:
                self.updates += 1
                place = vertices['__binary_index']
                self.newest = np.frombuffer(buffers[place], np.float32).reshape(-1, 3)
