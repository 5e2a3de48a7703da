"""Claims about the page of a live session, made with a browser as a person would use it.

One session: look, record, start, press with the blade, stop at once, start again, cut,
reload.
"""

import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import MEASURED_CP, SERVO_CF, Recording, two_presses, write_scene
from page_user import (
    RIGHT,
    UP,
    Eye,
    View,
    cut_coloured,
    reddish,
    sessions,
    start,
    way,
)

from bench.browser import CHROMIUM, NO_CARD, Browser, Page, chromium
from haptic_bridge.chain import INSIDE, TOUCHING
from haptic_bridge.operating_state import E_STOP
from haptic_bridge.wire import ContactCodec
from session.scene import load_scene
from tissue_sim.assembly import make_simulation

pytestmark = [
    pytest.mark.slow,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

PRESS, DOWN, ALONG = 0.0180, 0.025, 0.026
"""[m] that the blade is dragged: to press on a block that is 10 mm high, 9 mm into it, along it."""
RECORDING = (
    "[...document.querySelectorAll('button:enabled')].some(b => /^Stop r/.test(b.innerText))"
)
STOP = """(r => [r.x, r.y, r.width, r.height].join(' '))(
    [...document.querySelectorAll('button')].find(b => b.innerText.trim() === 'E-STOP')
    .getBoundingClientRect())"""
FORCE_PLOT = np.s_[96:196, 62:292]
"""Where the page has the line of the force [pixel]."""


@dataclass
class Seen:
    """What the pages showed, and when things were done."""

    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    plots: dict[str, np.ndarray] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    stops: dict[str, str] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    known: set[Path] = field(default_factory=sessions)
    bags: list[Path] = field(default_factory=list)
    status: int = -1


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

    def keep(name: str, *, picture: bool = True) -> None:
        print(f'{time.monotonic() - began:.1f} s: {name}', flush=True)
        seen.texts[name] = page.evaluate('document.body.innerText')
        seen.stops[name] = page.evaluate(STOP)
        if picture:
            seen.pictures[name] = settle()
        seen.plots[name] = page.picture()[FORCE_PLOT]
        if folder := os.environ.get('PICTURES'):
            page.save(Path(folder) / f'{name}.png')

    def drag(points: np.ndarray) -> None:
        start(page)
        page.wait(lambda: page.says('Drag the handles'), 'the handles')
        time.sleep(1.0)
        page.drag(eye.pixels(points))

    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue')
    page.evaluate(NO_CARD)
    keep('before')
    page.click('Record')
    wait_for_bag(page, seen)
    tip = np.array(scene.arm.script.start.position)
    drag(way(tip, UP, -PRESS))
    keep('pressed', picture=False)
    start(page)
    time.sleep(1.5)
    page.click('E-STOP')
    page.wait(lambda: page.says('emergency stop'), 'the stop')
    keep('stopped', picture=False)
    drag(way(tip - PRESS * UP, UP, PRESS - DOWN))
    drag(way(tip - DOWN * UP, RIGHT, ALONG))
    keep('cut')
    page.reload()
    page.wait(lambda: page.says('Start'), 'the page again')
    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue again')
    page.evaluate(NO_CARD)
    keep('reloaded')
    page.click('Stop recording')
    page.wait(lambda: page.says('Record') and not page.says('Stop recording'), 'the end of the bag')
    print(f'{time.monotonic() - began:.1f} s: ended', flush=True)
    seen.requests = page.requests


def wait_for_bag(page: Page, seen: Seen) -> None:
    """Returns when one more bag is being made, and all nodes are there."""
    page.wait(lambda: sessions() - seen.known - set(seen.bags), 'the next bag')
    seen.bags += sessions() - seen.known - set(seen.bags)
    page.wait(lambda: page.evaluate(RECORDING), 'the nodes')


@pytest.fixture(scope='module')
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    seen = Seen()
    folder = tmp_path_factory.mktemp('view')
    scene = write_scene(folder, two_presses(), 20.0, cut_threshold=0.6)
    view = View(folder, scene)
    try:
        url = view.url()
        with chromium((1060, 640), coarseness=2) as browser:
            use(browser, url, scene, seen)
        seen.status = view.end()
    finally:
        print(view.said)
        if view.process.poll() is None:
            view.end()
    yield seen
    for bag in seen.bags:
        shutil.rmtree(bag)


@pytest.fixture(scope='module')
def recording(seen: Seen) -> Recording:
    return Recording(seen.bags[0])


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
    said = commands(recording)
    clicked = next(time for word, time in said if word == E_STOP)
    times, norms = recording.force(SERVO_CF)
    assert norms[(times > clicked - 0.1) & (times <= clicked)].max() > 0
    again = min(time for word, time in said if word == 'enable' and time > clicked)
    assert not norms[(times > clicked + 0.05) & (times < again)].any()
    states: list[tuple[str, float]] = []
    for message in recording.messages('/haptic_bridge/operating_state'):
        states.append((recording.bag.read(message).state, recording.at(message.publish_time)))
    fault = next(time for state, time in states if state == 'FAULT' and time > clicked)
    assert fault - clicked < 0.05


def test_e_stop_stays_where_it_is_whatever_the_page_has_to_say(seen: Seen) -> None:
    assert 'emergency stop' in seen.texts['stopped']
    assert len(set(seen.stops.values())) == 1


def test_hand_went_where_the_blade_was_dragged(recording: Recording) -> None:
    poses: Any = [recording.bag.read(m).pose.position for m in recording.messages(MEASURED_CP)]
    ways = np.array([(p.x, p.y, p.z) for p in poses])
    moved = ways[-1] - ways[0]
    assert moved[2] < -0.6 * DOWN
    assert moved[0] > 0.6 * ALONG
    assert abs(moved[1]) < 0.01


def commands(recording: Recording) -> list[tuple[str, float]]:
    """What the haptic bridge was told, and when [s]."""
    return [
        (recording.bag.read(m).string, recording.at(m.publish_time))
        for m in recording.messages('/haptic_bridge/state_command')
    ]
