"""Claims about training at the page alone: an exercise is begun, done, scored, listed, compared."""

import json
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from live import two_presses, write_scene
from page_user import ROOT, View, sessions
from trainees import EXERCISES, TIMEOUT_S, attempt

from bench.page.browser import CHROMIUM, Browser, Page, chromium

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

SUBJECT = f'test-{secrets.token_hex(4)}'
ROWS = """[...document.querySelectorAll('#attempts tr')].map(row =>
    [row.querySelector('input').value, row.cells[1].innerText, row.cells[2].innerText])"""
ATTEMPTS = ('good', 'bad')


@pytest.fixture(scope='module')
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Two attempts at each exercise here; what the page says, lists, and shows of two of them."""
    folder, known = tmp_path_factory.mktemp('training'), sessions()
    found: dict[str, Any] = {}
    with View(folder, write_scene(folder, two_presses(), 20.0, cut_threshold=0.2)) as view:
        url = view.url()
        with chromium((1280, 800), coarseness=2) as browser:
            page = browser.page(url)
            page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
            for number, (exercise, skill) in enumerate(
                (exercise, skill) for exercise in EXERCISES for skill in ATTEMPTS
            ):
                found[exercise, skill] = attempt(page, exercise, skill, SUBJECT)
                page.wait(lambda: not page.state()['recording'], 'the end of the bag', TIMEOUT_S)
                mine = page.wait(partial(listed, page, number + 1), 'the list', TIMEOUT_S)
            found['rows'] = mine
            found['replay'] = compare(browser, page, [bag for bag, *_ in mine[:2]])
            page.press('e-stop')
            page.wait(lambda: page.state()['eStopped'], 'the stop, beside a replay')
        found['status'] = view.end()
    yield found
    trainer('attempts', '--delete', SUBJECT)
    for bag in sessions() - known:
        shutil.rmtree(bag) if bag.is_dir() else bag.unlink()


def compare(browser: Browser, page: Page, bags: list[str]) -> Any:
    """The state of the page that shows two attempts side by side."""
    for bag in bags:
        page.evaluate(f"""document.querySelector('#attempts [value="{bag}"]').click()""")
    page.press('watch')
    link = "document.querySelector('#replay:not([hidden])')?.href"
    replay = browser.page(page.wait(lambda: page.evaluate(link), 'the link', TIMEOUT_S))
    replay.wait(lambda: len(replay.state().get('parts', ())) == 2, 'both tissues', TIMEOUT_S)
    replay.slide('seek', 0.9)
    replay.wait(lambda: replay.state()['playhead']['time'] > 1.0, 'the time', TIMEOUT_S)
    time.sleep(1.0)
    return replay.state()


def trainer(*words: str) -> str:
    """What a command says on standard output."""
    command = [sys.executable, '-m', 'cutting_trainer.cli', *words]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, check=True
    )
    return done.stdout


def listed(page: Page, count: int) -> list[list[str]] | None:
    """The attempts of this test, newest first, once there are so many."""
    rows = [row for row in page.evaluate(ROWS) if SUBJECT in row[1]]
    return rows if len(rows) == count else None


@pytest.mark.parametrize('exercise', EXERCISES)
def test_the_good_attempt_passes_and_the_bad_one_fails_for_reasons(
    done: dict[str, Any], exercise: str
) -> None:
    assert done['status'] == 0
    good, bad = (done[exercise, skill] for skill in ATTEMPTS)
    assert good.startswith('✓ passed'), good
    assert bad.startswith('✕ not passed'), bad
    assert EXERCISES[exercise].reason in bad


def test_each_attempt_is_one_bag_from_its_start_to_its_score(done: dict[str, Any]) -> None:
    rows = done['rows'][::-1]
    assert [row[2][0] for row in rows] == ['✓', '✕'] * len(EXERCISES)
    assert [row[1].split()[0] for row in rows] == [name for name in EXERCISES for _ in ATTEMPTS]
    assert ['attempt 1' in row[1] for row in rows] == [True, False] * len(EXERCISES)
    said = trainer('attempts', '--json', '--subject', SUBJECT)
    stored = {Path(row['bag']).name: row for row in json.loads(said)}
    assert {row[0] for row in done['rows']} == set(stored)
    assert all(row['state'] == 'scored' for row in stored.values())


def test_both_replays_stand_side_by_side_at_one_time(done: dict[str, Any]) -> None:
    parts = done['replay']['parts']
    assert set(parts) == {'tissue', 'beside'}
    half, good = parts['tissue'], parts['beside']  # newest first
    assert good['cutEdges'] > half['cutEdges'] > 0
    (other,) = done['replay']['moment']['further']
    assert other['tip'][0] > done['replay']['moment']['tip'][0] + 0.02
