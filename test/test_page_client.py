"""Claims about the page in a browser: what is pressed arrives, what is said is shown.

The server is the real one; behind it is a session that is none (page_world.py).
"""

import json
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pytest
from page_world import StandIn, guided, key, opened

from bench.page.browser import CHROMIUM, Browser, Page, chromium
from cutting_trainer.viewer.page_protocol import (
    Attempt,
    EStop,
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

SIZES = ((390, 844), (820, 1180), (1280, 800), (2560, 1440), (844, 390))
EVIL = '<img src=x onerror="window.evil=1"><script>window.evil=2</script>'
WHAT_IS_THERE = """(() => {
    const r = document.querySelector('#e-stop').getBoundingClientRect();
    const shares = [0.05, 0.5, 0.95];
    const seen = shares.flatMap(x => shares.map(y => document.elementFromPoint(
        r.x + x * r.width, r.y + y * r.height)?.id ?? ''));
    return {seen, width: r.width, height: r.height, bottom: r.bottom, right: r.right};
})()"""


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    with chromium((1000, 700), coarseness=2) as browser:
        yield browser


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


def stop_by_key(page: Page, stand_in: StandIn, code: str, name: str) -> None:
    before = len(stand_in.of(EStop))
    key(page, code, name)
    stand_in.wait(lambda: len(stand_in.of(EStop)) > before)


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
        # The first picture may take long to draw: until then the page has no news to show.
        page.wait(lambda: not page.state()['stale'], 'the first news')
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
        requests = page.requests()
        assert any(url.endswith('.js') for url in requests)
        for url in requests:
            assert url.startswith(site), url


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


def test_a_lesion_is_drawn_on_the_tissue(browser: Browser) -> None:
    stand_in = StandIn('excision')
    with opened(browser, stand_in) as page:
        page.evaluate("document.querySelector('[data-view=top]').click()")
        stand_in.tip[1] = stand_in.goal[1] = 0.06  # the tool is not over it
        line = np.linspace([-0.002, -0.0052, 0.004], [0.002, -0.0052, 0.004], 15)
        beside = line - [0.0, 0.0016, 0.0]  # between lesion and border

        def darker() -> bool:
            inked, bare = (colours(page, at)[:, 0].mean() for at in (line, beside))
            return bool(bare - inked > 45)

        page.wait(darker, 'the lesion', 20.0)


def drawn(page: Page, points: np.ndarray, beside: float) -> bool:
    """Whether the ink is at these places and not beside them: it is less red than the tissue."""
    inked, bare = (colours(page, at) for at in (points, points - np.array([0.0, beside, 0.0])))
    share = (inked[:, 1] - 0.6 * inked[:, 0]) - (bare[:, 1] - 0.6 * bare[:, 0])
    return bool((share > 12).mean() > 0.6)
