"""Claims about access: axe-core finds no serious fault of the page at any size of window."""

from contextlib import closing
from typing import Any

import pytest
from independent_readers import installed
from page_world import StandIn

from bench.page.browser import CHROMIUM, Page, chromium

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(
        CHROMIUM is None, reason='chromium is not installed: sudo apt install chromium'
    ),
]

SIZES = ((390, 844), (820, 1180), (1280, 800), (2560, 1440))
SERIOUS = ('serious', 'critical')
FAULTS = """axe.run({resultTypes: ['violations']}).then(({violations}) => violations.map(
    ({id, impact, nodes}) => ({id, impact, where: nodes.map(({target}) => target.join(' '))})))"""


def faults(page: Page) -> list[tuple[str, Any]]:
    """Serious faults of access: rule and elements."""
    found = page.evaluate(FAULTS)
    return [(one['id'], one['where']) for one in found if one['impact'] in SERIOUS]


@pytest.mark.parametrize('of', ['live', 'instructor', 'replay'])
def test_no_serious_fault_of_access_at_any_size(of: str) -> None:
    axe = (installed('axe') / 'node_modules' / 'axe-core' / 'axe.min.js').read_text()
    mode = 'replay' if of == 'replay' else 'live'
    stand_in = StandIn('vessel', mode)
    stand_in.clutched = True
    score = {'points': 61, 'passed': False, 'reasons': ['peak force: 5.2 N']}
    rows = [{'name': 'peak force', 'value': '5.2 N', 'over': True}]
    if mode == 'live':
        stand_in.server.put('attempt', rows=rows, score=score, bridge=None)
    with closing(stand_in), chromium(SIZES[0]) as browser:
        page = browser.page(stand_in.instructor if of == 'instructor' else stand_in.url)
        page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
        if mode == 'live':
            page.press('start')
            page.wait(lambda: page.state()['state'] == 'ENABLED', 'the force')
        page.evaluate(axe)
        for size in SIZES:
            page.resize(*size)
            assert faults(page) == [], size
        page.evaluate("document.querySelector('#hud-force').parentElement.role = 'nonsense'")
        assert 'aria-roles' in dict(faults(page))  # it does look
