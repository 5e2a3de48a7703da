"""One node as a process of the operating system: its command, its lines, its log, its end."""

import contextlib
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

TAIL = 6
LONGEST_LINE = 1 << 16
_BOUND = (sys.executable, '-I', '-S', str(Path(__file__).with_name('child.py')))


@dataclass(frozen=True)
class NodeCommand:
    """One node to run.

    Attributes:
        name: of the node, as in its line `ready: NAME`.
        argv: program and arguments.
        records: it keeps the record of the others: it starts before them, ends after them, and is
            asked to end, not killed, when the launcher dies or the user is in a hurry.
        converses: it asks for things by lines `message: ...`, and reads answers on standard input.
        grace: [s] that it has to end after SIGINT, and half of it again after SIGTERM.
        again: further arguments for a start in the place of one that died.
    """

    name: str
    argv: tuple[str, ...]
    records: bool = False
    converses: bool = False
    grace: float = 5.0
    again: tuple[str, ...] = ()


class _Log:
    """Lines of one node, kept until the folder that they belong into exists: its owner makes it.

    A line that comes again and again is written once, with how often: a library that complains of
    each message writes as many as come.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting: list[str] = []
        self._file: BinaryIO | None = None
        self._last, self._again = '', 0

    def write(self, line: str) -> None:
        if line == self._last:
            self._again += 1
            return
        self._tell_again()
        self._last = line
        self._waiting.append(line)
        if self._path.parent.parent.is_dir():
            self.flush()

    def flush(self) -> None:
        if self._waiting and self._file is None:
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open('ab', buffering=0)
            except OSError:
                return  # where no bag could be made, no log can be kept; the recorder says why
        if self._file is not None:
            with suppress(OSError):  # the disk is full: the recorder says so, the session goes on
                self._file.write(''.join(f'{line}\n' for line in self._waiting).encode())
            self._waiting.clear()

    def _tell_again(self) -> None:
        if self._again:
            self._waiting.append(f'(the same {self._again} times more)')
            self._again = 0

    def close(self) -> None:
        self._tell_again()
        self.flush()
        if self._file is not None:
            self._file.close()


class NodeProcess:
    """A node that was started, and what it has said so far.

    Attributes:
        tail: the last lines that it wrote.
        ready, done: it has said so.
        asked_to_end: its end from now on is no accident.
        silent: it has closed its output.
        warnings: how many it has given.

    Args:
        command: what to run.
        log: file for its lines.
        environment: of the process.
    """

    def __init__(self, command: NodeCommand, log: Path, environment: Mapping[str, str]) -> None:
        self.command = command
        self.log = _Log(log)
        self.tail: deque[str] = deque(maxlen=TAIL)
        self.ready = self.done = self.asked_to_end = self.silent = False
        self.warnings = 0
        self._rest = b''
        orphaned = signal.SIGTERM if command.records else signal.SIGKILL
        self.process = subprocess.Popen(
            [*_BOUND, str(os.getpid()), str(int(orphaned)), *command.argv],
            stdin=subprocess.PIPE if command.converses else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            process_group=0,
        )
        assert self.process.stdout is not None
        self.pipe = self.process.stdout
        os.set_blocking(self.pipe.fileno(), False)
        if self.process.stdin is not None:
            os.set_blocking(self.process.stdin.fileno(), False)

    @property
    def name(self) -> str:
        return self.command.name

    @property
    def alive(self) -> bool:
        return self.process.returncode is None

    def reap(self) -> bool:
        """Whether the process has ended since the last call; takes what it started along."""
        if not self.alive:
            return False
        seen = os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        if seen is None:
            return False
        self.send_group(signal.SIGKILL)
        self.process.wait()
        return True

    def answer(self, text: str) -> None:
        """Writes a line to a node that converses, as long as it lives and listens."""
        if self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError, BlockingIOError):
                os.write(self.process.stdin.fileno(), f'{text}\n'.encode())

    def close(self) -> None:
        """Closes what belongs to a process that has ended."""
        self.log.close()
        self.pipe.close()
        if self.process.stdin is not None:
            self.process.stdin.close()

    def send(self, number: signal.Signals) -> None:
        if self.alive:
            self.process.send_signal(number)

    def send_group(self, number: signal.Signals) -> None:
        """To the node and whatever it started; only before it was reaped is the number its own."""
        try:
            os.killpg(self.process.pid, number)
        except (ProcessLookupError, PermissionError):
            self.send(number)

    def lines(self) -> Iterator[str]:
        """The complete lines that have come in."""
        while True:
            try:
                data = os.read(self.pipe.fileno(), 1 << 16)
            except BlockingIOError:
                return
            *lines, self._rest = (self._rest + data).split(b'\n')
            if self._rest and (not data or len(self._rest) > LONGEST_LINE):
                lines, self._rest = [*lines, self._rest], b''
            for line in lines:
                yield line.decode(errors='replace').rstrip()
            if not data:
                self.silent = True
                return


def is_warning(line: str) -> bool:
    """Whether a node's line is one that the user should see at once."""
    head = line[:60].lower()
    return head.startswith(('warning:', 'error:')) or any(
        level in head for level in ('[warn]', '[error]', '[fatal]')
    )
