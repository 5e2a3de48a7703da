"""Claims about the page in a browser: what is pressed arrives, what is said is shown.

The server is the real one; behind it is a session that is none (page_world.py).
"""

import json
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from page_world import StandIn

from bench.page.browser import CHROMIUM, Browser, Page, chromium
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.page_protocol import (
    Attempt,
    EStop,
    Guide,
    Play,
    ResetEStop,
    Seek,
    Watch,
)

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

UP = np.array([0.0, 0.0, 1.0])
SIZES = ((390, 844), (820, 1180), (1280, 800), (2560, 1440), (844, 390))
EVIL = '<img src=x onerror="window.evil=1"><script>window.evil=2</script>'
WATCH = """window.broken = [];
document.addEventListener('securitypolicyviolation', e => window.broken.push(e.blockedURI));
window.addEventListener('error', e => window.broken.push(e.message));"""
WHAT_IS_THERE = """(() => {
    const r = document.querySelector('#e-stop').getBoundingClientRect();
    const shares = [0.05, 0.5, 0.95];
    const seen = shares.flatMap(x => shares.map(y => document.elementFromPoint(
        r.x + x * r.width, r.y + y * r.height)?.id ?? ''));
    return {seen, width: r.width, height: r.height, bottom: r.bottom, right: r.right};
})()"""


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    with chromium((1000, 700)) as browser:
        yield browser


@contextmanager
def opened(browser: Browser, stand_in: StandIn) -> Iterator[Page]:
    """A page on a session, with its picture."""
    with closing(stand_in):
        page = browser.page()
        page.call('Page.addScriptToEvaluateOnNewDocument', source=WATCH)
        page.open(stand_in.url)
        page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
        yield page
        assert page.evaluate('window.broken') == []
        page.open('about:blank')


REACHED = """(() => {
    const at = (x, y) => document.elementFromPoint(x, y);
    const middle = r => [r.x + r.width / 2, r.y + r.height / 2];
    const box = e => e.getBoundingClientRect();
    const buttons = [...document.querySelectorAll('#guide button, #views button')];
    const hidden = buttons.filter(one => at(...middle(box(one))) !== one);
    const view = box(document.querySelector('#view')), shares = [0.35, 0.5, 0.65];
    const covered = shares.flatMap(x => shares.map(y =>
        at(view.x + x * view.width, view.y + y * view.height)?.tagName));
    const panel = [...document.querySelectorAll('#panel button, #panel select, #panel input')];
    const lost = panel.filter(one => one.offsetParent !== null).filter(one => {
        one.scrollIntoView({block: 'center'});
        return at(...middle(box(one))) !== one;
    });
    return {hidden: hidden.map(one => one.innerText), covered, lost: lost.map(one => one.id),
        small: buttons.filter(one => box(one).height < 38).length};
})()"""
NAMELESS = """[...document.querySelectorAll('button, select, input, output, [role]')].filter(one =>
    !(one.innerText || one.ariaLabel || one.title || one.labels?.length || one.closest('[hidden]')
      || ['status', 'alert', 'log'].includes(one.role) || one.tagName === 'OUTPUT')
).map(one => one.outerHTML)"""


def test_every_control_is_reached_and_none_covers_the_tissue_at_every_size(
    browser: Browser,
) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        for width, height in SIZES:
            page.resize(width, height)
            there = page.evaluate(REACHED)
            assert not there['hidden'] and not there['lost'], (width, height, there)
            assert set(there['covered']) <= {'CANVAS', 'MAIN'}, (width, height, there)
            assert not there['small'], (width, height, there)
        page.resize(1000, 700)
        assert page.evaluate(NAMELESS) == []
        assert page.evaluate('document.title') == 'Cutting trainer'
        assert page.evaluate('document.documentElement.lang') == 'en'


def key(page: Page, code: str, name: str) -> None:
    for kind in ('keyDown', 'keyUp'):
        page.call('Input.dispatchKeyEvent', type=kind, code=code, key=name)


def stop_by_key(page: Page, stand_in: StandIn, code: str, name: str) -> None:
    before = len(stand_in.of(EStop))
    key(page, code, name)
    stand_in.wait(lambda: len(stand_in.of(EStop)) > before)


def guided(page: Page) -> np.ndarray:
    """Lets the force in; where the blade is in the window then [pixel]."""
    page.press('start')
    page.wait(lambda: page.state()['canGuide'], 'the hand')
    return np.array(page.state()['tip'])


def test_e_stop_arrives_by_mouse_and_by_key_and_is_in_sight_at_every_size(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        page.press('start')
        page.press('e-stop')
        page.wait(lambda: page.state()['eStopped'], 'the stop')
        assert page.evaluate("document.querySelector('#start').disabled")
        for width, height in SIZES:
            page.resize(width, height)
            page.evaluate("document.querySelector('#panel').scrollTop = 1e6")
            there = page.evaluate(WHAT_IS_THERE)
            assert set(there['seen']) == {'e-stop'}, (width, height, there)
            assert there['width'] >= 100 and there['height'] >= 44
            assert there['bottom'] <= height and there['right'] <= width
        page.resize(1000, 700)
        page.press('reset-e-stop')
        page.wait(lambda: not page.state()['eStopped'], 'the reset')
        assert len(stand_in.of(ResetEStop)) == 1
        for code, name in (('Space', ' '), ('Escape', 'Escape')):
            page.evaluate("document.querySelector('#pause').focus()")  # which Space would press
            stop_by_key(page, stand_in, code, name)
        assert not [message for message in stand_in.asked if message.op == 'pause']


def on_top(stand_in: StandIn, x: float, y: float) -> np.ndarray:
    """A place on the upper side of the block [m]."""
    return np.array([x, y, stand_in.positions[:, 2].max()])


def hovering(page: Page, stand_in: StandIn) -> tuple[np.ndarray, Any, Any]:
    """Lets the blade come over the middle of the block: the place [m], and its x and y [pixel]."""
    guided(page)
    top = on_top(stand_in, 0.0, 0.0)
    x, y = page.pixels(top[None])[0]
    page.mouse('mouseMoved', x, y)
    stand_in.wait(lambda: stand_in.of(Guide))
    return top, x, y


def end_of_blade(goal: Guide) -> np.ndarray:
    """Where the blade ends at a goal [m]: it is upright."""
    return np.array(goal.position) - [0.0, 0.0, 0.004]


def test_blade_follows_the_pointer_and_goes_in_while_the_button_is_held(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        guided(page)
        view = page.state()['camera']
        begin, end = (on_top(stand_in, x, -0.008) for x in (-0.008, 0.008))
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
        goals = len(stand_in.of(Guide))
        page.drag(np.array([[290.0, 520.0], [300.0, 520.0], [360.0, 530.0]]))
        assert page.state()['camera'] != view  # beside the tissue it is one
        assert len(stand_in.of(Guide)) == goals


def test_a_palpator_follows_the_pointer_and_presses_no_deeper_than_it_is_set(
    browser: Browser,
) -> None:
    stand_in = StandIn('lumps')
    with opened(browser, stand_in) as page:
        guided(page)
        place = on_top(stand_in, -0.015, -0.012)
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
        begin, end = (on_top(stand_in, x, -0.008) for x in (-0.008, 0.008))
        places = page.pixels(np.array([begin, end]))
        page.mouse('mouseMoved', *places[0])
        stand_in.wait(lambda: np.allclose(stand_in.tip, begin + 0.008 * UP, atol=1e-3))
        stand_in.stands_still.set()
        page.wait(lambda: page.state()['stale'], 'the age')
        goals = len(stand_in.of(Guide))
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
        begin, end = on_top(stand_in, 0.0, -0.010), on_top(stand_in, 0.0, 0.010)
        places = page.pixels(np.linspace(begin, end, 6))
        page.mouse('mouseMoved', *places[0])
        stand_in.wait(lambda: np.allclose(stand_in.tip[:2], begin[:2], atol=1e-3))
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
        places = [on_top(stand_in, x, 0.0) for x in (-0.022, end.centre[0])]
        for place in places:
            before = len(stand_in.of(Guide))
            page.mouse('mouseMoved', *page.pixels(place[None])[0])
            stand_in.wait(lambda place=place: np.allclose(stand_in.tip[:2], place[:2], atol=1e-3))
        highest = max(goal.position[2] for goal in stand_in.of(Guide)[before:])
        assert places[1][2] + 0.012 < highest < end.centre[2] - end.radius


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
        top = on_top(stand_in, 0.0, 0.0)
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
        x, y = page.pixels(on_top(stand_in, 0.0, 0.0)[None])[0]
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


def test_what_others_wrote_is_shown_as_text_and_nothing_of_it_runs(browser: Browser) -> None:
    rows = [{'name': EVIL, 'level': 1, 'message': EVIL, 'rate': 1.0}]
    says: Any = {
        'hello': {'title': EVIL, 'scenes': [EVIL, 'liver']},
        'nodes': {'rows': rows},
        'session': {'scene': EVIL, 'recording': EVIL, 'scenes': [EVIL]},
        'state': {'text': EVIL},
    }
    stand_in = StandIn('block', **says)
    with opened(browser, stand_in) as page:
        stand_in.server.put('notice', id=1, text=EVIL)
        page.wait(lambda: EVIL in page.state()['notices'], 'the notice')
        for place in ('#nodes', '#state-text', '#title', '#busy', '#notices', '#scene'):
            text = page.evaluate(f'document.querySelector({json.dumps(place)}).textContent')
            assert '<script>' in text, place
        assert page.evaluate('window.evil') is None
        assert not page.evaluate("document.querySelectorAll('body img, body script').length")


def test_a_refusal_is_said(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        page.evaluate("""(s => { s.max = 99; s.value = 50;
            s.dispatchEvent(new Event('change')); })(document.querySelector('#scale'))""")
        page.wait(lambda: page.says('force scale is from 0.1 to 3'), 'the refusal')


def test_a_lost_connection_is_said_and_the_stop_pressed_meanwhile_arrives_first(
    browser: Browser,
) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        port = stand_in.server.port
        guided(page)
        stand_in.stop()
        page.wait(lambda: page.says('Connection lost'), 'the banner')
        assert page.evaluate("document.querySelector('#pause').disabled")
        page.press('e-stop')
        page.wait(lambda: page.says('E-STOP NOT SENT'), 'the warning')
        with closing(StandIn('block', port=port)) as again:
            page.wait(lambda: page.state()['connection'] == 'open', 'the connection')
            again.wait(lambda: again.asked)
            assert isinstance(again.asked[0], EStop)
            page.wait(lambda: page.state()['eStopped'], 'the stop')
            assert not page.says('Connection lost')
            page.press('reset-e-stop')  # the page does not press again what it has heard to hold
            page.wait(lambda: not page.state()['eStopped'], 'the reset')
            count = len(again.of(EStop))
            time.sleep(1.0)
            assert len(again.of(EStop)) == count and not again.e_stopped


def test_news_that_is_old_is_called_old(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        assert not page.state()['stale']
        stand_in.stands_still.set()
        page.wait(lambda: page.says('No news from the session'), 'the banner')
        assert page.state()['connection'] == 'open'
        stand_in.stands_still.clear()
        page.wait(lambda: not page.says('No news from the session'), 'its end')


def test_replay_plays_and_goes_to_a_time_and_names_both_tissues(browser: Browser) -> None:
    stand_in = StandIn('block', 'replay')
    with opened(browser, stand_in) as page:
        assert page.says('recorded') and page.says('tougher')
        assert not page.says('E-STOP')
        assert set(page.state()['parts']) == {'tissue', 'computed'}
        page.press('play')
        stand_in.wait(lambda: stand_in.of(Play))
        page.slide('seek', 0.25)
        stand_in.wait(lambda: stand_in.of(Seek))
        assert stand_in.of(Seek)[-1].time == pytest.approx(5.0, abs=0.7)
        page.wait(lambda: page.evaluate("document.querySelector('#play').innerText") == 'Pause', '')


def test_page_asks_only_this_server_for_what_it_shows(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        page.state()
        site = stand_in.url.partition('/?')[0]
        assert page.requests
        for url in page.requests:
            assert url.startswith((site, site.replace('http', 'ws'), 'about:')), url


TASK = """(() => {
    const box = e => e.getBoundingClientRect();
    const task = document.querySelector('#task'), one = box(task);
    const view = box(document.querySelector('#view'));
    const apart = one.bottom <= view.top + 1 || one.top >= view.bottom - 1
        || one.right <= view.left + 1 || one.left >= view.right - 1;
    const seen = [...task.children].filter(e => e.offsetHeight).map(e => {
        e.scrollIntoView({block: 'center'});
        const {x, y, width, height} = box(e);
        return task.contains(document.elementFromPoint(x + width / 2, y + height / 2));
    });
    return {apart, seen, wide: task.scrollWidth > task.clientWidth, text: task.innerText};
})()"""


@pytest.mark.parametrize('mode', ['live', 'replay'])
def test_exercise_is_read_at_every_size_and_stands_beside_the_picture(
    browser: Browser, mode: str
) -> None:
    stand_in = StandIn('vessel', mode)
    if mode == 'live':
        reason = 'peak force: 5.2 N; full marks at 2.5 N, none at 5 N: -7.1 points, and more words'
        stand_in.server.put(
            'attempt',
            rows=[{'name': 'peak force', 'value': '5.2 N', 'over': True}] * 5,
            score={'points': 61, 'passed': False, 'reasons': [reason] * 6},
            bridge=None,
        )
    with opened(browser, stand_in) as page:
        for width, height in SIZES:
            page.resize(width, height)
            there = page.evaluate(TASK)
            assert there['apart'] and not there['wide'], (width, height, there)
            assert there['seen'] and all(there['seen']), (width, height, there)
            assert 'Beside a vessel' in there['text'] and '120 s' in there['text']
            assert ('▲ 5.2 N' in there['text']) == (mode == 'live')
            assert ('✕ not passed: 61 of 100 points' in there['text']) == (mode == 'live')
            assert 'do not cut' in there['text'] and 'lesion' not in there['text']
        page.resize(1000, 700)
        assert page.says('start') and page.says('end')


def test_the_place_that_still_holds_a_lesion_is_ringed_until_it_is_cut(browser: Browser) -> None:
    stand_in = StandIn('excision')
    with closing(stand_in), opened(browser, stand_in) as page:
        assert page.state()['bridge'] is None and not page.says('still attached')
        for place in ([0.016, 0.0, 0.004], [0.0, 0.011, 0.002], None):
            stand_in.server.put('attempt', rows=[], score=None, bridge=place)
            page.wait(lambda place=place: page.state()['bridge'] == place, 'the ring')
            page.wait(lambda place=place: page.says('still attached') == bool(place), 'the label')


def test_exercise_is_begun_for_a_subject_and_two_attempts_are_opened_side_by_side(
    browser: Browser,
) -> None:
    with closing(StandIn()) as stand_in, opened(browser, stand_in) as page:
        rows = "[...document.querySelectorAll('#attempts tr')].map(row => row.cells[2].innerText)"
        page.wait(lambda: len(page.evaluate(rows)) == 3, 'the attempts')
        assert page.evaluate(rows) == ['broken off', '✓ 91.3', '✕ 40.0']
        assert page.evaluate("document.querySelector('#watch').disabled")
        page.evaluate("document.querySelector('#subject').value = 'p 01 <b>'")
        page.press('begin')
        page.evaluate("document.querySelector('#subject').value = 'p-01'")
        page.press('begin')
        (asked,) = stand_in.wait(lambda: stand_in.of(Attempt))
        assert (asked.scene, asked.subject) == ('circle', 'p-01')
        for bag in ('circle-1', 'circle-3', 'circle-2'):  # no more than two are compared
            page.evaluate(f"""document.querySelector('#attempts [value="{bag}"]').click()""")
        assert page.evaluate("document.querySelector('#watch').innerText") == 'Compare the replays'
        page.evaluate('window.open = () => null')  # as where the browser lets no window open
        page.press('watch')
        (watched,) = stand_in.wait(lambda: stand_in.of(Watch))
        assert watched.bags == ['circle-3', 'circle-2']
        link = "document.querySelector('#replay:not([hidden])')?.href"
        assert page.wait(lambda: page.evaluate(link), 'the link').endswith('&replay')


def test_another_hello_changes_the_exercises_on_offer_and_not_the_scene_in_the_title(
    browser: Browser,
) -> None:
    shown = "[...document.querySelectorAll('#exercise option')].map(option => option.text)"
    title = "document.querySelector('#title').textContent"
    offers = [{'name': name, 'title': name.upper()} for name in ('circle', 'pad')]
    stand_in = StandIn(hello={'exercises': offers})
    with opened(browser, stand_in) as page:
        page.wait(lambda: page.evaluate(shown) == ['CIRCLE', 'PAD'], 'two exercises')
        page.wait(lambda: page.evaluate(title) == 'liver · combined', 'the title')
        stand_in.greet(exercises=offers[:1])
        page.wait(lambda: page.evaluate(shown) == ['CIRCLE'], 'one exercise')
        assert page.evaluate(title) == 'liver · combined'


def test_page_without_an_exercise_shows_none(browser: Browser) -> None:
    stand_in = StandIn('block')
    with opened(browser, stand_in) as page:
        assert page.evaluate("document.querySelector('#task').hidden")
        assert not page.evaluate("document.querySelectorAll('.label.above').length")


def colours(page: Page, points: np.ndarray) -> np.ndarray:
    """Mean colour of the picture around places [m]."""
    picture = page.picture().astype(float)
    places = np.rint(page.pixels(points)).astype(int)
    return np.array([picture[y - 1 : y + 2, x - 1 : x + 2].mean(axis=(0, 1)) for x, y in places])


@pytest.mark.parametrize(
    ('scene', 'line', 'beside'),
    [
        ('pad', [[0.0215, 0.0015], [0.0255, 0.0015]], 0.006),  # beside its dashes, in the band
        ('vessel', [[-0.024, 0.005], [0.024, 0.005]], -0.006),  # in its hatching
    ],
)
def test_target_and_zone_are_drawn_on_the_tissue_and_move_with_it(
    browser: Browser, scene: str, line: list[list[float]], beside: float
) -> None:
    stand_in = StandIn(scene)
    top = float(stand_in.positions[:, 2].max())
    points = np.array([[*np.array(line[0]) * (1 - s) + np.array(line[1]) * s, top]
                       for s in np.linspace(0.0, 1.0, 15)])  # fmt: skip
    with opened(browser, stand_in) as page:
        page.evaluate("document.querySelector('[data-view=top]').click()")
        stand_in.tip[1] = stand_in.goal[1] = 0.05  # the tool is not over it
        for shift in (0.0, 0.008):
            stand_in.move(shift)
            page.wait(
                partial(drawn, page, points + np.array([0.0, shift, 0.0]), beside),
                f'the ink {1000 * shift} mm along y',
            )


def drawn(page: Page, points: np.ndarray, beside: float) -> bool:
    """Whether the ink is at these places and not beside them: it is less red than the tissue."""
    inked, bare = (colours(page, at) for at in (points, points - np.array([0.0, beside, 0.0])))
    share = (inked[:, 1] - 0.6 * inked[:, 0]) - (bare[:, 1] - 0.6 * bare[:, 0])
    return bool((share > 12).mean() > 0.6)
