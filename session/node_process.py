"""Process of one node: its command, its output, its log, its end."""

import contextlib
import json
import os
import signal
import subprocess
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cutting_trainer.node_common.output import HEARTBEAT, Outlet
from cutting_trainer.session.parent_death_signal import bound
from cutting_trainer.session.processors import Work

MAX_TAIL_LINES = 6
_CRASH = 'Fatal Python error'
"""How `faulthandler` begins."""
MAX_LINE_BYTES = 1 << 16
CUT_OFF = f' (cut off: longer than {MAX_LINE_BYTES} bytes)'
MAX_READS = 16
HEARTBEAT_PERIOD_S = 0.5
LOG_CLOSE_TIMEOUT_S = 2.0
"""Time [s] that the end of a node waits for the disk to write the last lines of its log."""


@dataclass(frozen=True)
class NodeCommand:
    """Command of a node.

    Attributes:
        name: name of the node with its namespace, as in its line `ready: NAME`.
        argv: program and arguments.
        records: it records the others. It starts before them and ends after them. It gets SIGTERM,
            not SIGKILL, when the launcher dies, and keeps its grace after a second interrupt.
        converses: it sends requests in lines `message: ...`, and reads answers on standard input.
        grace: time to end after SIGINT [s], and half of it again after SIGTERM.
        restart_arguments: further arguments of a restart after a death.
        e_stop_arguments: further arguments of a start while E-STOP is pressed. A node with such
            arguments reads the line `e_stop` on standard input, and writes `e_stop: pressed` or
            `e_stop: released`.
        has_heartbeat: it writes heartbeats once it is ready.
        work: what it does, by which it may get processors of its own.
    """

    name: str
    argv: tuple[str, ...]
    records: bool = False
    converses: bool = False
    grace: float = 5.0
    restart_arguments: tuple[str, ...] = ()
    e_stop_arguments: tuple[str, ...] = ()
    has_heartbeat: bool = False
    work: Work = 'other'


class _Log:
    """Log of one node, held in memory until the parent of its folder exists.

    A repeated line is written once, with the number of repetitions: some libraries write a line for
    each message. A thread writes, so that a disk that hangs delays nothing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting: list[str] = []
        self._outlet: Outlet | None = None
        self._last, self._again = '', 0

    def write(self, line: str) -> None:
        if line == self._last:
            self._again += 1
            return
        self._write_repetitions()
        self._last = line
        self._waiting.append(line)
        if self._path.parent.parent.is_dir():
            self.flush()

    def flush(self) -> None:
        if self._waiting and self._outlet is None:
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
                self._outlet = Outlet(os.open(self._path, flags, 0o666), 'the disk')
            except OSError:
                return  # there is no bag, so there is no folder for logs; the recorder reports it
        if self._outlet is not None:
            self._outlet.put(''.join(f'{line}\n' for line in self._waiting).encode())
            self._waiting.clear()

    def _write_repetitions(self) -> None:
        if self._again:
            self._waiting.append(f'(the same {self._again} times more)')
            self._again = 0

    def close(self) -> None:
        self._write_repetitions()
        self.flush()
        if self._outlet is not None:
            self._outlet.close(LOG_CLOSE_TIMEOUT_S)
            self._outlet = None


class NodeProcess:
    """A node that was started, and the state that it has reported.

    Attributes:
        tail: last lines of its output; those of a crash from its first on.
        ready, done: it has reported so.
        asked_to_end: its end is expected from now on.
        output_closed: it has closed its output.
        warnings: number of its warnings.
        unread: number of its lines `message: ...` that could not be read.
        beat: time of its last heartbeat, on the supervisor's clock [s].
        hung: it was killed because its heartbeat stopped.

    Args:
        command: command of the node.
        log: file of its log.
        environment: environment of the process.
    """

    def __init__(self, command: NodeCommand, log: Path, environment: Mapping[str, str]) -> None:
        self.command = command
        self.log = _Log(log)
        self.tail: deque[str] = deque(maxlen=MAX_TAIL_LINES)
        self.ready = self.done = self.asked_to_end = self.output_closed = False
        self.warnings = self.unread = 0
        self.beat = 0.0
        self.hung = False
        self._rest = b''
        self._skipping = False
        beating = {HEARTBEAT: f'{HEARTBEAT_PERIOD_S:g}'} if command.has_heartbeat else {}
        orphaned = signal.SIGTERM if command.records else signal.SIGKILL
        self.process = subprocess.Popen(
            bound(orphaned, *command.argv),
            stdin=subprocess.PIPE
            if command.converses or command.e_stop_arguments
            else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=dict(environment) | beating,
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
        """Return whether the process has ended since the last call; kill its children if so."""
        if not self.alive:
            return False
        seen = os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        if seen is None:
            return False
        self.send_group(signal.SIGKILL)
        self.process.wait()
        return True

    def answer(self, text: str) -> None:
        """Write a line to a node that converses, if it runs and reads."""
        if self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError, BlockingIOError):
                os.write(self.process.stdin.fileno(), f'{text}\n'.encode())

    def close(self) -> None:
        """Close the log and the pipes of a process that has ended."""
        self.log.close()
        self.pipe.close()
        if self.process.stdin is not None:
            self.process.stdin.close()

    def send(self, number: signal.Signals) -> None:
        if self.alive:
            self.process.send_signal(number)

    def send_group(self, number: signal.Signals) -> None:
        """Send a signal to the process group of the node. Call it before the node is reaped: the
        process id may be reused later.
        """
        try:
            os.killpg(self.process.pid, number)
        except (ProcessLookupError, PermissionError):
            self.send(number)

    @property
    def crashed(self) -> bool:
        """Return whether the tail is the report of a crash."""
        return bool(self.tail) and self.tail[0].startswith(_CRASH)

    def remember(self, line: str) -> None:
        """Put a line of the output into the tail."""
        if not line or (self.crashed and len(self.tail) == MAX_TAIL_LINES):
            return
        if line.startswith(_CRASH):
            self.tail.clear()
        self.tail.append(line)

    def lines(self) -> Iterator[str]:
        """Yield the complete lines that have arrived, and the beginning of a line that is too long.

        One call reads at most `MAX_READS` times: a node that floods must not delay the others.
        """
        for _ in range(MAX_READS):
            try:
                data = os.read(self.pipe.fileno(), 1 << 16)
            except BlockingIOError:
                return
            *lines, self._rest = (self._rest + data).split(b'\n')
            for line in lines:
                if not self._skipping:
                    yield _text(line)
                self._skipping = False
            if self._rest and not self._skipping and (not data or len(self._rest) > MAX_LINE_BYTES):
                yield _text(self._rest)
                self._skipping = True
            if self._skipping:  # up to the end of the long line
                self._rest = b''
            if not data:
                self.output_closed = True
                return


def _text(line: bytes) -> str:
    text = line[:MAX_LINE_BYTES].decode(errors='replace').rstrip()
    return text + CUT_OFF if len(line) > MAX_LINE_BYTES else text


def parse_message(text: str) -> dict[str, Any] | None:
    """Return the content of a line `message: TEXT`; None where it cannot be read."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def is_warning(line: str) -> bool:
    """Return whether a line is a warning or an error, which the user should see at once."""
    head = line[:60].lower()
    return head.startswith(('warning:', 'error:')) or any(
        level in head for level in ('[warn]', '[error]', '[fatal]')
    )


def unready_sentence(waiting: Sequence[NodeProcess], timeout: float) -> str:
    """Return a sentence on nodes that were not ready in `timeout` [s], with their last lines."""
    said = '; '.join(
        f'{node.name} said last: {" / ".join(node.tail) or "nothing"}' for node in waiting
    )
    names = ' and '.join(node.name for node in waiting)
    hint = 'is the machine busy? see ./trainer doctor'
    return f'{names} not ready within {timeout:g} s ({hint}); {said}'
