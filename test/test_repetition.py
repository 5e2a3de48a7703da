"""A test against the clock is repeated where the machine stood still, and only there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from live import ROOT

HEAD = """
import pytest, subprocess, sys, time
from pathlib import Path

pytestmark = pytest.mark.real_time

@pytest.fixture(scope='module')
def runs(request):
    path = Path(__file__).with_name('count')
    path.write_text((path.read_text() if path.exists() else '') + 'x')
    (run,) = [v for v in request.config.stash._storage.values() if hasattr(v, 'watch')]
    if {still}:
        with run.watch._output.open('a') as file:
            file.write(f'{{time.monotonic()}} {still}\\n')
    if {lost}:
        raise AssertionError('the session was lost')
    return len(path.read_text())
"""
TIMING = """
def test_what_the_fixture_is_for(runs):
    pass

def test_timing(runs):
    assert runs >= {passes}
"""
LEAVES = """
def test_it():
    command = [sys.executable, '-c', 'import time; time.sleep(600)']
    print(subprocess.Popen(command, start_new_session=True).pid)
"""


def suite(folder: Path, text: str, **values: object) -> 'subprocess.CompletedProcess[str]':
    """Runs a file of tests as those of this folder are, on a machine that is quiet for them."""
    (folder / 'test_it.py').write_text(text.format(**values))
    for name in ('conftest.py', 'repetition.py', 'stand_still.py'):
        text = (ROOT / 'test' / name).read_text()
        for said, instead in (
            ('PERIOD + NOTED', '60.0'),
            ('STOLEN = 0.05', 'STOLEN = 9.0'),
            ('QUIET, PATIENCE = 2.0', 'QUIET, PATIENCE = 0.0'),
        ):
            text = text.replace(said, instead)
        (folder / name).write_text(text)
    return subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-s', '-p', 'no:cacheprovider', 'test_it.py'],
        cwd=folder,
        env=os.environ,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ('still', 'passes', 'runs', 'outcome'),
    [
        (0, 1, 1, '2 passed'),
        (0, 2, 1, '1 failed, 1 passed'),
        (0.05, 2, 2, '2 passed'),
        (0.05, 9, 4, '1 failed, 1 passed'),
        (0.2, 9, 4, '1 passed, 1 skipped'),
    ],
)
def test_failure_counts_unless_a_processor_stood_still(
    still: float, passes: int, runs: int, outcome: str, tmp_path: Path
) -> None:
    done = suite(tmp_path, HEAD + TIMING, still=still, passes=passes, lost=False)
    assert outcome in done.stdout
    assert done.returncode == ('failed' in outcome)
    assert len((tmp_path / 'count').read_text()) == runs
    again = runs if passes == 9 else runs - 1
    assert done.stdout.count('while the machine stood still') == again
    assert done.stdout.count('not judged') == ('skipped' in outcome)


@pytest.mark.parametrize(('still', 'outcome'), [(0, '2 errors'), (0.2, '2 skipped')])
def test_a_lost_session_is_tried_again_for_the_first_of_its_tests_only(
    still: float, outcome: str, tmp_path: Path
) -> None:
    done = suite(tmp_path, HEAD + TIMING, still=still, passes=1, lost=True)
    assert outcome in done.stdout
    assert done.stdout.count('while the machine stood still') == (4 if still else 0)


def test_a_process_that_outlives_its_file_is_found_and_ended(tmp_path: Path) -> None:
    done = suite(tmp_path, HEAD + LEAVES, still=0, lost=False)
    assert '1 passed' in done.stdout and done.returncode == 1
    assert 'left running: test_it.py: ' in done.stdout
    command = Path('/proc', done.stdout.split()[0], 'cmdline')
    assert not (command.exists() and command.read_bytes())
