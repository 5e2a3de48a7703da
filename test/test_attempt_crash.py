"""Claims about an attempt in which everything dies at once: it is listed as broken off."""

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live import two_presses, write_scene
from page_user import ROOT, View, sessions

from bench.common.processes import children_of
from bench.page.open_page import OpenPage

pytestmark = [pytest.mark.thorough, pytest.mark.real_time]

SUBJECT = f'test-{secrets.token_hex(4)}'
EXERCISE = 'vessel'
NODES_TIMEOUT_S = 240.0
RECORDED_S = 3.0
OVER = [0.018, 0.0, 0.030]
"""[m] where the hand goes: above the tissue."""


def trainer(*words: str) -> str:
    """Return the standard output of a command, which has to end in order."""
    command = [sys.executable, '-m', 'cutting_trainer.cli', *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def attempts() -> list[dict[str, Any]]:
    """The attempts of this test, oldest first."""
    rows = json.loads(trainer('attempts', '--json', '--subject', SUBJECT))
    return sorted(rows, key=lambda row: row['attempt'])


def begin(page: OpenPage) -> None:
    """Begins an attempt at a page, and moves the hand in it."""
    page.wait(lambda: {'hello', 'session'} <= set(page.values), 'the page', NODES_TIMEOUT_S)
    page.ask('attempt', scene=EXERCISE, subject=SUBJECT)
    recording = 'the recording'
    page.wait(lambda: session(page)['recording'].startswith(EXERCISE), recording, NODES_TIMEOUT_S)
    page.wait(lambda: not session(page)['busy'], 'the nodes', NODES_TIMEOUT_S)
    page.ask('start')
    page.wait(lambda: page.values['state']['state'] == 'ENABLED', 'the hand', NODES_TIMEOUT_S)
    until = time.monotonic() + RECORDED_S
    while time.monotonic() < until:
        page.ask('guide', position=OVER, wxyz=[1.0, 0.0, 0.0, 0.0])
        time.sleep(0.1)


def session(page: OpenPage) -> dict[str, Any]:
    return dict(page.values['session'])


def below(process: int) -> list[int]:
    """The processes that one has begun, and those that they have."""
    children = children_of(process)
    return [*children, *(each for child in children for each in below(child))]


def die(view: View) -> None:
    """Kills launcher and nodes at once, as a computer does that loses its power."""
    os.kill(view.process.pid, signal.SIGSTOP)  # it shall see none of them die
    for process in [*below(view.process.pid), view.process.pid]:
        os.kill(process, signal.SIGKILL)
    view.process.wait(10)


@pytest.fixture(scope='module')
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Attempts after one that died, and after the next one, which a person ended."""
    known, found = sessions(), dict[str, Any]()
    try:
        for ending in ('died', 'ended'):
            folder = tmp_path_factory.mktemp(ending)
            scene = write_scene(folder, two_presses(), 20.0, cut_threshold=0.2)
            with View(folder, scene) as view:
                page = OpenPage(view.url())
                begin(page)
                if ending == 'died':
                    die(view)
                else:
                    found['status'] = view.end()
                page.close()
            found[ending] = attempts()
        yield found
    finally:
        trainer('attempts', '--delete', SUBJECT)
        for bag in sessions() - known:
            shutil.rmtree(bag) if bag.is_dir() else bag.unlink()


def test_an_attempt_in_which_all_died_is_listed_as_broken_off(seen: dict[str, Any]) -> None:
    (row,) = seen['died']
    assert row['state'] == 'broken off'
    assert row['points'] is None and not row['passed']
    assert row['exercise'] == EXERCISE and Path(row['bag']).is_dir()


def test_the_next_attempt_is_recorded_beside_it_and_leaves_it_as_it_is(
    seen: dict[str, Any],
) -> None:
    assert seen['status'] == 0
    before, after = seen['ended']
    assert before == seen['died'][0]
    assert after['attempt'] == before['attempt'] + 1
    assert after['state'] in ('scored', 'broken off')  # nothing was touched


def test_the_attempt_that_died_can_be_repaired_and_computed_again(
    seen: dict[str, Any], tmp_path: Path
) -> None:
    broken = Path(seen['died'][0]['bag'])
    mended = tmp_path / broken.name
    shutil.copytree(broken, mended)
    trainer('repair', str(mended))
    said = trainer('resimulate', str(mended))
    assert 'identical' in said, said
