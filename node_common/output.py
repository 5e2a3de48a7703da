"""Non-blocking standard output and error: a thread writes, and lines beyond a limit are dropped.

A write to a full pipe or a stopped terminal blocks. rclpy's logger then blocks with the
interpreter's lock held, and with it every loop of the process. In this module, the standard output
and error of a node become pipes within the process. Their writing end never blocks. One thread
reads them, and another writes the lines to the original file.
"""

import atexit
import faulthandler
import fcntl
import io
import os
import select
import stat
import sys
import threading
import time
from collections import deque
from contextlib import suppress

MAX_BUFFERED_BYTES = 1 << 18
"""Size of a log that waits for its reader."""
MAX_CONTROL_LINES = 1000
"""Lines for the launcher that wait for it."""
MAX_LINE_BYTES = 1 << 16
"""Length at which a line without end is passed on."""
FLUSH_TIMEOUT_S = 1.0
"""Time that the end of a process waits for the reader of its last lines."""
PIPE_BYTES = 1 << 20
HEARTBEAT = 'TRAINER_HEARTBEAT'
"""Environment variable: period [s] of lines `beat: NAME` for a supervisor; no lines if unset."""
CONTROL_PREFIXES = (
    b'ready: ',
    b'done: ',
    b'failed: ',
    b'phase: ',
    b'message: ',
    b'beat: ',
    b'e_stop: ',
)
"""Prefixes of lines that the launcher acts on; a log line with one is indented by a space."""


class Outlet:
    """Writes to a file from a thread of its own.

    Attributes:
        dropped: lines that were not written.

    Args:
        descriptor: of the file.
        reader: name of the slow reader in the sentence about dropped lines.
    """

    def __init__(self, descriptor: int, reader: str) -> None:
        self.dropped = 0
        self._descriptor, self._reader = descriptor, reader
        self._announced: deque[bytes] = deque()
        self._pieces: deque[bytes] = deque()
        self._kept = self._unsaid = 0
        self._writing = self._closed = False
        self._turn = threading.Condition()
        threading.Thread(target=self._run, name='outlet', daemon=True).start()

    def put(self, piece: bytes) -> None:
        """Queue lines and return at once; if the queue is full, the oldest lines are dropped."""
        with self._turn:
            while self._pieces and self._kept + len(piece) > MAX_BUFFERED_BYTES:
                oldest = self._pieces.popleft()
                self._kept -= len(oldest)
                self._drop(oldest)
            self._kept += len(piece)
            self._pieces.append(piece)
            self._turn.notify()

    def announce(self, line: bytes) -> None:
        """Queue a line ahead of those of `put`; it does not count among them."""
        with self._turn:
            if len(self._announced) < MAX_CONTROL_LINES:
                self._announced.append(line)
                self._turn.notify()
            else:
                self._drop(line)

    def count_dropped(self, piece: bytes) -> None:
        """Count lines that were lost before they reached this queue."""
        with self._turn:
            self._drop(piece)

    @property
    def announcing(self) -> bool:
        """Whether an announced line still waits for the reader."""
        return bool(self._announced)

    def drain(self, timeout: float | None = None) -> bool:
        """Wait until all is written, at most `timeout` [s]; return whether it is."""
        with self._turn:
            return self._turn.wait_for(
                lambda: not (self._writing or self._announced or self._pieces), timeout
            )

    def close(self, timeout: float) -> None:
        """Drain; the thread then closes the file and ends."""
        self.drain(timeout)
        with self._turn:
            self._closed = True
            self._turn.notify_all()

    def _drop(self, piece: bytes) -> None:
        lines = max(piece.count(b'\n'), 1)
        self.dropped += lines
        self._unsaid += lines

    def _run(self) -> None:
        while (piece := self._next()) is not None:
            written = self._write(piece)
            with self._turn:
                self._writing = False
                if not written:
                    self.dropped += max(piece.count(b'\n'), 1)
                self._turn.notify_all()
        os.close(self._descriptor)

    def _next(self) -> bytes | None:
        with self._turn:
            self._turn.wait_for(lambda: self._announced or self._pieces or self._closed)
            if not (self._announced or self._pieces):
                return None
            self._writing = True
            if self._announced:
                return self._announced.popleft()
            if self._unsaid and self._kept < MAX_BUFFERED_BYTES // 2:  # there is room again
                lost, self._unsaid = self._unsaid, 0
                text = f'warning: {lost} lines were dropped: {self._reader} did not read\n'
                return text.encode()
            piece = self._pieces.popleft()
            self._kept -= len(piece)
            return piece

    def _write(self, piece: bytes) -> bool:
        rest = memoryview(piece)
        while rest:
            try:
                rest = rest[os.write(self._descriptor, rest) :]
            except BlockingIOError:  # another owner has made the file non-blocking
                select.select([], [self._descriptor], [], 1.0)
            except OSError:  # the reader is gone, or the disk is full
                return False
        return True


class _Unblocked(io.RawIOBase):
    """A non-blocking descriptor for Python's text streams; rejected bytes are counted."""

    def __init__(self, descriptor: int, outlet: Outlet) -> None:
        self._descriptor, self._outlet = descriptor, outlet

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def write(self, data: bytes) -> int:  # type: ignore[override]
        piece = bytes(data)
        try:
            written = os.write(self._descriptor, piece)
        except OSError:
            written = 0
        if written < len(piece):
            self._outlet.count_dropped(piece[written:])
        return len(piece)


class _RedirectedDescriptor:
    """A descriptor of the process, replaced by a pipe to an outlet.

    Args:
        numbers: descriptors that lead to the same file.
    """

    def __init__(self, numbers: tuple[int, ...]) -> None:
        self._numbers = numbers
        self._end = _apart(numbers[0])
        self.outlet = Outlet(os.dup(numbers[0]), 'whoever has the log')
        self._source, entrance = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(entrance, False)
        with suppress(OSError):
            fcntl.fcntl(entrance, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        for number in numbers:
            os.dup2(entrance, number)
        os.close(entrance)
        self._reader = threading.Thread(target=self._read, name='output', daemon=True)
        self._reader.start()

    @property
    def crash_descriptor(self) -> int:
        """Descriptor for the traceback of a fatal error, when no thread runs any more."""
        return self._end

    def close(self, deadline: float) -> None:
        """Write the rest until a deadline [s]; later output is written without a thread."""
        for number in self._numbers:
            os.dup2(self._end, number)
        self._reader.join(max(deadline - time.monotonic(), 0.0))
        self.outlet.drain(max(deadline - time.monotonic(), 0.0))

    def _read(self) -> None:
        rest = b''
        while data := os.read(self._source, 1 << 16):
            *lines, rest = (rest + data).split(b'\n')
            for line in lines:
                self._put(line)
            if len(rest) > MAX_LINE_BYTES:
                self._put(rest)
                rest = b''
        if rest:
            self._put(rest)

    def _put(self, line: bytes) -> None:
        self.outlet.put((b' ' if line.startswith(CONTROL_PREFIXES) else b'') + line + b'\n')


def _apart(number: int) -> int:
    """Return a separate non-blocking descriptor of the same pipe or terminal.

    The flag belongs to an open file: set on a duplicate, it would affect every user of that file.
    """
    mode = os.fstat(number).st_mode
    if stat.S_ISFIFO(mode) or stat.S_ISCHR(mode):
        flags = os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
        with suppress(OSError):
            return os.open(f'/proc/self/fd/{number}', flags)
    return os.dup(number)


_redirected: dict[int, _RedirectedDescriptor] = {}


def install() -> None:
    """Make the output of this process non-blocking until its end."""
    if _redirected or sys.stdout is None or sys.stderr is None:
        return
    if os.isatty(2):
        os.environ.setdefault('RCUTILS_COLORIZED_OUTPUT', '1')
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    if os.path.sameopenfile(1, 2):
        _redirected[1] = _redirected[2] = _RedirectedDescriptor((1, 2))
    else:
        _redirected[1], _redirected[2] = _RedirectedDescriptor((1,)), _RedirectedDescriptor((2,))
    faulthandler.enable(_redirected[2].crash_descriptor)
    for name, number in (('stdout', 1), ('stderr', 2)):
        raw = _Unblocked(number, _redirected[number].outlet)
        text = io.TextIOWrapper(raw, 'utf-8', 'backslashreplace', line_buffering=True)  # type: ignore[type-var]
        setattr(sys, name, text)
    atexit.register(close)


def announce(line: str) -> None:
    """Write a line that the launcher acts on, ahead of the log; see `CONTROL_PREFIXES`."""
    text = ' '.join(line.splitlines())
    if _redirected:
        _redirected[1].outlet.announce(f'{text}\n'.encode(errors='backslashreplace'))
    else:
        print(text, flush=True)


def announcing() -> bool:
    """Return whether an announced line waits for the launcher."""
    return bool(_redirected) and _redirected[1].outlet.announcing


def dropped() -> int:
    """Return how many lines of this process were dropped."""
    return sum(way.outlet.dropped for way in set(_redirected.values()))


def close() -> None:
    """Write what waits, at most for `FLUSH_TIMEOUT_S`; later output is written without a thread."""
    deadline = time.monotonic() + FLUSH_TIMEOUT_S
    for stream in (sys.stdout, sys.stderr):
        with suppress(ValueError):
            stream.flush()
    for way in set(_redirected.values()):
        way.close(deadline)
