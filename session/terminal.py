"""Terminal output of a running session, written by a thread: a stopped terminal delays nothing."""

import atexit
import io
import os
import sys
from contextlib import suppress
from functools import cache
from typing import IO, Any, TextIO, cast

from rich.console import Console

from cutting_trainer.node_common.output import Outlet

TERMINAL_CLOSE_TIMEOUT_S = 5.0
"""Time [s] that the end of the program waits for the reader of its last lines."""


class QueuedStream(io.TextIOBase):
    """A text stream whose writer does not wait: another thread writes to the real one.

    Args:
        stream: the real one, of a file of the operating system.
    """

    def __init__(self, stream: TextIO) -> None:
        stream.flush()
        self._stream = stream
        self._number = stream.fileno()
        self._outlet = Outlet(os.dup(self._number), 'the terminal')

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Encoding of the real stream."""
        return self._stream.encoding

    @property
    def dropped(self) -> int:
        """Number of lines discarded because the queue was full."""
        return self._outlet.dropped

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._number

    def write(self, text: str) -> int:
        self._outlet.put(text.encode(self.encoding, 'backslashreplace'))
        return len(text)

    def drain(self, timeout: float | None = None) -> bool:
        """Wait until all is written; return whether it is within `timeout` [s]."""
        return self._outlet.drain(timeout)


@cache
def _queued(stream: TextIO) -> QueuedStream:
    queued = QueuedStream(stream)
    atexit.register(queued.drain, TERMINAL_CLOSE_TIMEOUT_S)
    return queued


def session_console(**options: Any) -> Console:
    """Return a console on standard error for messages during supervision."""
    with suppress(OSError, ValueError):  # standard error without a file descriptor, as in tests
        return Console(file=cast(IO[str], _queued(sys.stderr)), **options)
    return Console(stderr=True, **options)


def settle(console: Console) -> None:
    """Wait until a console has written everything. Call it only when no node is supervised."""
    if isinstance(console.file, QueuedStream):
        console.file.drain()
