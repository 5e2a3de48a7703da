"""Tests against the clock are repeated where the machine failed, not the code; tests that want the
machine for themselves are told from the others; what a file leaves running is found.

A test that wants the machine for itself is run again if it failed while a processor demonstrably
stood still (stand_still.py). One that fails so each time says nothing about the code: it is skipped
and named, unless there are more of them than a good run on a bad machine has. A fault of the code
fails wherever the machine is quiet.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings
from stand_still import Watch

# How long an example takes is a matter of the machine, and of what it must compile first.
settings.register_profile('trainer', deadline=None)
settings.load_profile('trainer')

STAND_INS = Path(__file__).with_name('stand_ins')
PYTHON = f'python{sys.version_info.major}.{sys.version_info.minor}'
ATTEMPTS = 4
REPEATING = 600.0
"""[s] that repetitions may take in all."""
QUIET, PATIENCE = 2.0, 30.0
"""[s] without a stand-still that a repetition waits for, and how long it does."""
EXCUSED = 6
"""Occasions, at most, where a test is skipped because the machine never let it run."""
SUITE = 'TRAINER_TEST_SUITE'
"""Variable by which what a test starts is known."""
RUN = pytest.StashKey['Run']()
BUILT = pytest.StashKey[Path]()


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


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds `--part`: `trainer test` runs the two parts one after the other."""
    parser.addoption(
        '--part',
        choices=('beside', 'alone'),
        help='only tests that may run beside others, or only those that must not: '
        'against the clock, over the network, with processes of their own',
    )


def pytest_configure(config: pytest.Config) -> None:
    """Starts to watch the processors, and sees to it that an interrupt is one.

    Whoever starts the suite in the background of a shell script has it ignore SIGINT, and every
    process that it starts with it.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    folder = Path(tempfile.mkdtemp(prefix='stand-still-'))
    config.stash[RUN] = Run(Watch(folder / 'seen'))
    config.add_cleanup(lambda: shutil.rmtree(folder))
    config.add_cleanup(config.stash[RUN].watch.end)
    os.environ[SUITE] = str(os.getpid())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Chooses the part; puts the tests that look at what all others have made behind them."""
    items.sort(key=lambda item: item.path.name == 'test_every_bag.py')
    if part := config.getoption('part'):
        others = [item for item in items if is_alone(item) != (part == 'alone')]
        items[:] = [item for item in items if is_alone(item) == (part == 'alone')]
        config.hook.pytest_deselected(items=others)


def is_alone(item: pytest.Item) -> bool:
    """Whether a test wants the machine for itself."""
    return any(item.get_closest_marker(name) for name in ('alone', 'real_time'))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Runs a test until it says something about the code."""
    if not is_alone(item):
        return None
    run = item.config.stash[RUN]
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    if item.path != run.path:
        run.path = item.path
        run.watch.begin()
    for report in judged(item, nextitem, run):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    if nextitem is None or nextitem.path != item.path:
        run.left += [f'{item.path.name}: {command}' for command in left_running()]
    return True


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


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A process that outlives its test is a fault: it takes the machine from the tests to come."""
    if session.config.stash[RUN].left:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says what was run more than once, what was not judged, and what was left running."""
    run = terminalreporter.config.stash[RUN]
    for line in run.repeated:
        terminalreporter.write_line(f'while the machine stood still: {line}')
    for path, met in run.excused.items():
        terminalreporter.write_line(f'not judged, the machine did not let it run: {path}: {met}')
    for line in run.left:
        terminalreporter.write_line(f'left running: {line}')


@pytest.fixture
def others_messages(
    pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, str]:
    """Environment in which crtk_msgs and omni_msgs are there, built here once if they are not."""
    if find_spec('crtk_msgs') and find_spec('omni_msgs'):
        return dict(os.environ)
    if shutil.which('colcon') is None:
        pytest.skip('colcon is not installed: with a sourced Jazzy, apt install ros-dev-tools')
    if BUILT not in pytestconfig.stash:
        pytestconfig.stash[BUILT] = built_stand_ins(tmp_path_factory.mktemp('stand_ins'))
    prefix = pytestconfig.stash[BUILT]
    added = {
        'PYTHONPATH': prefix / 'lib' / PYTHON / 'site-packages',
        'LD_LIBRARY_PATH': prefix / 'lib',
        'AMENT_PREFIX_PATH': prefix,
    }
    return os.environ | {
        name: os.pathsep.join([str(path), os.environ.get(name, '')]) for name, path in added.items()
    }


def built_stand_ins(workspace: Path) -> Path:
    """Builds the packages of test/stand_ins in a temporary workspace; returns its prefix."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith('PYTHON')}
    prefixes = clean.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    kept = [p for p in prefixes if not Path(p, 'share', 'cutting_trainer_msgs').exists()]
    clean['AMENT_PREFIX_PATH'] = clean['CMAKE_PREFIX_PATH'] = os.pathsep.join(kept)
    quick = ['--cmake-args', '-DCMAKE_C_FLAGS=-O0', '-DCMAKE_CXX_FLAGS=-O0']
    built = subprocess.run(
        ['colcon', 'build', '--merge-install', '--base-paths', str(STAND_INS), *quick],
        cwd=workspace,
        env=clean,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / 'install'
