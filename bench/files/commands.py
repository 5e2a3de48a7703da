"""Commands of the trainer on files, each in a process: status, output, memory, time."""

import gc
import os
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cutting_trainer.cli import main as cli

MAX_MEMORY_BYTES = 8 << 30
"""Limit of the address space of a command [bytes]."""
READING: dict[str, Callable[[Path, Path], list[str]]] = {
    'report': lambda bag, folder: ['report', str(bag), '-o', str(folder / 'report.html')],
    'picture': lambda bag, folder: ['picture', str(bag), '-o', str(folder / 'picture.png')],
    'export tables': lambda bag, folder: ['export', str(bag), str(folder / 'tables')],
    'export mesh': lambda bag, folder: ['export', str(bag), str(folder / 'mesh.vtk')],
    'resimulate': lambda bag, _: ['resimulate', str(bag)],
    'repair': lambda bag, _: ['repair', str(bag)],
}
"""Arguments of the commands that read a bag, by name; the second folder is for output."""


@dataclass(frozen=True)
class CommandResult:
    """Result of a command.

    Attributes:
        status: of its exit; 77 with a traceback, negative where a signal ended it.
        said: on both outputs.
        memory: peak in addition to that of a copy of this process that does nothing [MB].
        seconds: for which it ran.
    """

    status: int
    said: str
    memory: float
    seconds: float

    @property
    def one_sentence(self) -> bool:
        """Whether it rejected the file in one short line."""
        lines = self.said.strip().splitlines()
        return self.status == 2 and len(lines) == 1 and len(lines[0]) < 1000


def run(arguments: Sequence[str], timeout: int = 60) -> CommandResult:
    """Run a command in a copy of this process.

    Args:
        arguments: of the command line.
        timeout: after which it is ended by SIGALRM [s].
    """
    import signal

    with tempfile.TemporaryFile() as out:
        before, began = _idle_peak(), time.monotonic()
        child = os.fork()
        if child == 0:
            gc.freeze()  # what this process left of ROS cannot be collected without its threads
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(timeout)
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
            os._exit(_status(list(arguments)))
        _, status, usage = os.wait4(child, 0)
        out.seek(0)
        said = out.read().decode(errors='replace')
    memory = (usage.ru_maxrss - before) * 1024 / 1e6
    return CommandResult(os.waitstatus_to_exitcode(status), said, memory, time.monotonic() - began)


def _idle_peak() -> int:
    """Return the peak memory of a copy of this process that does nothing [KiB]."""
    child = os.fork()
    if child == 0:
        os._exit(0)
    return os.wait4(child, 0)[2].ru_maxrss


def _status(arguments: list[str]) -> int:
    sys.stdout, sys.stderr = (open(n, 'w', closefd=False) for n in (1, 2))  # noqa: SIM115
    try:
        cli.main(arguments)
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0
    except BaseException:  # any error: the process must end here
        traceback.print_exc()
        code = 77
    sys.stdout.flush()
    sys.stderr.flush()
    return code
