"""Claims about an E-STOP among the messages of a page, over real sockets."""

from contextlib import suppress

import pytest
from websockets.exceptions import ConnectionClosed

from bench.common.waiting import until
from bench.page.open_page import OpenPage
from bench.page.stand_in import StandIn
from cutting_trainer.viewer.access_control import PageLimits

pytestmark = pytest.mark.long


@pytest.mark.parametrize('text', ['{"op": "reset_e_stop"}', '{"op": "e_stop", "x": 1}', 'e_stop'])
def test_what_only_names_e_stop_is_heard_at_the_rate_of_all_else(text: str) -> None:
    stand_in = StandIn(limits=PageLimits(rate=1.0, burst=5.0, flood=100, byte_burst=1e6))
    try:
        page = OpenPage(stand_in.url)
        for _ in range(50):
            page.send(text)
        page.ask('e_stop')
        until(lambda: stand_in.stopped, 'the E-STOP')
        assert stand_in.counts['reset_e_stop'] <= 6 and page.counts['refused'] <= 6
        with suppress(ConnectionClosed):
            for _ in range(60):
                page.send(text)
        page.wait(lambda: page.closed, 'its end')
        page.close()
    finally:
        stand_in.server.stop()


def test_each_e_stop_is_answered_by_the_state_also_where_it_says_the_same() -> None:
    stand_in = StandIn()
    try:
        page = OpenPage(stand_in.url)
        stand_in.server.put('state', state='FAULT', text='', e_stopped=True)
        page.wait(lambda: page.counts['state'] == 1, 'the state')
        page.ask('e_stop')
        page.wait(lambda: page.counts['state'] == 2, 'the answer')
        page.close()
    finally:
        stand_in.server.stop()
