"""Tests against the clock (marker `real_time`) are repeated where the machine failed, not the code;
tests that want the machine for themselves are told from the others; and a fixture that more than
one file uses.

Such a test is run again, at most twice, if it failed while a processor demonstrably stood still
(stand_still.py). A fault of the code fails each time.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings

# How long an example takes is a matter of the machine, and of what it must compile first.
settings.register_profile('trainer', deadline=None)
settings.load_profile('trainer')

STAND_INS = Path(__file__).with_name('stand_ins')
PYTHON = f'python{sys.version_info.major}.{sys.version_info.minor}'
ATTEMPTS = 3
OUTPUT = pytest.StashKey[Path]()
WATCH = pytest.StashKey['subprocess.Popen[bytes]']()
REPEATED = pytest.StashKey[list[str]]()
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
    process that it starts with it.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    folder = Path(tempfile.mkdtemp(prefix='stand-still-'))
    config.stash[OUTPUT], config.stash[REPEATED] = folder / 'seen', []
    with config.stash[OUTPUT].open('wb') as file:
        command = [sys.executable, str(Path(__file__).with_name('stand_still.py'))]
        config.stash[WATCH] = subprocess.Popen(command, stdout=file)


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


def pytest_unconfigure(config: pytest.Config) -> None:
    """Ends the watch."""
    config.stash[WATCH].kill()
    config.stash[WATCH].wait()
    shutil.rmtree(config.stash[OUTPUT].parent)


def stand_stills(output: Path, since: float) -> list[float]:
    """Lengths [s] of those that ended after a time of the monotonic clock [s]."""
    whole, _, _ = output.read_text().rpartition('\n')
    seen = [tuple(map(float, line.split())) for line in whole.splitlines()]
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
