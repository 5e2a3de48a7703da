"""Claims about what the page believes of /diagnostics, and about requests that wait."""

import time
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.viewer.diagnostics_table import OWN, Statuses
from cutting_trainer.viewer.node import ViewerNode
from cutting_trainer.viewer.operator_commands import BRIDGE
from cutting_trainer.viewer.page_protocol import Choose, Pause, Scale, Start
from cutting_trainer.viewer.pending_requests import Requests


def array(*names: str, **values: str) -> Any:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticArray(
        status=[DiagnosticStatus(level=b'\0', name=name, values=pairs) for name in names]
    )


def test_a_trainers_nodes_have_their_lines_beside_any_number_of_others() -> None:
    statuses = Statuses('')
    statuses.take(array(*(f'motor {i}' for i in range(32))))
    with pytest.raises(MessageError, match='too many'):
        statuses.take(array('motor 32', *OWN, 'motor 33'))
    names = {state.name for state in statuses.now(time.monotonic())}
    assert names >= OWN and len(names) == 32 + len(OWN)


@pytest.mark.parametrize('rate', ['10 Hz', 'nan', '-1', '1e9'])
def test_a_status_that_is_none_of_ours_takes_no_other_with_it(rate: str) -> None:
    message = array('robot', rate=rate)
    message.status += array(BRIDGE, rate='1000').status
    statuses = Statuses('')
    with pytest.raises(MessageError, match='rate'):
        statuses.take(message)
    assert [state.name for state in statuses.now(time.monotonic())] == [BRIDGE]


def test_force_scale_that_is_shown_follows_what_the_bridge_says() -> None:
    shown: list[float] = []
    node: Any = SimpleNamespace(_statuses=Statuses('left'), _force_scale=1.0)
    node._page = SimpleNamespace(show_scale=shown.append)
    for name, scale in ((BRIDGE, '3'), ('left/robot', '4'), (f'left/{BRIDGE}', '2.5')):
        node._statuses.take(array(name, force_scale=scale))
        ViewerNode._follow_scale(node)
    ViewerNode._follow_scale(node)
    assert shown == [2.5] and node._force_scale == 2.5
    for bad in ('0', 'inf', 'x'):
        with pytest.raises(MessageError, match='force scale'):
            node._statuses.take(array(f'left/{BRIDGE}', force_scale=bad))
    ViewerNode._follow_scale(node)
    assert shown == [2.5]


def test_of_requests_that_wait_the_newest_of_each_kind_is_left_and_none_is_dropped() -> None:
    requests = Requests()
    start, pause = Start(op='start'), Pause(op='pause')
    other = Choose(op='choose', scene='liver', method='delete')
    requests.put(other)
    requests.put(start)
    for value in range(1, 200):
        requests.put(Scale(op='scale', value=value))
    for message in (pause, start):
        requests.put(message)
    assert list(requests.taken()) == [other, Scale(op='scale', value=199), pause, start]
    requests.put(start)
    requests.put(pause)
    waiting = requests.taken()
    assert next(waiting) == start
    requests.clear()
    assert not list(waiting) and not list(requests.taken())
