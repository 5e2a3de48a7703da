"""Claims about the blade that a pointer, keys or a gamepad guide at the page in a browser.

The server is the real one; behind it is a session that is none (page_world.py).
"""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from page_world import StandIn, guided, key, opened
from scipy.spatial.transform import Rotation

from bench.page.browser import CHROMIUM, Browser, Page, chromium
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.page_protocol import EStop, Guide

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    with chromium((1000, 700), coarseness=2) as browser:
        yield browser


def hovering(page: Page, stand_in: StandIn) -> tuple[np.ndarray, Any, Any]:
    """Lets the blade come over the middle of the block: the place [m], and its x and y [pixel]."""
    guided(page)
    top = stand_in.on_top(0.0, 0.0)
    x, y = page.pixels(top[None])[0]
    page.mouse('mouseMoved', x, y)
    stand_in.wait(lambda: stand_in.of(Guide))
    return top, x, y


def come_over(page: Page, stand_in: StandIn, place: np.ndarray) -> None:
    """Lets the tool come over a place of the tissue [m]."""
    page.mouse('mouseMoved', *page.pixels(place[None])[0])
    stand_in.wait(lambda: np.allclose(stand_in.tip[:2], place[:2], atol=1e-3))


def end_of_blade(goal: Guide) -> np.ndarray:
    """Where the blade ends at a goal [m]."""
    w, *turn = goal.wxyz
    return np.array(goal.position) - 0.004 * Rotation.from_quat([*turn, w]).apply(UP)


def test_blade_follows_the_pointer_and_goes_in_while_the_button_is_held(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        view = page.state()['camera']
        begin, end = (stand_in.on_top(x, -0.008) for x in (-0.008, 0.008))
        places = page.pixels(np.linspace(begin, end, 5))
        for place in places[::-1]:
            page.mouse('mouseMoved', *place)
            time.sleep(0.05)
        stand_in.wait(lambda: np.allclose(stand_in.tip, begin + 0.008 * UP, atol=1e-3))
        over = end_of_blade(stand_in.of(Guide)[-1])
        assert over == pytest.approx(begin + 0.004 * UP, abs=5e-4)
        assert page.says('Height')
        page.mouse('mousePressed', *places[0], pressed=True)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < begin[2] - 0.006)
        for place in places[1:]:
            page.mouse('mouseMoved', *place, pressed=True)
            time.sleep(0.05)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[0] > end[0] - 1e-3)
        assert page.state()['cutting'] and page.says('Cut depth')
        page.mouse('mouseReleased', *places[-1])
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] > begin[2] + 0.003)
        assert page.state()['camera'] == view  # it was no turn of the view
        time.sleep(0.5)  # until it is at its height again
        goal = stand_in.of(Guide)[-1]
        page.drag(np.array([[290.0, 520.0], [300.0, 520.0], [360.0, 530.0]]))
        assert page.state()['camera'] != view  # beside the tissue it is one
        assert stand_in.of(Guide)[-1].position == pytest.approx(goal.position, abs=1e-6)


def test_the_blade_goes_in_along_its_handle_however_the_surface_lies(browser: Browser) -> None:
    stand_in = StandIn('block', slope=0.5)
    with opened(browser, stand_in) as page:
        guided(page)
        place = stand_in.on_top(0.0, 0.0)
        (pixel,) = page.pixels(place[None])

        def ends_below() -> np.ndarray:
            ends = np.array([end_of_blade(goal) for goal in stand_in.of(Guide)])
            return ends[ends[:, 2] < place[2]]

        page.mouse('mouseMoved', *pixel)
        stand_in.wait(lambda: np.allclose(stand_in.tip, place + 0.008 * UP, atol=1e-3))
        page.mouse('mousePressed', *pixel, pressed=True)
        stand_in.wait(lambda: len(below := ends_below()) > 3 and below[-1, 2] < place[2] - 0.006)
        below = ends_below()
        page.mouse('mouseReleased', *pixel)
        assert len(below) > 3
        assert np.abs(below[:, :2] - place[:2]).max() < 5e-4


def test_a_tilted_tool_goes_in_along_its_handle_and_its_first_goal_is_no_jump(
    browser: Browser,
) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        top, x, y = hovering(page, stand_in)
        page.evaluate("document.querySelector('#view').focus()")
        for name, times in (('r', 10), ('PageUp', 16)):  # 30 degrees, 12 mm
            for _ in range(times):
                key(page, name, name)
        page.wait(lambda: page.says('Height 12.0 mm'), 'the height')
        stand_in.wait(lambda: np.linalg.norm(stand_in.tip - stand_in.goal) < 1e-4)
        for control, guides in (('pause', False), ('start', True)):
            page.press(control)
            page.wait(lambda wanted=guides: page.state()['canGuide'] is wanted, 'the hand')
        known = len(stand_in.of(Guide))
        page.evaluate("document.querySelector('#view').focus()")
        key(page, 'ArrowRight', 'ArrowRight')
        stand_in.wait(lambda: len(stand_in.of(Guide)) > known)
        assert np.linalg.norm(stand_in.of(Guide)[known].position - stand_in.tip) < 0.002
        page.mouse('mouseMoved', x, y)
        page.mouse('mousePressed', x, y, pressed=True)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < top[2] - 0.004)
        page.mouse('mouseReleased', x, y)


def test_a_blade_that_is_let_go_comes_out_where_it_is(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        begin, end = stand_in.on_top(-0.010, 0.0), stand_in.on_top(0.012, 0.0)
        places = page.pixels(np.array([begin, end]))
        come_over(page, stand_in, begin)
        page.mouse('mousePressed', *places[0], pressed=True)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < begin[2] - 0.006)
        page.mouse('mouseMoved', *places[1], pressed=True)
        page.mouse('mouseReleased', *places[1])  # with the way still before it
        known = len(stand_in.of(Guide))
        stand_in.wait(lambda: np.allclose(stand_in.tip[:2], end[:2], atol=1e-3))
        ends = np.array([end_of_blade(goal) for goal in stand_in.of(Guide)[known - 1 :]])
        ways = np.linalg.norm(np.diff(ends, axis=0)[:, :2], axis=1)
        assert ways[ends[:-1, 2] < begin[2]].max(initial=0.0) < 0.013  # 0.12 m/s for 0.1 s at most


def test_a_press_without_a_motion_before_cuts_where_it_is(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        first, other = stand_in.on_top(-0.010, 0.0), stand_in.on_top(0.010, 0.0)
        places = page.pixels(np.array([first, other]))
        come_over(page, stand_in, first)
        before, here = places[0][0] + 3, places[1][0]
        events = f"""for (const [kind, x] of [['move', {before}], ['down', {here}]]) {{
            const e = {{pointerId: 1, button: 0, buttons: +(kind === 'down'), bubbles: true}};
            document.querySelector('#view').dispatchEvent(new PointerEvent('pointer' + kind,
                {{...e, clientX: x, clientY: {places[1][1]}}}));
        }}"""
        page.evaluate(f"document.querySelector('#view').setPointerCapture = () => 0; {events}")
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < other[2] - 0.005)
        assert end_of_blade(stand_in.of(Guide)[-1])[:2] == pytest.approx(other[:2], abs=1e-3)


def test_a_palpator_follows_the_pointer_and_presses_no_deeper_than_it_is_set(
    browser: Browser,
) -> None:
    stand_in = StandIn('lumps')
    with opened(browser, stand_in) as page:
        guided(page)
        place = stand_in.on_top(-0.015, -0.012)
        (pixel,) = page.pixels(place[None])
        page.mouse('mouseMoved', *pixel)
        stand_in.wait(lambda: np.allclose(stand_in.tip, place + 0.008 * UP, atol=1e-3))
        page.mouse('mousePressed', *pixel, pressed=True)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < place[2] - 0.0055)
        time.sleep(1.0)
        deepest = min(end_of_blade(goal)[2] for goal in stand_in.of(Guide))
        assert deepest == pytest.approx(place[2] - 0.006, abs=3e-4)
        assert page.says('Press depth')
        page.mouse('mouseReleased', *pixel)


def test_no_cut_begins_or_goes_on_in_an_old_picture(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        begin, end = (stand_in.on_top(x, -0.008) for x in (-0.008, 0.008))
        places = page.pixels(np.array([begin, end]))
        page.mouse('mouseMoved', *places[0])
        stand_in.wait(lambda: np.allclose(stand_in.tip, begin + 0.008 * UP, atol=1e-3))
        stand_in.stands_still.set()
        page.wait(lambda: page.state()['stale'], 'the age')
        goals = -1
        while goals != len(stand_in.of(Guide)):  # the last one is repeated for 5 s
            goals = len(stand_in.of(Guide))
            time.sleep(1.0)
        page.mouse('mousePressed', *places[0], pressed=True)
        page.mouse('mouseMoved', *places[1], pressed=True)
        time.sleep(1.0)
        assert len(stand_in.of(Guide)) == goals
        stand_in.stands_still.clear()
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[0] > end[0] - 1e-3)
        page.mouse('mouseReleased', *places[1])


def test_no_goal_jumps_and_the_edge_turns_to_the_stroke(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        begin, end = stand_in.on_top(0.0, -0.010), stand_in.on_top(0.0, 0.010)
        places = page.pixels(np.linspace(begin, end, 6))
        come_over(page, stand_in, begin)
        before = len(stand_in.of(Guide))
        page.mouse('mousePressed', *places[0], pressed=True)
        page.mouse('mouseMoved', *places[-1], pressed=True)
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[1] > end[1] - 1e-3)
        time.sleep(0.3)
        goals = stand_in.of(Guide)[before:]
        page.mouse('mouseReleased', *places[-1])
        ways = np.diff([goal.position for goal in goals], axis=0)
        assert np.linalg.norm(ways, axis=1).max() < 0.016  # 0.12 m/s and 0.04 m/s in 0.1 s at most
        turns = 2 * np.arctan2(*np.array([[g.wxyz[3], g.wxyz[0]] for g in goals]).T)
        assert np.abs(np.diff(turns)).max() < 0.41
        assert turns[-1] == pytest.approx(np.pi / 2, abs=0.15)  # the stroke is along y


def test_the_blade_is_pushed_no_deeper_than_moments_say_that_it_is_not_in(
    browser: Browser,
) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        top, x, y = hovering(page, stand_in)
        page.mouse('mousePressed', x, y, pressed=True)

        def depth() -> float:
            return float(top[2] - end_of_blade(stand_in.of(Guide)[-1])[2])

        stand_in.wait(lambda: depth() > 0.008)  # it is pushed beyond the depth of 6 mm
        stand_in.stands_still.set()
        time.sleep(0.1)
        before = depth()
        time.sleep(0.6)  # the picture is not called old before a second is over
        assert depth() < before + 0.002
        stand_in.stands_still.clear()
        stand_in.wait(lambda: depth() > 0.021)
        page.mouse('mouseReleased', x, y)


def test_a_lift_on_a_long_way_ends_no_attempt(browser: Browser) -> None:
    stand_in, end = StandIn('vessel'), load_scene('vessel').exercise.end
    assert end is not None
    with opened(browser, stand_in) as page:
        guided(page)
        places = [stand_in.on_top(x, 0.0) for x in (-0.022, end.centre[0])]
        for place in places:
            before = len(stand_in.of(Guide))
            come_over(page, stand_in, place)
        highest = max(goal.position[2] for goal in stand_in.of(Guide)[before:])
        assert places[1][2] + 0.012 < highest < end.centre[2] - end.radius


def test_a_goal_that_was_lost_is_sent_again(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        hovering(page, stand_in)
        stand_in.wait(lambda: np.allclose(stand_in.tip, stand_in.goal, atol=1e-4))
        stand_in.loses_goals, asked = True, len(stand_in.of(Guide))
        aside = stand_in.on_top(0.004, 0.003)
        page.mouse('mouseMoved', *page.pixels(aside[None])[0])
        stand_in.wait(lambda: len(stand_in.of(Guide)) > asked)
        time.sleep(0.4)  # until the last one has gone
        stand_in.loses_goals = False
        stand_in.wait(lambda: np.allclose(stand_in.tip[:2], aside[:2], atol=1e-3))


def test_wheel_keys_and_the_button_that_stays_set_depth_and_cut(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        top, x, y = hovering(page, stand_in)
        page.evaluate("document.querySelector('#view').focus()")
        page.call('Input.dispatchMouseEvent', type='mouseWheel', x=x, y=y, deltaX=0, deltaY=120)
        page.wait(lambda: page.says('Height 3.5 mm'), 'the wheel')
        key(page, 'PageDown', 'PageDown')
        page.wait(lambda: page.says('Height 3.0 mm'), 'the key')
        page.call('Input.dispatchKeyEvent', type='keyDown', code='KeyC', key='c')
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] < top[2] - 0.005)
        page.call('Input.dispatchKeyEvent', type='keyUp', code='KeyC', key='c')
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[2] > top[2] + 0.002)
        page._click('[data-guide=cut]', 'true')
        page.wait(lambda: page.state()['cutting'], 'the cut')
        before = end_of_blade(stand_in.of(Guide)[-1])
        page.evaluate("document.querySelector('#view').focus()")
        for _ in range(6):
            key(page, 'ArrowRight', 'ArrowRight')
        stand_in.wait(lambda: end_of_blade(stand_in.of(Guide)[-1])[0] > before[0] + 0.002)
        key(page, 'Escape', 'Escape')
        page.wait(lambda: not page.state()['canGuide'], 'the stop')
        assert stand_in.of(EStop) and not page.state()['cutting']


GAMEPAD = """(() => {
    window.pad = {connected: true, axes: [0, 0, 0, 0],
        buttons: [...Array(16)].map(() => ({pressed: false}))};
    navigator.getGamepads = () => [window.pad];
    window.dispatchEvent(new Event('gamepadconnected'));
})()"""


def test_a_gamepad_moves_cuts_and_stops(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        page.evaluate(GAMEPAD)
        page.evaluate('window.pad.axes[0] = 0.9')
        stand_in.wait(lambda: stand_in.of(Guide))
        stand_in.wait(lambda: stand_in.of(Guide)[-1].position[0] > 0.01)
        page.evaluate('window.pad.axes[0] = 0; window.pad.buttons[0].pressed = true')
        page.wait(lambda: page.state()['cutting'], 'the cut')
        page.evaluate('window.pad.buttons[1].pressed = true')
        stand_in.wait(lambda: stand_in.of(EStop))
        page.wait(lambda: not page.state()['cutting'], 'the stop')


def touch(page: Page, kind: str, *points: np.ndarray) -> None:
    page.call(
        'Input.dispatchTouchEvent',
        type=kind,
        touchPoints=[{'x': p[0], 'y': p[1], 'id': i} for i, p in enumerate(points)],
    )


def test_a_finger_moves_the_blade_above_it_and_a_second_one_cuts(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        top = stand_in.on_top(0.0, 0.0)
        finger = page.pixels(top[None])[0]
        lower = finger + np.array([0.0, 56.0])
        touch(page, 'touchStart', finger)
        stand_in.wait(lambda: stand_in.of(Guide))
        assert not page.state()['cutting']
        touch(page, 'touchMove', lower)
        stand_in.wait(
            lambda: np.allclose(end_of_blade(stand_in.of(Guide)[-1])[:2], top[:2], atol=2e-3)
        )
        touch(page, 'touchStart', lower, finger + np.array([90.0, 80.0]))
        page.wait(lambda: page.state()['cutting'], 'the cut')
        touch(page, 'touchEnd')
        page.wait(lambda: not page.state()['cutting'], 'its end')


def test_goals_come_at_thirty_a_second_at_most_and_none_once_the_force_is_off(
    browser: Browser,
) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        x, y = page.pixels(stand_in.on_top(0.0, 0.0)[None])[0]
        events = f"""new Promise(done => {{
            const view = document.querySelector('#view'), began = performance.now();
            const timer = setInterval(() => {{
                for (let i = 0; i < 5; i += 1) view.dispatchEvent(new PointerEvent('pointermove', {{
                    pointerId: 1, clientX: {x} + 5 * Math.random(), clientY: {y}, bubbles: true}}));
                if (performance.now() - began < 1000) return;
                clearInterval(timer);
                done(performance.now() - began);
            }}, 4);
        }})"""
        took = page.call(
            'Runtime.evaluate', expression=events, awaitPromise=True, returnByValue=True
        )
        most = 30 * took['result']['value'] / 1000 + 2
        assert 3 <= len(stand_in.of(Guide)) <= most
        key(page, 'Escape', 'Escape')
        page.wait(lambda: not page.state()['canGuide'], 'the stop')
        goals = len(stand_in.of(Guide))
        page.mouse('mouseMoved', x, y)
        time.sleep(0.3)
        assert len(stand_in.of(Guide)) == goals
