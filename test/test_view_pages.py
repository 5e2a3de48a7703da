"""Claims about what a page's server sends: how much, when, and to whom."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from bench.open_page import PROTOCOL, OpenPage
from session import demo
from tissue_sim.ros import Diagnostics
from viewer.node import name_within
from viewer.page import PageError, addresses, is_local, is_stranger, open_page
from viewer.panel import METHODS
from viewer.stage import TissueView
from viewer.surfaces import lips

pytestmark = pytest.mark.alone

SIDE = 100
"""Squares along an edge of a sheet of 20,000 triangles."""
FRAMES = 240


@pytest.fixture
def server() -> Iterator[Any]:
    server = open_page('127.0.0.1', 0)
    yield server
    server.stop()


def url(server: Any) -> str:
    return addresses(server)


def sheet() -> SimpleNamespace:
    """A tissue as far as it is drawn: a flat sheet."""
    line = np.linspace(0.0, 0.1, SIDE + 1)
    x, y = np.meshgrid(line, line)
    rest = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(SIDE)[:, None] * (SIDE + 1) + np.arange(SIDE)).ravel()
    b, c, d = a + 1, a + SIDE + 1, a + SIDE + 2
    triangles = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    return SimpleNamespace(
        rest=rest,
        displacement=np.zeros_like(rest),
        triangles=triangles,
        triangle_kind=np.zeros(len(triangles), np.uint8),
        revision=0,
    )


def wave(tissue: SimpleNamespace) -> None:
    """The next frame."""
    tissue.revision += 1
    tissue.displacement[:, 2] = 1e-5 * tissue.revision


def shown(view: TissueView, tissue: SimpleNamespace, period: float) -> float:
    """Shows frames one after the other; returns how long the showing took [s]."""
    busy = 0.0
    for _ in range(FRAMES):
        wave(tissue)
        began = time.perf_counter()
        view.show(tissue)
        busy += time.perf_counter() - began
        time.sleep(period)
    return busy


def wait_for_newest(page: OpenPage, tissue: SimpleNamespace) -> None:
    deadline = time.monotonic() + 30
    wanted = np.float32(tissue.displacement[0, 2])
    while page.newest is None or page.newest[0, 2] != wanted:
        assert time.monotonic() < deadline, 'the newest frame never came'
        time.sleep(0.02)


def resident() -> int:
    """Memory of this process [bytes]."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


def test_a_page_that_does_not_read_slows_only_itself_and_then_gets_the_newest(server: Any) -> None:
    tissue, view = sheet(), TissueView(server, '/tissue')
    view.show(tissue)
    fast = OpenPage(url(server))
    wait_for_newest(fast, tissue)
    before = fast.updates
    alone = shown(view, tissue, 0.004)
    wait_for_newest(fast, tissue)
    came = fast.updates - before
    stuck = OpenPage(url(server), reads=False)
    shown(view, tissue, 0.004)  # fills what the sockets hold
    before, held = fast.updates, resident()
    beside = shown(view, tissue, 0.004)
    wait_for_newest(fast, tissue)
    assert resident() - held < FRAMES * tissue.rest.size * 4 / 3  # nothing is kept for it
    assert fast.updates - before > came / 2
    assert beside < 5 * alone + 0.5  # it waits for nobody
    assert stuck.windows == 0
    stuck.read()
    wait_for_newest(stuck, tissue)
    assert stuck.updates < FRAMES  # what lay between was dropped, not kept for it
    fast.close()
    stuck.close()


def test_faces_are_sent_only_when_the_connectivity_changes(server: Any) -> None:
    sent: list[Any] = []
    queue = server._websock_server.queue_message
    server._websock_server.queue_message = lambda message: (sent.append(message), queue(message))
    tissue, view = sheet(), TissueView(server, '/tissue')
    for _ in range(5):
        wave(tissue)
        view.show(tissue)
    view.show(tissue)  # nothing new
    tissue.triangles, tissue.triangle_kind = tissue.triangles + 0, tissue.triangle_kind + 0
    wave(tissue)
    view.show(tissue)  # a whole mesh, with the faces that are known
    tissue.triangles = tissue.triangles[:-10].copy()
    tissue.triangle_kind = np.repeat([0, 1], [len(tissue.triangles) - 50, 50]).astype(np.uint8)
    wave(tissue)
    view.show(tissue)
    updates = [message.updates for message in sent if hasattr(message, 'updates')]
    assert sum('vertices' in update for update in updates) == 6 + 2
    assert sum('faces' in update for update in updates) == 1 + 2
    positions = next(update['vertices'] for update in updates if 'vertices' in update)
    assert positions.dtype == np.float32


def test_a_page_that_comes_late_gets_the_whole_scene(server: Any) -> None:
    tissue, view = sheet(), TissueView(server, '/tissue')
    view.show(tissue)
    wave(tissue)
    view.show(tissue)
    page = OpenPage(url(server))
    wait_for_newest(page, tissue)
    page.close()


def test_page_is_for_this_machine_alone_unless_it_says_otherwise(server: Any) -> None:
    assert url(server).startswith('http://127.0.0.1:')
    assert is_local('127.0.0.1') and is_local('::1') and is_local('localhost')
    assert not is_local('0.0.0.0') and not is_local('192.168.1.4')
    said = addresses(SimpleNamespace(get_host=lambda: '0.0.0.0', get_port=lambda: 8080))
    assert 'without a password' in said


@pytest.mark.parametrize('site', ['http://elsewhere.example', 'http://127.0.0.1:1', 'null'])
def test_another_sites_page_in_the_same_browser_cannot_operate_the_session(
    server: Any, site: Any
) -> None:
    port = server.get_port()
    address = f'ws://127.0.0.1:{port}'
    with pytest.raises(InvalidStatus, match='403'):
        connect(address, subprotocols=[PROTOCOL], origin=site)
    own: Any = f'http://127.0.0.1:{port}'
    connect(address, subprotocols=[PROTOCOL], origin=own).close()


def test_name_of_somebody_else_for_this_machine_is_refused_unless_the_page_is_for_others() -> None:
    headers = {'Host': 'elsewhere.example:8080', 'Origin': 'http://elsewhere.example:8080'}
    assert is_stranger(headers, '127.0.0.1')
    assert not is_stranger(headers, '0.0.0.0')
    assert not is_stranger({'Host': 'localhost:8080', 'Origin': 'http://localhost:8080'}, '::1')


def test_a_port_that_is_taken_is_refused_by_name(server: Any) -> None:
    with pytest.raises(PageError, match=f'port {server.get_port()} .*in use.*--port'):
        open_page('127.0.0.1', server.get_port())


def test_methods_to_choose_from_are_those_of_the_scene() -> None:
    assert {'combined', 'delete'} < set(METHODS)


def test_two_trainers_side_by_side_tell_their_nodes_apart_by_namespace() -> None:
    published: list[Any] = []
    for namespace in ('', 'left', 'right'):
        node: Any = SimpleNamespace(
            get_fully_qualified_name=lambda n=namespace: f'/{n}/bridge'.replace('//', '/'),
            create_publisher=lambda *_: SimpleNamespace(publish=published.append),
            create_timer=lambda *_: None,
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time)),
        )
        Diagnostics(node, lambda: (b'\0', '', {})).publish()
    names = [array.status[0].name for array in published]
    assert names == ['bridge', 'left/bridge', 'right/bridge']
    assert [name_within('', name) for name in names] == names
    assert [name_within('left', name) for name in names] == ['', 'bridge', '']


def test_lips_of_a_cut_are_the_edges_where_it_meets_the_outside() -> None:
    # A flat strip of four triangles, of which the two in the middle are what a cut has opened.
    triangles = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]], np.int32)
    kinds = np.array([0, 1, 1, 0], np.uint8)
    found = lips(triangles, kinds)
    assert {frozenset(map(int, edge)) for edge in found.edges} == {
        frozenset((1, 2)),
        frozenset((3, 4)),
    }
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], float)
    np.testing.assert_allclose(found.points(flat, 0.5), flat[found.edges] + [0.0, 0.0, 0.5])
    assert not len(lips(triangles, 0 * kinds).edges)


def test_demo_serves_its_page_at_a_free_port_where_the_usual_one_is_taken(
    server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, 'PORT', server.get_port())
    assert demo.page_port() == 0
    server.stop()
    assert demo.page_port() == server.get_port()
