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

import numpy as np
import pytest
from live import two_presses, write_scene
from page_user import ROOT, View, cut, point, sessions, start

from bench.page.browser import CHROMIUM, Page, chromium

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

EXERCISE, SUBJECT = 'vessel', f'test-{secrets.token_hex(4)}'
BEGIN, MIDDLE, END = (np.array([x, 0.0, 0.014]) for x in (-0.017, -0.002, 0.020))
"""[m] places of the stroke, on the upper side; the whole one leaves through the edge."""
NOTCHES, RAISED_MM = 4, 18
TIMEOUT_S = 90.0
ROWS = """[...document.querySelectorAll('#attempts tr')].map(row =>
    [row.querySelector('input').value, row.cells[1].innerText, row.cells[2].innerText])"""


def attempt(page: Page, until: np.ndarray) -> Any:
    """Cuts up to a place; the score and its reasons, as the page says them."""
    page.evaluate(f"document.querySelector('#exercise').value = '{EXERCISE}'")
    page.evaluate(f"document.querySelector('#subject').value = '{SUBJECT}'")
    page.press('begin')
    page.wait(lambda: page.state()['recording'].startswith(EXERCISE), 'the recording', TIMEOUT_S)
    page.wait(lambda: not page.state()['busy'] and page.state()['moments'], 'the nodes', TIMEOUT_S)
    time.sleep(2.0)
    start(page)
    cut(page, BEGIN, until, NOTCHES)
    page.mouse('mouseReleased', *page.pixels(until[None])[0])
    point(page, END)
    for _ in range(RAISED_MM):
        page.evaluate("document.querySelector('[data-guide=up]').click()")
        time.sleep(0.1)
    said = "document.querySelector('#task-score:not([hidden])')?.innerText"
    return page.wait(lambda: page.evaluate(said), 'the score', TIMEOUT_S)


@pytest.fixture(scope='module')
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A good attempt and one that cuts half of the line; what the page lists, and shows of both."""
    folder, known = tmp_path_factory.mktemp('training'), sessions()
    view = View(folder, write_scene(folder, two_presses(), 20.0, cut_threshold=0.2))
    found: dict[str, Any] = {}
    try:
        url = view.url()
        with chromium((1280, 800), coarseness=2) as browser:
            page = browser.page(url)
            page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
            for name, until in (('good', END), ('half', MIDDLE)):
                found[name] = attempt(page, until)
                page.wait(lambda: not page.state()['recording'], 'the end of the bag', TIMEOUT_S)
                mine = page.wait(partial(listed, page, len(found)), 'the list', TIMEOUT_S)
            found['rows'] = mine
            for bag, *_ in mine:
                page.evaluate(f"""document.querySelector('#attempts [value="{bag}"]').click()""")
            page.press('watch')
            link = "document.querySelector('#replay:not([hidden])')?.href"
            replay = browser.page(page.wait(lambda: page.evaluate(link), 'the link', TIMEOUT_S))
            replay.wait(
                lambda: len(replay.state().get('parts', ())) == 2, 'both tissues', TIMEOUT_S
            )
            replay.slide('seek', 0.9)
            replay.wait(lambda: replay.state()['playhead']['time'] > 1.0, 'the time', TIMEOUT_S)
            time.sleep(1.0)
            found['replay'] = replay.state()
            page.press('e-stop')
            page.wait(lambda: page.state()['eStopped'], 'the stop, beside a replay')
        found['status'] = view.end()
    finally:
        print(view.said)
        if view.process.poll() is None:
            view.end()
    found['bags'] = sessions() - known
    yield found
    trainer('attempts', '--delete', SUBJECT)
    for bag in sessions() - known:
        shutil.rmtree(bag) if bag.is_dir() else bag.unlink()


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


def test_the_good_attempt_passes_and_the_half_one_fails_for_reasons(done: dict[str, Any]) -> None:
    assert done['status'] == 0
    assert done['good'].startswith('✓ passed'), done['good']
    assert done['half'].startswith('✕ not passed'), done['half']
    assert 'target that is opened' in done['half']


def test_each_attempt_is_one_bag_from_its_start_to_its_score(done: dict[str, Any]) -> None:
    half, good = done['rows']
    assert '✓' in good[2] and '✕' in half[2]
    assert 'attempt 1' in good[1] and 'attempt 2' in half[1]
    said = trainer('attempts', '--json', '--subject', SUBJECT)
    rows = {Path(row['bag']).name: row for row in json.loads(said)}
    assert {row[0] for row in done['rows']} == set(rows)
    assert all(row['state'] == 'scored' for row in rows.values())


def test_both_replays_stand_side_by_side_at_one_time(done: dict[str, Any]) -> None:
    parts = done['replay']['parts']
    assert set(parts) == {'tissue', 'beside'}
    half, good = parts['tissue'], parts['beside']  # newest first
    assert good['cutEdges'] > half['cutEdges'] > 0
    (other,) = done['replay']['moment']['further']
    assert other['tip'][0] > done['replay']['moment']['tip'][0] + 0.02
