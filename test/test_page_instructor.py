"""Claims about the page of the instructor, beside that of a trainee in another browser."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_user import View, point, sessions, start
from page_world import StandIn
from test_page_client import REACHED, SIZES, WHAT_IS_THERE

from bench.page.browser import CHROMIUM, Page, chromium
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.allowed_requests import HELD
from cutting_trainer.viewer.page_protocol import Hold, SetTissue, Start

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
)

PAUSED = 'The instructor has paused.'
TASK = """[...document.querySelectorAll('#task-rows > *')].map(one => one.innerText)"""
DISABLED = "document.querySelector('#{}').disabled"
TOUCHED = np.array([0.0, 0.0, 0.024])
"""[m] a place on the block of the lumps, beside all of them: the palpator does not go in."""
DOWN = 9
"""Steps of 1 mm, from 4 mm above the surface."""
TIMEOUT_S = 240.0


@contextmanager
def both(trainee: str, instructor: str) -> Iterator[tuple[Page, Page]]:
    """Pages of both, each in a browser of its own."""
    with ExitStack() as stack:
        pages = []
        for url in (trainee, instructor):
            browser = stack.enter_context(chromium((1280, 800), coarseness=2))
            page = browser.page(url)
            page.wait(lambda page=page: page.state().get('tip') and page.state()['meshes'], url)
            pages.append(page)
        yield pages[0], pages[1]


def force(page: Page) -> float:
    """Force that a page shows [N]."""
    return float(page.evaluate("document.querySelector('#hud-force').innerText"))


def off(page: Page, name: str) -> bool:
    """Whether a control is disabled."""
    return bool(page.evaluate(DISABLED.format(name)))


@pytest.mark.long
def test_instructor_pauses_and_goes_on_and_the_trainee_is_told() -> None:
    with closing(StandIn('block')) as session, both(session.url, session.instructor) as pages:
        trainee, instructor = pages
        trainee.press('start')
        trainee.wait(lambda: trainee.state()['canGuide'], 'the hand')
        assert not instructor.state()['canGuide']
        instructor.press('pause')
        trainee.wait(lambda: trainee.says(PAUSED), 'the notice')
        trainee.wait(lambda: off(trainee, 'start') and off(trainee, 'reset'), 'the controls')
        assert not instructor.says(PAUSED) and off(instructor, 'pause')
        starts = len(session.of(Start))
        instructor.wait(lambda: instructor.says('Go on'), 'the button')
        instructor.press('start')
        trainee.wait(lambda: trainee.state()['state'] == 'ENABLED', 'the force')
        trainee.wait(lambda: not trainee.says(PAUSED), 'the end of the notice')
        assert [message.on for message in session.of(Hold)] == [True, False]
        assert len(session.of(Start)) == starts
        instructor.press('e-stop')
        trainee.wait(lambda: trainee.state()['eStopped'], 'the stop')


@pytest.mark.long
def test_instructor_sets_the_tissue_and_a_trainee_does_not() -> None:
    with closing(StandIn('block')) as session, both(session.url, session.instructor) as pages:
        trainee, instructor = pages
        assert trainee.evaluate("document.querySelector('#set-tissue').hidden")
        instructor.slide('stiffness', 0.99)
        instructor.slide('toughness', 0.01)
        instructor.press('tissue')
        (asked,) = session.wait(lambda: session.of(SetTissue))
        assert (asked.stiffness, asked.toughness) == (2.0, 0.5)
        instructor.reload()
        shown = "document.querySelector('#stiffness-value').innerText"
        instructor.wait(lambda: instructor.evaluate(shown) == '2.0', 'the present tissue')


@pytest.mark.long
def test_stop_and_controls_of_the_instructor_are_in_sight_at_every_size() -> None:
    with closing(StandIn('vessel')) as session, chromium((1000, 700)) as browser:
        page = browser.page(session.instructor)
        page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
        page.press('pause')
        page.wait(lambda: page.state()['held'], 'the pause')
        assert page.evaluate('document.title') == 'Cutting trainer: instructor'
        for width, height in SIZES:
            page.resize(width, height)
            there = page.evaluate(REACHED)
            assert not there['lost'], (width, height, there)
            assert set(there['covered']) <= {'CANVAS', 'MAIN'}, (width, height, there)
            there = page.evaluate(WHAT_IS_THERE)
            assert set(there['seen']) == {'e-stop'}, (width, height, there)


def press_in(page: Page) -> float:
    """Presses at the place without a cut; the force [N], which fades while frames are late."""
    point(page, TOUCHED)
    for _ in range(DOWN):
        page.evaluate("document.querySelector('[data-guide=down]').click()")
        time.sleep(0.3)
    time.sleep(1.0)
    felt = []
    for _ in range(30):
        felt.append(np.linalg.norm(page.state()['moment']['force']))
        time.sleep(0.1)
    return float(max(felt))


@pytest.fixture(scope='module')
def lesson(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A lesson on a real graph: pressed, paused, gone on, and pressed in a stiffer tissue."""
    folder, known, found = tmp_path_factory.mktemp('lesson'), sessions(), {}
    with View(folder, load_scene('lumps').path) as view:
        url, instructors = view.url(), view.url('instructor')
        with both(url, instructors) as (trainee, instructor):
            found['soft'] = press_in(trainee)
            trainee.wait(lambda: force(trainee) == force(instructor) > 0.03, 'the force of both')
            found['rows'] = [
                page.wait(lambda p=page: p.evaluate(TASK), 'the progress')
                for page in (trainee, instructor)
            ]
            instructor.press('pause')
            trainee.wait(lambda: trainee.says(PAUSED), 'the notice')
            trainee.wait(lambda: force(trainee) == force(instructor) == 0.0, 'no force')
            before = np.array(trainee.state()['moment']['tip'])
            trainee.evaluate("document.querySelector('#start').disabled = false")
            trainee.press('start')
            trainee.wait(lambda: HELD in trainee.state()['notices'], 'the refusal')
            x, y = trainee.pixels(np.array([[0.01, 0.01, 0.024]]))[0]
            trainee.mouse('mouseMoved', x, y)
            time.sleep(2.0)
            found['moved'] = float(np.linalg.norm(trainee.state()['moment']['tip'] - before))
            found['paused'] = trainee.state()['state'], instructor.state()['state']
            if pictures := os.environ.get('PICTURES'):
                trainee.save(Path(pictures) / 'trainee.png')
                instructor.save(Path(pictures) / 'instructor.png')
            instructor.press('start')
            trainee.wait(lambda: trainee.state()['state'] == 'ENABLED', 'the force')
            instructor.slide('stiffness', 0.99)
            instructor.press('tissue')
            trainee.wait(lambda: trainee.state()['busy'], 'the restart', TIMEOUT_S)
            trainee.wait(lambda: not trainee.state()['busy'], 'the nodes', TIMEOUT_S)
            start(trainee)
            found['stiff'] = press_in(trainee)
            instructor.press('e-stop')
            trainee.wait(lambda: trainee.state()['eStopped'], 'the stop')
        found['status'] = view.end()
    yield found
    for bag in sessions() - known:
        shutil.rmtree(bag)


@pytest.mark.thorough
@pytest.mark.real_time
def test_both_see_the_same_session(lesson: dict[str, Any]) -> None:
    assert lesson['status'] == 0
    for rows in lesson['rows']:
        assert {'time', 'marks', 'peak force'} < set(rows)


@pytest.mark.thorough
@pytest.mark.real_time
def test_a_pause_takes_the_force_and_holds_the_hand_until_the_instructor_goes_on(
    lesson: dict[str, Any],
) -> None:
    assert lesson['paused'] == ('PAUSED', 'PAUSED')
    assert lesson['moved'] < 0.002  # the spring of the hand lets go of the force


@pytest.mark.thorough
@pytest.mark.real_time
def test_a_stiffer_tissue_is_felt(lesson: dict[str, Any]) -> None:
    assert lesson['stiff'] > 1.2 * lesson['soft'] > 0.0
