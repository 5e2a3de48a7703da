"""Which tests are run, one after the other or side by side, and what none may leave behind."""

import contextlib
import gc
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from cutting_trainer.session.node_commands import discovery

# How long an example takes is a matter of the machine, and of what it must compile first.
settings.register_profile('all', deadline=None)
settings.register_profile('usual', deadline=None, max_examples=30)
settings.register_profile('quick', deadline=None, max_examples=10)

STAND_INS = Path(__file__).with_name('stand_ins')
PYTHON = f'python{sys.version_info.major}.{sys.version_info.minor}'
BUILT = pytest.StashKey[Path]()
PARTS = {'beside': set[str](), 'live': {'live'}, 'alone': {'alone', 'real_time'}}
"""Marks of the tests of each part; those without such a mark run beside others."""
APART = set[str]().union(*PARTS.values())
LEFT_OUT = {'quick': {'long', 'thorough', *APART}, 'usual': {'thorough'}, 'all': set[str]()}
"""Marks of the tests that a tier leaves out."""
MODULE_MARKS = re.compile(r'^pytestmark = (\[[^\]]*\]|.*)', re.MULTILINE)
PROCESS_ENDED = pytest.StashKey[bool]()
"""Whether a process ended that had tests to run."""
RUN = 'TRAINER_TEST_RUN'
"""Variable by which the processes that a test starts are known."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--part` and `--tier`: `trainer test` runs the parts of a tier, one after the other."""
    parser.addoption(
        '--part',
        choices=tuple(PARTS),
        help='only tests that may run beside others; or those with a graph, two at a time; '
        'or those that must run alone: they measure the clock, or what a processor does',
    )
    parser.addoption(
        '--tier',
        choices=tuple(LEFT_OUT),
        default='all',
        help='without a graph and what is long; or without what is thorough; or all',
    )


def pytest_configure(config: pytest.Config) -> None:
    """See to it that an interrupt is one, and that nodes find each other as those of a session do.

    Whoever starts the tests in the background of a shell script has them ignore SIGINT, and every
    process that they start with them. With shared memory, a process that is killed would stop
    those that talked to it, for seconds.
    """
    settings.load_profile(config.getoption('tier'))
    os.environ.update(discovery(os.environ))
    if config.getoption('part') == 'beside':  # the threads of one would wait for those of others
        os.environ['OPENBLAS_NUM_THREADS'] = '1'
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not config.getoption('numprocesses', None):  # else each worker has its own
        os.environ[RUN] = str(os.getpid())


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import a module of which tier or part leave out all: imports take seconds."""
    if collection_path.suffix != '.py' or not collection_path.is_file():
        return None
    text, part = collection_path.read_text(encoding='utf-8'), config.getoption('part')
    wanted = PARTS[part] if part else set()
    if wanted and not any(f'mark.{name}' in text for name in wanted):
        return True
    found = MODULE_MARKS.search(text)
    marks = set(re.findall(r'pytest\.mark\.(\w+)', found[1])) if found else set()
    left_out = LEFT_OUT[config.getoption('tier')] | (APART - PARTS[part] if part else set())
    return True if marks & left_out else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose tier and part; begin with the files that have most of the long tests.

    So no process waits for another at the end. Behind all are those that look at what others made.
    """
    long = Counter(item.path for item in items if item.get_closest_marker('long'))
    items.sort(key=lambda item: (item.path.name == 'test_every_bag.py', -long[item.path]))
    left_out = LEFT_OUT[config.getoption('tier')]
    part = config.getoption('part')
    chosen, others = [], []
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        own = next((name for name, those in PARTS.items() if marks & those), 'beside')
        (chosen if part in (None, own) and not marks & left_out else others).append(item)
    items[:] = chosen
    config.hook.pytest_deselected(items=others)


def pytest_collection_finish() -> None:
    """Freeze what collection made: looking through it stops the process for a tenth of a second.

    Tests that act as a device at 1 kHz run in this process.
    """
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_testnodedown(node: Any, error: object) -> None:
    """Note that a process has ended before its time: some tests were not run."""
    if error:
        node.config.stash[PROCESS_ENDED] = True


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where tests did not run, or where a process outlives the tests: it takes the machine
    from those to come.
    """
    deadline = time.monotonic() + 5.0
    while (found := started_here()) and time.monotonic() < deadline:
        time.sleep(0.1)
    for process, command in found.items():
        print(f'left running: {command}', file=sys.stderr)
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
    if session.config.stash.get(PROCESS_ENDED, False):  # tests that failed alone are run again
        session.exitstatus = pytest.ExitCode.INTERNAL_ERROR


def started_here() -> dict[int, str]:
    """Return processes that have the mark of this one, but helpers of Python's; their commands."""
    mark, found = f'{RUN}={os.getpid()}'.encode(), {}
    for folder in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):
            if mark in (folder / 'environ').read_bytes().split(b'\0'):
                command = (folder / 'cmdline').read_bytes().replace(b'\0', b' ').decode()
                if command and 'multiprocessing' not in command:
                    found[int(folder.name)] = command
    return found


@pytest.fixture(autouse=True)
def usual_priority() -> Iterator[None]:
    """Fail a test that leaves a real-time priority to the tests after it, and take it away.

    Two processes that are always busy inherited it, and no other got a turn: the tests never ended.
    """
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    yield
    after = os.sched_getscheduler(0), os.sched_getparam(0)
    if after != before:
        for thread in Path('/proc/self/task').iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread.name), *before)
    assert after == before, 'the test changed how the test process is scheduled'


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
