"""Programs of the trainer that run beside a session for its page: attempts, and replays of them."""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.parent_death_signal import bound
from cutting_trainer.viewer.access_control import TOKEN_VARIABLE, link

_MAX_ROWS = 100
"""Attempts on the page."""
_SHOWN = ('subject', 'exercise', 'attempt', 'begun', 'state', 'points', 'passed')
_NICENESS = 10
_MAX_PORT = 65535
_CONNECT_TIMEOUT_S = 0.05
_END_TIMEOUT_S = 5.0


class _Program:
    """A command of the trainer, at a low priority, which ends with this process.

    Args:
        words: command and its options.
    """

    def __init__(self, *words: str) -> None:
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  a pipe that nobody reads stops it
        self._process = subprocess.Popen(
            bound(signal.SIGTERM, sys.executable, '-m', 'cutting_trainer.cli', *words),
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.DEVNULL,
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)

    @property
    def status(self) -> int | None:
        """Return the exit status; None: it runs."""
        return self._process.poll()

    def output(self) -> bytes:
        """Return the standard output so far."""
        self._output.seek(0)
        return self._output.read()

    def end(self) -> None:
        """End it, and wait for its end."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._output.close()


class AttemptList:
    """The list of attempts, read by another process: scoring a new bag takes seconds."""

    def __init__(self) -> None:
        self._reader: _Program | None = None
        self._again = False
        self._bags: dict[str, str] = {}

    def refresh(self) -> None:
        """Begin to read; during a reading, once more after it."""
        if self._reader is None:
            self._reader = _Program('attempts', '--json')
        else:
            self._again = True

    def news(self) -> list[dict[str, Any]] | None:
        """Return the rows for the page, newest first, once after each reading; else None.

        Raises:
            SessionError: the attempts cannot be read.
        """
        if self._reader is None or (status := self._reader.status) is None:
            return None
        output = self._reader.output()
        self._reader.end()
        self._reader = None
        if self._again:
            self._again = False
            self.refresh()
        if status:
            raise SessionError('the attempts cannot be read: ./trainer attempts says why')
        rows = [row for row in json.loads(output) if row['state'] != 'bag is gone']
        rows = rows[::-1][:_MAX_ROWS]
        self._bags = {Path(row['bag']).name: row['bag'] for row in rows}
        return [{'bag': Path(row['bag']).name} | {key: row[key] for key in _SHOWN} for row in rows]

    def bag(self, name: str) -> str:
        """Return the folder of a bag of the list.

        Raises:
            SessionError: the list has none of that name.
        """
        if name not in self._bags:
            raise SessionError('the requested attempt is not one of those on offer')
        return self._bags[name]

    def end(self) -> None:
        """End the reading."""
        if self._reader is not None:
            self._reader.end()


@dataclass(frozen=True)
class Address:
    """Where the page of a session is served.

    Attributes:
        host: listening address.
        port: of the session; replays have the next one; 0: each has a free one.
        names: host names under which the page is served.
    """

    host: str
    port: int
    names: tuple[str, ...] = ()

    def beside(self) -> int:
        """Return the port of replays."""
        if self.port:
            return self.port + (1 if self.port < _MAX_PORT else -1)
        family = socket.AF_INET6 if ':' in self.host else socket.AF_INET
        with socket.create_server((self.host, 0), family=family) as free:
            return int(free.getsockname()[1])


class ReplayServer:
    """Serves the replay that was asked for last, beside the session and with its token.

    Args:
        address: of the session's page.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._program: _Program | None = None
        self._number, self._port = 0, 0
        self._starts = False

    def show(self, bags: Sequence[str], number: int) -> None:
        """Serve one bag, or two side by side.

        Args:
            bags: their folders.
            number: of the request.
        """
        self.end()
        self._number, self._port = number, self._address.beside()
        host, names = self._address.host, self._address.names
        words = ['--bag', bags[0], *(('--beside', bags[1]) if len(bags) > 1 else ())]
        words += ['--host', host, '--port', str(self._port)]
        words += [word for name in names for word in ('--allow-host', name)]
        self._program, self._starts = _Program('view', *words), True

    def news(self) -> tuple[int, str] | None:
        """Return number and link of the replay, once it is served; else None.

        Raises:
            SessionError: it could not be served.
        """
        if self._program is None or not self._starts:
            return None
        if self._program.status is not None:
            self._starts = False
            raise SessionError(
                'the replay could not be served: ./trainer view --bag BAG says why; '
                f'it needs port {self._port}'
            )
        if not self._is_served():
            return None
        self._starts = False
        token = os.environ[TOKEN_VARIABLE]
        return self._number, link(self._address.host, self._port, self._address.names, token)

    def _is_served(self) -> bool:
        own = {'0.0.0.0': '127.0.0.1', '::': '::1'}
        host = own.get(self._address.host, self._address.host)
        try:
            with socket.create_connection((host, self._port), _CONNECT_TIMEOUT_S):
                return True
        except OSError:
            return False

    def end(self) -> None:
        """End the replay that is served."""
        if self._program is not None:
            self._program.end()
            self._program = None
