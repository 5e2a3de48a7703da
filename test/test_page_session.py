"""Claims about a session that a person dragged by mouse, and began to record in the middle.

The blade is in the tissue, and has cut, when the recording begins: the bag begins with a tissue
that is open, moves and is touched. It is as good as evidence as one from the start.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import Recording, two_presses, write_scene
from page_user import ROOT, View, cut, sessions

from bench.page.browser import CHROMIUM, Page, chromium
from cutting_trainer.haptic_bridge.force_kernels import INSIDE
from cutting_trainer.node_common.cdr_codec import ContactCodec

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

BEGIN, MIDDLE, END = (np.array([x, 0.0, 0.010]) for x in (-0.012, 0.0, 0.014))
"""[m] places on a block that is 10 mm high."""
NOTCHES = 5
"""Of the wheel, by which it is cut deeper than 6 mm."""
COMMAND_TIMEOUT_S = 240


@dataclass
class Made:
    """A bag, and what the page said while it was made.

    Attributes:
        bag: its folder.
        before: the page's state when the recording was asked for.
        after: the same when it ended.
        status: with which the session ended.
    """

    bag: Path
    before: Any
    after: Any
    status: int


def use(page: Page, known: set[Path]) -> tuple[Path, Any, Any]:
    """Cuts, records the next cut alone; the bag, and the page's state before and after it."""
    page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
    cut(page, np.linspace(BEGIN, MIDDLE, 12), NOTCHES)
    before = page.state()
    page.evaluate("document.querySelector('#record').click()")  # the mouse holds the cut
    page.wait(lambda: page.state()['recording'] and not page.state()['busy'], 'the recording')
    page.mouse('mouseReleased', *page.pixels(MIDDLE[None])[0])
    cut(page, np.linspace(MIDDLE, END, 12), NOTCHES)
    after = page.state()
    page.mouse('mouseReleased', *page.pixels(END[None])[0])
    page.press('record')
    page.wait(lambda: not page.state()['recording'] and not page.state()['busy'], 'its end')
    (bag,) = sessions() - known
    return bag, before, after


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Made]:
    folder, known = tmp_path_factory.mktemp('page'), sessions()
    with View(folder, write_scene(folder, two_presses(), 20.0, cut_threshold=0.2)) as view:
        url = view.url()
        with chromium((1000, 700), coarseness=2) as browser:
            bag, before, after = use(browser.page(url), known)
        made = Made(bag, before, after, view.end())
    yield made
    for bag in sessions() - known:
        shutil.rmtree(bag)


def trainer(*arguments: str) -> str:
    """What a command says on standard output; it has to end in order."""
    done = subprocess.run(
        [sys.executable, '-m', 'cutting_trainer.cli', *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=COMMAND_TIMEOUT_S,
        env=os.environ | {'COLUMNS': '200'},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_recording_begins_in_the_middle_of_a_cut(made: Made) -> None:
    assert made.status == 0
    assert made.before['parts']['tissue']['cutEdges'] > 0  # the tissue was open already
    recording = Recording(made.bag)
    assert recording.complete
    _, states = recording.read('/tool/contact', ContactCodec(), 'state')
    assert (states[:50, 0] == INSIDE).any()


def test_the_recorded_drag_cuts_further(made: Made) -> None:
    edges = [state['parts']['tissue']['cutEdges'] for state in (made.before, made.after)]
    assert edges[1] > edges[0]
    recording = Recording(made.bag)
    _, tips = recording.read('/tool/contact', ContactCodec(), 'device')
    assert tips[-1, 0] - tips[0, 0] > 0.6 * (END - MIDDLE)[0]


def test_report_of_it_is_written(made: Made, tmp_path: Path) -> None:
    page = tmp_path / 'report.html'
    said = json.loads(trainer('report', str(made.bag), '-o', str(page), '--json'))
    assert page.stat().st_size > 1000
    assert said


def test_replay_shows_it_in_the_graph(made: Made) -> None:
    trainer('replay', str(made.bag), '--as-recorded', '--rate', '4', '--domain', 'free')


def test_view_shows_the_tissue_open_from_its_first_moment(made: Made, tmp_path: Path) -> None:
    said = tmp_path / 'said'
    command = [
        sys.executable,
        '-m',
        'cutting_trainer.cli.main',
        'view',
        '--bag',
        str(made.bag),
        '--port',
        '0',
    ]
    with said.open('wb') as file:
        process = subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=file)
    try:
        deadline = time.monotonic() + COMMAND_TIMEOUT_S
        while not (found := re.search(r'http://127\.0\.0\.1:\d+/\?token=\S+', said.read_text())):
            assert process.poll() is None and time.monotonic() < deadline, said.read_text()
            time.sleep(0.1)
        with chromium((1000, 700), coarseness=2) as browser:
            page = browser.page(found[0])
            page.wait(lambda: page.state().get('meshes') and page.state()['parts'], 'the tissue')
            state = page.state()
            assert state['mode'] == 'replay'
            assert (
                state['parts']['tissue']['cutEdges']
                >= made.before['parts']['tissue']['cutEdges']
                > 0
            )
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, said.read_text()


def test_computed_again_it_is_identical(made: Made) -> None:
    assert json.loads(trainer('resimulate', str(made.bag), '--json'))['identical']
