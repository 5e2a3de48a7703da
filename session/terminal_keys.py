"""Keys of a terminal, read without blocking."""

import contextlib
import os
import select
import sys
import termios
import tty
from typing import Any, Self

_LOCAL_FLAGS = 3
"""Index of the local flags in the attributes of `tcgetattr`."""


class Keys:
    """Read keys as they are pressed; a context manager. Without a terminal there are no keys.

    Nor are there any in the background of a terminal: the system would stop this process.

    Args:
        active: read the terminal.
    """

    def __init__(self, *, active: bool = True) -> None:
        self._file = sys.stdin.fileno() if active and sys.stdin and sys.stdin.isatty() else -1
        self._before: list[Any] = []

    def __enter__(self) -> Self:
        self._take()
        return self

    def __exit__(self, *_: object) -> None:
        if self._before and not _of_another(self._file):
            with contextlib.suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Return the keys pressed since the last call, '' for none."""
        if not self._take() or not select.select([self._file], [], [], 0.0)[0]:
            return ''
        try:
            return os.read(self._file, 64).decode(errors='replace')
        except OSError:  # the terminal was closed
            return ''

    def _take(self) -> bool:
        """Switch to single keys; return the success. A shell undoes it when it stops a job."""
        if self._file < 0 or _of_another(self._file):
            return False
        try:
            now = termios.tcgetattr(self._file)
            if now[_LOCAL_FLAGS] & termios.ICANON:
                self._before = self._before or now
                tty.setcbreak(self._file)
        except termios.error:  # the terminal was closed
            return False
        return True


def _of_another(terminal: int) -> bool:
    """Return whether this process runs in the background of its terminal."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # it is not the controlling terminal of this process
        return False
