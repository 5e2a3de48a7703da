"""Tests against the clock (marker `real_time`) are repeated where the machine failed, not the code.

Such a test is run again, at most twice, if it failed while a processor demonstrably stood still
(stand_still.py). A fault of the code fails each time.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

ATTEMPTS = 3
OUTPUT = pytest.StashKey[Path]()
WATCH = pytest.StashKey['subprocess.Popen[bytes]']()
REPEATED = pytest.StashKey[list[str]]()


def pytest_configure(config: pytest.Config) -> None:
    """Starts to watch the processors."""
    folder = Path(tempfile.mkdtemp(prefix='stand-still-'))
    config.stash[OUTPUT], config.stash[REPEATED] = folder / 'seen', []
    with config.stash[OUTPUT].open('wb') as file:
        command = [sys.executable, str(Path(__file__).with_name('stand_still.py'))]
        config.stash[WATCH] = subprocess.Popen(command, stdout=file)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Ends the watch."""
    config.stash[WATCH].kill()
    config.stash[WATCH].wait()
    shutil.rmtree(config.stash[OUTPUT].parent)


def stand_stills(output: Path, since: float) -> list[float]:
    """Lengths [s] of those that ended after a time of the monotonic clock [s]."""
    seen = [tuple(map(float, line.split())) for line in output.read_text().splitlines()]
    return [length for ended, length in seen if ended > since]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Runs a test against the clock until it says something about the code."""
    if item.get_closest_marker('real_time') is None:
        return None
    output, repeated = item.config.stash[OUTPUT], item.config.stash[REPEATED]
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(ATTEMPTS):
        if attempt:
            # Fixtures are made anew, those of the module included.
            item.session._setupstate.teardown_exact(None)
            item._initrequest()  # type: ignore[attr-defined]
        began = time.monotonic()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        stood = stand_stills(output, began)
        if not stood or not any(report.failed for report in reports):
            break
        worst = f'{len(stood)} stand-stills, the longest {1e3 * max(stood):.0f} ms'
        repeated.append(f'{item.nodeid}: failed with {worst}')
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says what was run more than once."""
    for line in terminalreporter.config.stash[REPEATED]:
        terminalreporter.write_line(f'while the machine stood still: {line}')
