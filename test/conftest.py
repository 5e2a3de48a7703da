"""Tests against the clock are repeated where the machine failed (repetition.py), and run alone."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings
from repetition import SUITE, Run, judged, left_running
from stand_still import Watch

from session.graph import discovery

# How long an example takes is a matter of the machine, and of what it must compile first.
settings.register_profile('trainer', deadline=None)
settings.load_profile('trainer')

STAND_INS = Path(__file__).with_name('stand_ins')
PYTHON = f'python{sys.version_info.major}.{sys.version_info.minor}'
RUN = pytest.StashKey['Run']()
BUILT = pytest.StashKey[Path]()


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
    process that it starts with it. Nodes of the tests find others as those of a session do: with
    shared memory, a process that is killed would stop those that talked to it, for seconds.
    """
    os.environ.update(discovery(os.environ))
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


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A process that outlives its test is a fault: it takes the machine from the tests to come."""
    if session.config.stash[RUN].left:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says what was run more than once, what was not judged, and what was left running."""
    for line in terminalreporter.config.stash[RUN].lines():
        terminalreporter.write_line(line)


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
