"""Claims about the page of a live session, made with a browser as a person would use it.

One session: look, record, start, press with the blade, stop at once, start again, cut, reload.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import MEASURED_CP, SERVO_CF, Recording, two_presses, write_scene

from bench.browser import CHROMIUM, NO_CARD, Browser, Page, chromium
from haptic_bridge.chain import INSIDE, TOUCHING
from haptic_bridge.operating_state import E_STOP
from haptic_bridge.wire import ContactCodec
from session.scene import load_scene
from tissue_sim.assembly import make_simulation
from viewer.stage import FIELD_OF_VIEW, framing

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

ROOT = Path(__file__).resolve().parents[1]
GRIP = 0.028
"""[m] from the tip to where the arrows of the handles are gripped."""
PRESS, DOWN, ALONG = 0.0180, 0.025, 0.026
"""[m] that the blade is dragged: to press on a block that is 10 mm high, 9 mm into it, along it."""
UP = np.array([0.0, 0.0, 1.0])


FORCE_PLOT = np.s_[96:196, 62:292]
"""Where the page has the line of the force [pixel]."""


@dataclass
class Seen:
    """What the pages showed, and when things were done."""

    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    plots: dict[str, np.ndarray] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    bag: Path = Path()
    status: int = -1


class View:
    """`trainer view` as a process of its own."""

    def __init__(self, folder: Path, scene: Path) -> None:
        self._said = folder / 'said'
        command = [sys.executable, '-m', 'session.cli', 'view', '--port', '0']
        with self._said.open('wb') as file:
            self.process = subprocess.Popen(
                [*command, '--scene', str(scene), '--domain', 'free'],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | {'COLUMNS': '200'},
                start_new_session=True,
            )

    def url(self) -> str:
        """Where the page is, once all nodes are ready."""
        deadline = time.monotonic() + 120
        while self._said.read_text().count(' is ready') < 5:
            assert self.process.poll() is None and time.monotonic() < deadline, self.said
            time.sleep(0.1)
        found = re.search(r'page: (http://127\.0\.0\.1:\d+)$', self.said, re.MULTILINE)
        assert found, self.said
        return found[1]

    @property
    def said(self) -> str:
        return self._said.read_text()

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


class Eye:
    """Where points of the tissue frame are on the page, for its first camera."""

    def __init__(self, page: Page, positions: np.ndarray) -> None:
        position, aim = framing(positions)
        forward = (aim - position) / np.linalg.norm(aim - position)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._position = position
        self._axes = np.stack([right, np.cross(right, forward), forward])
        box = "document.querySelector('canvas').getBoundingClientRect()"
        found = page.evaluate(f'(r => JSON.stringify([r.x, r.y, r.width, r.height]))({box})')
        self.box = np.array(json.loads(found))

    def pixels(self, points: np.ndarray) -> np.ndarray:
        x, y, depth = self._axes @ (np.asarray(points) - self._position).T
        scale = self.box[3] / 2 / np.tan(FIELD_OF_VIEW / 2)
        middle = self.box[:2] + self.box[2:] / 2
        return middle + scale * np.stack([x / depth, -y / depth], axis=1)


def way(start: np.ndarray, axis: np.ndarray, length: float) -> np.ndarray:
    """Places from a grip on the arrow along an axis to `length` further [m], shape (n, 3)."""
    shares = np.concatenate([[0.0, 0.02], np.linspace(0.05, 1.0, 40)])
    return start + np.outer(GRIP + shares * length, axis)


def reddish(picture: np.ndarray) -> np.ndarray:
    """Which pixels have the colour of tissue."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r > g + 25) & (r > b + 25) & (abs(g - b) < 60)


def cut_coloured(picture: np.ndarray) -> np.ndarray:
    """Which pixels have the colour of what a cut has opened."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r > 3 * g) & (r > 2 * b) & (r > 40)


def start(page: Page) -> None:
    """Lets the force in; again where a machine that stood still has made a fault."""
    for _ in range(10):
        if not page.says('Force is on'):
            page.click('Start')
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            if page.says('Force is on'):
                return
            time.sleep(0.1)
    raise AssertionError(page.evaluate('document.body.innerText'))


def height_of_line(plot: np.ndarray) -> int:
    """Rows [pixel] that the blue line of a plot covers."""
    r, g, b = plot.astype(int).transpose(2, 0, 1)
    rows = np.flatnonzero(((b > r + 80) & (b > g + 40)).any(axis=1))
    return int(np.ptp(rows)) if len(rows) else 0


def use(browser: Browser, url: str, file: Path, seen: Seen) -> None:
    """The session that all tests of this file look at."""
    began = time.monotonic()
    scene = load_scene(str(file))
    positions = make_simulation(scene.tissue)[0].positions
    page = browser.page(url)
    page.wait(lambda: page.says('Start'), 'the panel')
    eye = Eye(page, positions)

    def settle() -> np.ndarray:
        """What is drawn, once it does not change any more: a slow browser draws late."""
        left, top, width, height = eye.box.astype(int)
        before = np.zeros((height, width, 3))
        for _ in range(20):
            time.sleep(0.5)
            now = page.picture()[top : top + height, left : left + width].astype(float)
            if np.abs(now - before).mean() < 0.3:
                break
            before = now
        return now.astype(np.uint8)

    def keep(name: str) -> None:
        print(f'{time.monotonic() - began:.1f} s: {name}', flush=True)
        seen.texts[name] = page.evaluate('document.body.innerText')
        seen.pictures[name] = settle()
        seen.plots[name] = page.picture()[FORCE_PLOT]
        if folder := os.environ.get('PICTURES'):
            page.save(Path(folder) / f'{name}.png')

    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue')
    page.evaluate(NO_CARD)
    keep('before')
    page.click('Record')
    page.wait(lambda: page.says('Stop recording'), 'the recorder')
    start(page)
    page.wait(lambda: page.says('Drag the handles'), 'the handles')
    settle()
    tip = np.array(scene.arm.script.start.position)
    page.drag(eye.pixels(way(tip, UP, -PRESS)))
    keep('pressed')
    start(page)
    settle()
    page.click('E-STOP')
    page.wait(lambda: page.says('emergency stop'), 'the stop')
    keep('stopped')
    start(page)
    page.wait(lambda: page.says('Drag the handles'), 'the handles')
    settle()
    page.drag(eye.pixels(way(tip - PRESS * UP, UP, PRESS - DOWN)))
    start(page)
    settle()
    page.drag(eye.pixels(way(tip - DOWN * UP, np.array([1.0, 0.0, 0.0]), ALONG)))
    keep('cut')
    page.open(url)
    page.wait(lambda: page.says('Start'), 'the page again')
    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue again')
    page.evaluate(NO_CARD)
    keep('reloaded')
    page.click('Stop recording')
    page.wait(lambda: page.says('Record') and not page.says('Stop recording'), 'the end of the bag')
    seen.requests = page.requests


@pytest.fixture(scope='module')
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    seen = Seen()
    folder = tmp_path_factory.mktemp('view')
    scene = write_scene(folder, two_presses(), 20.0, cut_threshold=0.6)
    view = View(folder, scene)
    known = set((ROOT / 'bags' / 'sessions').glob('*'))
    try:
        url = view.url()
        with chromium((1060, 640), coarseness=2) as browser:
            use(browser, url, scene, seen)
        (seen.bag,) = set((ROOT / 'bags' / 'sessions').glob('*')) - known
        seen.status = view.end()
    finally:
        print(view.said)
        if view.process.poll() is None:
            view.end()
    yield seen
    subprocess.run(['rm', '-r', str(seen.bag)], check=True)


@pytest.fixture(scope='module')
def recording(seen: Seen) -> Recording:
    return Recording(seen.bag)


def test_view_ends_in_order_on_ctrl_c(seen: Seen) -> None:
    assert seen.status == 0


def test_page_asks_for_nothing_beyond_this_machine(seen: Seen) -> None:
    assert seen.requests
    for url in seen.requests:
        assert url.startswith(('http://127.0.0.1:', 'ws://127.0.0.1:', 'data:', 'blob:')), url


def test_tissue_is_drawn(seen: Seen) -> None:
    before = seen.pictures['before']
    assert 0.02 < reddish(before).mean() < 0.6
    assert not cut_coloured(before).sum() > 50


def test_dragged_blade_indents_the_tissue_and_then_cuts_it(recording: Recording) -> None:
    times, states = recording.read('/tool/contact', ContactCodec(), 'state')
    touched, inside = times[states[:, 0] == TOUCHING], times[states[:, 0] == INSIDE]
    assert len(touched) and len(inside)
    assert touched[0] < inside[0]
    forces = recording.force(SERVO_CF)[1]
    assert forces.max() > 0.15


def test_what_is_cut_open_is_seen_in_its_own_colour(seen: Seen) -> None:
    assert cut_coloured(seen.pictures['cut']).sum() > 100


def test_plot_of_the_force_moves_with_it(seen: Seen) -> None:
    assert height_of_line(seen.plots['before']) <= 4
    assert max(height_of_line(seen.plots[name]) for name in ('pressed', 'stopped')) > 15


def test_a_reload_in_mid_session_shows_the_same_again(seen: Seen) -> None:
    cut, again = seen.pictures['cut'], seen.pictures['reloaded']
    assert cut_coloured(again).sum() > 0.5 * cut_coloured(cut).sum()
    assert 'Stop recording' in seen.texts['reloaded']


def test_e_stop_is_zero_force_and_fault_within_50_ms(recording: Recording) -> None:
    commands = [
        (recording.bag.read(m).string, m.publish_time)
        for m in recording.messages('/haptic_bridge/state_command')
    ]
    clicked = recording.at(next(stamp for word, stamp in commands if word == E_STOP))
    times, norms = recording.force(SERVO_CF)
    assert norms[(times > clicked - 0.1) & (times <= clicked)].max() > 0
    later = [recording.at(stamp) for word, stamp in commands if word == 'enable']
    again = min(time for time in later if time > clicked)
    assert not norms[(times > clicked + 0.05) & (times < again)].any()
    states: list[tuple[str, float]] = []
    for message in recording.messages('/haptic_bridge/operating_state'):
        states.append((recording.bag.read(message).state, recording.at(message.publish_time)))
    fault = next(time for state, time in states if state == 'FAULT' and time > clicked)
    assert fault - clicked < 0.05


def test_hand_went_where_the_blade_was_dragged(recording: Recording) -> None:
    poses: Any = [recording.bag.read(m).pose.position for m in recording.messages(MEASURED_CP)]
    ways = np.array([(p.x, p.y, p.z) for p in poses])
    moved = ways[-1] - ways[0]
    assert moved[2] < -0.6 * DOWN
    assert moved[0] > 0.6 * ALONG
    assert abs(moved[1]) < 0.01
