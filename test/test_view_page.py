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
from page_user import View, cut, cut_coloured, point, reddish, sessions, start

from bench.page.browser import CHROMIUM, Browser, Page, chromium
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, TOUCHING
from cutting_trainer.node_common.cdr_codec import ContactCodec

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.real_time,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

BEGIN, END = np.array([-0.013, 0.0, 0.010]), np.array([0.013, 0.0, 0.010])
"""[m] places on a block that is 10 mm high."""
NOTCHES = 14
"""Turns of the wheel by 0.5 mm, from 4 mm above it."""
BOX = """(r => [r.x, r.y, r.width, r.height])(
    document.querySelector('#view').getBoundingClientRect())"""
STOP = """(r => [r.x, r.y, r.width, r.height].join(' '))(
    document.querySelector('#e-stop').getBoundingClientRect())"""


@dataclass
class Seen:
    """What the pages showed, and when things were done."""

    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    states: dict[str, Any] = field(default_factory=dict)
    forces: list[float] = field(default_factory=list)
    stops: dict[str, str] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    known: set[Path] = field(default_factory=sessions)
    bags: list[Path] = field(default_factory=list)
    status: int = -1


def use(browser: Browser, url: str, seen: Seen) -> None:
    """The session that all tests of this file look at."""
    began = time.monotonic()
    page = browser.page(url)
    page.wait(lambda: page.state().get('meshes'), 'the tissue')
    box = page.evaluate(BOX)

    def settle() -> np.ndarray:
        """What is drawn, once it does not change any more: a slow browser draws late."""
        left, top, width, height = map(int, box)
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
        seen.states[name] = page.state()
        seen.stops[name] = page.evaluate(STOP)
        if picture:
            seen.pictures[name] = settle()
        if folder := os.environ.get('PICTURES'):
            page.save(Path(folder) / f'{name}.png')

    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue')
    keep('before')
    page.press('record')
    wait_for_bag(page, seen)
    point(page, BEGIN)
    x, y = page.pixels(BEGIN[None])[0]
    for _ in range(NOTCHES):
        page.call('Input.dispatchMouseEvent', type='mouseWheel', x=x, y=y, deltaX=0, deltaY=120)
    time.sleep(0.7)
    seen.forces.append(float(np.linalg.norm(page.state()['moment']['force'])))
    keep('pressed', picture=False)
    start(page)
    time.sleep(1.5)
    page.press('e-stop')
    page.wait(lambda: page.state()['eStopped'], 'the stop')
    keep('stopped', picture=False)
    page.press('reset-e-stop')
    page.wait(lambda: not page.state()['eStopped'], 'the reset')
    keep('reset', picture=False)
    cut(page, np.linspace(BEGIN, END, 12))
    page.mouse('mouseReleased', *page.pixels(END[None])[0])
    time.sleep(0.7)
    keep('cut')
    seen.requests = page.requests()
    page.reload()
    page.wait(lambda: page.state().get('meshes'), 'the page again')
    page.wait(lambda: reddish(page.picture()).sum() > 1000, 'the tissue again')
    keep('reloaded')
    page.press('record')
    page.wait(lambda: not page.state()['recording'] and not page.state()['busy'], 'the end')
    print(f'{time.monotonic() - began:.1f} s: ended', flush=True)
    seen.requests += page.requests()


def wait_for_bag(page: Page, seen: Seen) -> None:
    """Returns when one more bag is being made, and all nodes are there."""
    page.wait(lambda: sessions() - seen.known - set(seen.bags), 'the next bag')
    seen.bags += sessions() - seen.known - set(seen.bags)
    page.wait(lambda: page.state()['recording'] and not page.state()['busy'], 'the nodes')


@pytest.fixture(scope='module')
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    seen = Seen()
    folder = tmp_path_factory.mktemp('view')
    scene = write_scene(folder, two_presses(), 20.0, cut_threshold=0.2)
    with View(folder, scene) as view:
        url = view.url()
        with chromium((1060, 640), coarseness=2) as browser:
            use(browser, url, seen)
        seen.status = view.end()
    yield seen
    for bag in seen.bags:
        shutil.rmtree(bag)


@pytest.fixture(scope='module')
def recording(seen: Seen) -> Recording:
    return Recording(seen.bags[0])


def test_view_ends_in_order_on_ctrl_c(seen: Seen) -> None:
    assert seen.status == 0


def test_page_asks_for_nothing_beyond_this_machine(seen: Seen) -> None:
    assert any(url.endswith('.js') for url in seen.requests)
    for url in seen.requests:
        assert url.startswith('http://127.0.0.1:'), url


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


def test_force_is_shown_while_the_blade_presses(seen: Seen) -> None:
    assert seen.states['before']['plots'] > 0
    assert max(seen.forces) > 0.05


def test_a_reload_in_mid_session_shows_the_same_again(seen: Seen) -> None:
    cut, again = seen.pictures['cut'], seen.pictures['reloaded']
    assert cut_coloured(again).sum() > 0.5 * cut_coloured(cut).sum()
    assert seen.states['reloaded']['recording']


def test_e_stop_is_zero_force_at_once_and_until_it_was_reset(recording: Recording) -> None:
    clicked = min(recording.at(m.publish_time) for m in recording.messages('/haptic_bridge/e_stop'))
    times, norms = recording.force(SERVO_CF)
    assert norms[(times > clicked - 0.1) & (times <= clicked)].max() > 0
    again = min(time for word, time in commands(recording) if word == 'enable' and time > clicked)
    assert not norms[(times > clicked + 0.05) & (times < again)].any()


def test_e_stop_is_shown_until_its_reset_and_stays_where_it_is(seen: Seen) -> None:
    assert seen.states['stopped']['eStopped']
    assert not seen.states['reset']['eStopped'] and seen.states['reset']['state'] != 'ENABLED'
    assert len(set(seen.stops.values())) == 1


def test_hand_went_where_the_pointer_was(recording: Recording) -> None:
    poses: Any = [recording.bag.read(m).pose.position for m in recording.messages(MEASURED_CP)]
    ways = np.array([(p.x, p.y, p.z) for p in poses])
    moved = np.ptp(ways, axis=0)
    assert moved[2] > 0.015
    assert moved[0] > 0.6 * (END - BEGIN)[0]


def commands(recording: Recording) -> list[tuple[str, float]]:
    """What the haptic bridge was told, and when [s]."""
    return [
        (recording.bag.read(m).string, recording.at(m.publish_time))
        for m in recording.messages('/haptic_bridge/state_command')
    ]
