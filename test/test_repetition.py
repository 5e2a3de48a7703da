"""A test against the clock is repeated where the machine stood still, and only there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from live import ROOT

SEVERAL = """
import pytest, time
from pathlib import Path

@pytest.fixture(scope='module')
def runs():
    path = Path({count!r})
    path.write_text(path.read_text() + 'x')
    return path

@pytest.mark.real_time
def test_timing(request, runs):
    output = [v for v in request.config.stash._storage.values() if isinstance(v, Path)][0]
    if {still}:
        with output.open('a') as file:
            file.write(f'{{time.monotonic()}} 0.05\\n')
    assert len(runs.read_text()) >= {passes}
"""


@pytest.mark.parametrize(
    ('still', 'passes', 'runs', 'outcome'),
    [(False, 1, 1, 0), (False, 2, 1, 1), (True, 2, 2, 0), (True, 9, 3, 1)],
)
def test_failure_counts_unless_a_processor_stood_still(
    still: bool, passes: int, runs: int, outcome: int, tmp_path: Path
) -> None:
    count = tmp_path / 'count'
    count.write_text('')
    path = tmp_path / 'test_it.py'
    path.write_text(SEVERAL.format(count=str(count), still=still, passes=passes))
    for name in ('conftest.py', 'stand_still.py'):
        (tmp_path / name).write_text(
            (ROOT / 'test' / name).read_text().replace('NOTED = 0.015', 'NOTED = 60.0')
        )
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', str(path)],
        cwd=tmp_path,
        env=os.environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == outcome, done.stdout
    assert len(count.read_text()) == runs
    assert done.stdout.count('while the machine stood still') == (runs if still else 0) - (
        1 if still and outcome == 0 else 0
    )
