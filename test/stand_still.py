"""Watches how long each processor gives no turn, and what a host takes of them.

As a program: every stand-still is a line: when it ended and how long it was, [s] of the monotonic
clock. It asks for a priority above all that is watched: what our own load delays is no stand-still.

A virtual machine may lose a processor for tens of milliseconds, and a deadline of 30 ms with it.
"""

import contextlib
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

PERIOD = 0.002
NOTED, GRAVE = 0.015, 0.050
"""[s] from which a stand-still explains that a test is late, and that a session is lost: after
30 ms without a command the arm lets go."""
STOLEN = 0.05
"""Share of the processors' time that explains as much."""


@dataclass(frozen=True)
class Disturbance:
    """What the machine kept from those who wanted to run.

    Attributes:
        stills: lengths [s] of the stand-stills.
        stolen: share of the processors' time that its host took.
    """

    stills: tuple[float, ...]
    stolen: float

    @property
    def is_noted(self) -> bool:
        return bool(self.stills) or self.stolen > STOLEN

    @property
    def is_grave(self) -> bool:
        return max(self.stills, default=0.0) > GRAVE or self.stolen > STOLEN

    def __str__(self) -> str:
        worst = f', the longest {1e3 * max(self.stills):.0f} ms' if self.stills else ''
        return f'{len(self.stills)} stand-stills{worst}, {100 * self.stolen:.0f} % stolen'


class Watch:
    """The program, as a process, and what it has seen.

    Args:
        output: file for its lines.
    """

    def __init__(self, output: Path) -> None:
        self._output = output
        with output.open('wb') as file:
            self._process = subprocess.Popen([sys.executable, __file__], stdout=file)
        self.begin()

    def begin(self) -> None:
        """Looks at what comes from now on."""
        self._began, self._times = time.monotonic(), processor_times()

    def seen(self) -> Disturbance:
        """What has been since `begin`."""
        total, stolen = (
            now - then for now, then in zip(processor_times(), self._times, strict=True)
        )
        return Disturbance(self._stills(self._began), stolen / total if total else 0.0)

    def wait_for_quiet(self, quiet: float, limit: float) -> None:
        """Returns when none stood still for `quiet` [s], or after the limit [s]."""
        deadline = time.monotonic() + limit
        time.sleep(quiet)
        while self._stills(time.monotonic() - quiet) and time.monotonic() < deadline:
            time.sleep(0.1)

    def end(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()

    def _stills(self, since: float) -> tuple[float, ...]:
        whole, _, _ = self._output.read_text().rpartition('\n')
        lines = [tuple(map(float, line.split())) for line in whole.splitlines()]
        return tuple(length for ended, length in lines if ended > since)


def processor_times() -> tuple[int, int]:
    """What all processors have passed since the machine's start, and what its host took of it."""
    with Path('/proc/stat').open() as file:
        passed = [int(word) for word in file.readline().split()[1:9]]
    return sum(passed), passed[7]


def watch(processor: int) -> None:
    """Prints the stand-stills of a processor."""
    os.sched_setaffinity(0, {processor})
    last = time.monotonic()
    while True:
        time.sleep(PERIOD)
        now = time.monotonic()
        if now - last > PERIOD + NOTED:
            os.write(1, f'{now} {now - last}\n'.encode())  # whole, whoever else writes
        last = now


def main() -> None:
    """Watches every processor until it is killed."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
    for processor in os.sched_getaffinity(0):
        threading.Thread(target=watch, args=(processor,), daemon=True).start()
    threading.Event().wait()


if __name__ == '__main__':
    main()
