"""Runs a test until it says something about the code; finds what tests leave running.

A test that wants the machine for itself is run again if it failed while a processor demonstrably
stood still (stand_still.py). One that fails so each time says nothing about the code: it is skipped
and named, unless there are more of them than a good run on a bad machine has. A fault of the code
fails wherever the machine is quiet.
"""

import contextlib
import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from stand_still import Watch

ATTEMPTS = 4
REPEATING = 600.0
"""[s] that repetitions may take in all."""
QUIET, PATIENCE = 2.0, 30.0
"""[s] without a stand-still that a repetition waits for, and how long it does."""
EXCUSED = 6
"""Occasions, at most, where a test is skipped because the machine never let it run."""
SUITE = 'TRAINER_TEST_SUITE'
"""Variable by which what a test starts is known."""


@dataclass
class Run:
    """What a run of the suite remembers.

    Attributes:
        watch: of the processors.
        path: of the file whose tests are run: their fixtures are as old as `watch.begin`.
        repeated: what was run again, and why.
        excused: files of tests that the machine never let run, and what they met.
        left: what tests left running.
        repeating: [s] that repetitions took.
    """

    watch: Watch
    path: Path = Path()
    repeated: list[str] = field(default_factory=list)
    excused: dict[Path, str] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)
    repeating: float = 0.0

    def lines(self) -> list[str]:
        """What was run more than once, what was not judged, and what was left running."""
        return [
            *(f'while the machine stood still: {line}' for line in self.repeated),
            *(
                f'not judged, the machine did not let it run: {path}: {met}'
                for path, met in self.excused.items()
            ),
            *(f'left running: {line}' for line in self.left),
        ]


def judged(item: pytest.Item, nextitem: pytest.Item | None, run: Run) -> list[pytest.TestReport]:
    """The reports of the last attempt at a test; failures as skipped where they are no verdict."""
    excuse = True
    for attempt in range(ATTEMPTS):
        began = time.monotonic()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if not any(report.failed for report in reports):
            return reports
        if reports[0].failed and item.path in run.excused:
            return skipped(reports, item, run.excused[item.path])  # the same fixture
        seen = run.watch.seen()
        if not seen.is_noted:
            return reports
        excuse &= seen.is_grave
        run.repeated.append(f'{item.nodeid}: failed with {seen}')
        took = time.monotonic() - began
        if attempt == ATTEMPTS - 1 or run.repeating + took > REPEATING:
            break
        # Fixtures are made anew, those of the module included.
        item.session._setupstate.teardown_exact(None)
        item._initrequest()  # type: ignore[attr-defined]
        run.watch.wait_for_quiet(QUIET, PATIENCE)
        run.watch.begin()
        run.repeating += took
    if not excuse or len(run.excused.keys() | {item.path}) > EXCUSED:
        return reports
    return skipped(reports, item, run.excused.setdefault(item.path, str(seen)))


def skipped(
    reports: list[pytest.TestReport], item: pytest.Item, met: str
) -> list[pytest.TestReport]:
    """Reports in which what failed is skipped, with what the test met."""
    for report in reports:
        if report.failed:
            report.outcome = 'skipped'
            reason = f'Skipped: the machine did not let it run: {met}'
            report.longrepr = (str(item.path), (item.location[1] or 0) + 1, reason)
    return reports


def left_running() -> list[str]:
    """Command lines of processes that tests have started and left; they are ended."""
    deadline = time.monotonic() + 5.0
    while (found := started_here()) and time.monotonic() < deadline:
        time.sleep(0.1)
    for process in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return list(found.values())


def started_here() -> dict[int, str]:
    """Processes that have the mark of this run, but for helpers of Python's own; their commands."""
    mark, found = f'{SUITE}={os.getpid()}'.encode(), {}
    for folder in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):
            if mark in (folder / 'environ').read_bytes().split(b'\0'):
                command = (folder / 'cmdline').read_bytes().replace(b'\0', b' ').decode()
                if command and 'multiprocessing' not in command:
                    found[int(folder.name)] = command
    return found
