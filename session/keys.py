"""Single keys from a terminal, without waiting."""

import os
import select
import sys
import termios
import tty
from types import TracebackType
from typing import Any, Self


class Keys:
    """Reads keys as they are pressed; a context manager. Where there is no terminal, none come.

    Nor do they where the terminal belongs to another program: the system would stop this one.
    """

    def __init__(self) -> None:
        file = sys.stdin.fileno() if sys.stdin and sys.stdin.isatty() else -1
        self._file = -1 if file < 0 or _of_another(file) else file
        self._before: list[Any] = []

    def __enter__(self) -> Self:
        if self._file >= 0:
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file >= 0:
            termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """What was pressed since the last call, '' for nothing."""
        if self._file < 0 or not select.select([self._file], [], [], 0.0)[0]:
            return ''
        return os.read(self._file, 64).decode(errors='replace')


def _of_another(terminal: int) -> bool:
    """Whether this process runs in the background of its terminal."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # it is not the one that this process was started from
        return False
