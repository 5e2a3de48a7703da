"""Claims about what pages may say, by the pure parts: protocol, controls, gate, newest values."""

import json
import math
import queue
import random
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.datastructures import Headers

from bench.page.fuzz_socket import text
from bench.page.stand_in import CONTROLS, GATE, INSTRUCTORS, TOKEN, VALID
from cutting_trainer.viewer.access_control import Bucket, PageError, is_local, link, make_gate
from cutting_trainer.viewer.allowed_requests import ReplayControls
from cutting_trainer.viewer.live_page import plain
from cutting_trainer.viewer.page_protocol import ProtocolError, parse
from cutting_trainer.viewer.page_state import PageState, ReceivedVersions, TissueFrame
from cutting_trainer.viewer.pending_requests import taken

REPLAYED: dict[str, dict[str, Any]] = {
    'play': {'on': True},
    'seek': {'time': 1.0},
    'speed': {'value': 2.0},
}
FAR = [0.0, 0.0, 0.3]
TURN = [1.0, 0.0, 0.0, 0.0]
WRONG: list[Any] = [
    ('e_stop', {'update_cb': []}),
    ('e_stop', {'removed': True}),
    ('start', {'disabled': False}),
    ('record', {'on': 1}),
    ('record', {'on': 'true'}),
    ('record', {}),
    ('choose', {'scene': 'x' * 200_000, 'method': 'delete'}),
    ('choose', {'scene': '', 'method': 'delete'}),
    ('choose', {'scene': 'liver'}),
    ('hold', {}),
    ('hold', {'on': 1}),
    ('tissue', {'stiffness': 1.0}),
    ('tissue', {'stiffness': 1.0, 'toughness': math.nan}),
    ('tissue', {'stiffness': 1.0, 'toughness': 0.0}),
    ('scale', {'value': math.nan}),
    ('scale', {'value': math.inf}),
    ('scale', {'value': '1'}),
    ('scale', {'value': True}),
    ('scale', {'value': -1.0}),
    ('guide', {'position': [0.0, 0.0], 'wxyz': TURN}),
    ('guide', {'position': [0.0, 0.0, math.nan], 'wxyz': TURN}),
    ('guide', {'position': [0.0, 0.0, 1e308], 'wxyz': TURN}),
    ('guide', {'position': [0.0, 0.0, 0.0], 'wxyz': [0.0, 0.0, 0.0, 0.0]}),
    ('guide', {'position': [0.0, 0.0, 0.0], 'wxyz': [0.7, 0.7, 0.7, 0.7]}),
    ('guide', {'position': [0.0, 0.0, 0.0], 'wxyz': TURN, 'frame': 'tissue'}),
    ('ping', {'id': -1}),
    ('ping', {'id': 2**60}),
    ('ping', {'id': 1.5}),
    ('seek', {'time': 0.5}),
    ('share', {}),
    (None, {}),
    (['start'], {}),
]


def said(op: object, **fields: object) -> str:
    return json.dumps({'op': op, **fields})


@pytest.mark.parametrize('op', VALID)
def test_each_control_has_one_message_that_is_allowed(op: str) -> None:
    message = parse(said(op, **VALID[op]), 'live')
    assert message.op == op
    assert CONTROLS.refusal(message) == ''


@pytest.mark.parametrize('op', INSTRUCTORS)
def test_what_the_instructor_has_is_refused_to_all_others(op: str) -> None:
    message = parse(said(op, **INSTRUCTORS[op]), 'live')
    assert CONTROLS.refusal(message, 'instructor') == ''
    assert 'instructor' in CONTROLS.refusal(message)


def test_what_the_instructor_has_paused_no_trainee_begins_and_every_stop_is_heard() -> None:
    held = replace(CONTROLS, held=True)
    for op in ('start', 'reset', 'record', 'choose', 'attempt', 'scale', 'guide'):
        message = parse(said(op, **VALID[op]), 'live')
        assert 'instructor' in held.refusal(message)
        assert bool(held.refusal(message, 'instructor')) == (op in ('start', 'guide'))
    for op in ('e_stop', 'reset_e_stop', 'pause'):
        assert held.refusal(parse(said(op), 'live')) == ''
    going_on = parse(said('hold', on=False), 'live')
    assert held.refusal(going_on, 'instructor') == '' and held.refusal(going_on)


def test_the_instructor_watches_and_moves_no_tool() -> None:
    message = parse(said('guide', **VALID['guide']), 'live')
    assert CONTROLS.refusal(message) == ''
    assert 'watches' in CONTROLS.refusal(message, 'instructor')


@pytest.mark.parametrize('factor', [0.4, 2.1])
def test_a_tissue_that_is_not_on_offer_is_refused(factor: float) -> None:
    for name in INSTRUCTORS['tissue']:
        message = parse(said('tissue', **(INSTRUCTORS['tissue'] | {name: factor})), 'live')
        assert '0.5 to 2' in CONTROLS.refusal(message, 'instructor')


@pytest.mark.parametrize(('op', 'fields'), WRONG)
def test_what_no_page_says_is_refused(op: object, fields: dict[str, object]) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse(said(op, **fields), 'live')
    assert len(str(caught.value)) < 100


@pytest.mark.parametrize('raw', ['', 'null', '[]', '"start"', '{', '[' * 900, '{"op":' * 300, '\0'])
def test_text_that_is_no_message_is_refused(raw: str) -> None:
    with pytest.raises(ProtocolError):
        parse(raw, 'live')


@pytest.mark.parametrize('op', REPLAYED)
def test_a_recorded_session_has_controls_of_its_own(op: str) -> None:
    controls = ReplayControls(10.0, (1.0, 2.0))
    assert controls.refusal(parse(said(op, **REPLAYED[op]), 'replay')) == ''
    assert controls.refusal(parse(said('seek', time=11.0), 'replay'))
    assert controls.refusal(parse(said('speed', value=3.0), 'replay'))
    with pytest.raises(ProtocolError):
        parse(said('start'), 'replay')


@given(st.integers(0, 2**64))
def test_whatever_is_said_becomes_a_message_of_the_list_or_a_refusal(seed: int) -> None:
    raw = text(random.Random(seed))
    try:
        message = parse(raw, 'live')
    except ProtocolError:
        return
    known = json.loads(raw)
    assert set(message.model_fields_set) == set(known)
    CONTROLS.refusal(message)


@pytest.mark.parametrize(
    ('controls', 'op'),
    [
        (replace(CONTROLS, session=False), 'record'),
        (replace(CONTROLS, session=False), 'choose'),
        (replace(CONTROLS, busy='The nodes start again ...'), 'reset'),
        (replace(CONTROLS, busy='The nodes start again ...'), 'choose'),
        (replace(CONTROLS, can_guide=False), 'guide'),
        (replace(CONTROLS, bounds=None), 'guide'),
        (replace(CONTROLS, e_stopped=True), 'start'),
        (replace(CONTROLS, recording=True), 'record'),
    ],
)
def test_a_control_that_is_off_does_not_act_by_message(controls: Any, op: str) -> None:
    why = controls.refusal(parse(said(op, **VALID[op]), 'live'))
    assert why.endswith('.') and len(why) < 100
    for always in ('e_stop', 'reset_e_stop', 'pause'):
        assert controls.refusal(parse(said(always), 'live')) == ''


@pytest.mark.parametrize(
    ('op', 'fields'),
    [
        ('choose', {'scene': '../../etc/passwd', 'method': 'delete'}),
        ('choose', {'scene': '/etc/passwd', 'method': 'delete'}),
        ('choose', {'scene': 'liver', 'method': '__class__'}),
        ('scale', {'value': 50.0}),
        ('scale', {'value': 0.01}),
        ('guide', {'position': FAR, 'wxyz': TURN}),
    ],
)
def test_a_value_that_is_not_on_offer_is_refused(op: str, fields: dict[str, Any]) -> None:
    why = CONTROLS.refusal(parse(said(op, **fields), 'live'))
    assert why
    assert 'passwd' not in why and 'class' not in why


def headers(host: str, origin: str = '') -> Headers:
    found = Headers(Host=host)
    if origin:
        found['Origin'] = origin
    return found


PATH = f'/session?token={TOKEN}'


@pytest.mark.parametrize(
    ('host', 'origin', 'path', 'lets_in'),
    [
        ('127.0.0.1:8080', 'http://127.0.0.1:8080', PATH, True),
        ('localhost:8080', 'http://localhost:8080', PATH, True),
        ('LOCALHOST:9000', 'http://localhost:9000', PATH, True),  # a tunnel at another port
        ('[::1]:8080', 'http://[::1]:8080', PATH, True),
        ('127.0.0.1:8080', '', PATH, True),  # no browser
        ('127.0.0.1:8080', 'https://127.0.0.1:8080', PATH, True),  # TLS of a tunnel
        ('127.0.0.1:8080', 'http://127.0.0.1:8081', PATH, False),
        ('127.0.0.1:8080', 'http://elsewhere.example', PATH, False),
        ('127.0.0.1:8080', 'null', PATH, False),
        ('127.0.0.1:8080', 'file://127.0.0.1:8080', PATH, False),
        ('elsewhere.example:8080', 'http://elsewhere.example:8080', PATH, False),  # rebound name
        ('elsewhere.example@127.0.0.1:8080', '', PATH, False),
        ('127.0.0.1.elsewhere.example', '', PATH, False),
        ('127.0.0.1:x', '', PATH, False),
        ('', '', PATH, False),
        ('127.0.0.1:8080', '', '/session', False),
        ('127.0.0.1:8080', '', '/session?token=', False),
        ('127.0.0.1:8080', '', f'/session?token={TOKEN}x', False),
        ('127.0.0.1:8080', '', f'/session?token=x&token={TOKEN}', False),
        ('127.0.0.1:8080', '', '/session?' + 'a=1&' * 100 + f'token={TOKEN}', False),
    ],
)
def test_gate_knows_its_names_its_own_pages_and_its_token(
    host: str, origin: str, path: str, lets_in: bool
) -> None:
    assert (GATE.refusal(path, headers(host, origin)) is None) == lets_in


def test_each_role_has_a_token_of_its_own() -> None:
    assert GATE.token != GATE.instructor_token
    asked = headers('127.0.0.1:8080')
    for role, own, other in (
        ('trainee', GATE.token, GATE.instructor_token),
        ('instructor', GATE.instructor_token, GATE.token),
    ):
        assert GATE.refusal(f'/session?token={own}', asked, role) is None  # type: ignore[arg-type]
        assert GATE.refusal(f'/session?token={other}', asked, role)  # type: ignore[arg-type]
    assert link('::1', 80, [], 'T', 'instructor') == 'http://[::1]:80/instructor?token=T'


def test_gate_refuses_a_request_with_two_hosts() -> None:
    two = headers('127.0.0.1')
    two['Host'] = 'elsewhere.example'
    assert not GATE.knows(two)


def test_others_get_in_by_names_that_were_given_and_with_a_token_only() -> None:
    with pytest.raises(PageError, match='--allow-host'):
        make_gate('0.0.0.0', [])
    for wrong in ('http://trainer.lan', 'trainer.lan:8080', 'a/b', ''):
        with pytest.raises(PageError, match='no name of a host'):
            make_gate('0.0.0.0', [wrong])
    gate = make_gate('0.0.0.0', ['trainer.lan', '192.168.1.4'])
    assert len(gate.token) >= 32 and gate.token != make_gate('0.0.0.0', ['a']).token
    path = f'/session?token={gate.token}'
    for host, lets_in in (('trainer.lan', True), ('192.168.1.4', True), ('192.168.1.5', False)):
        asked = headers(f'{host}:8080', f'http://{host}:8080')
        assert (gate.refusal(path, asked) is None) == lets_in
    assert gate.refusal('/session', headers('trainer.lan:8080'))
    assert link('0.0.0.0', 8080, ['trainer.lan'], 'T') == 'http://trainer.lan:8080/?token=T'
    assert link('::1', 8080, [], 'T') == 'http://[::1]:8080/?token=T'


def test_addresses_of_this_machine_are_told_from_others() -> None:
    assert all(map(is_local, ('127.0.0.1', '::1', 'localhost')))
    assert not any(map(is_local, ('0.0.0.0', '192.168.1.4', 'trainer.lan')))


def test_bucket_lets_a_burst_and_then_its_rate_through() -> None:
    bucket = Bucket(10.0, 5.0)
    assert sum(bucket.take(1.0, 100.0) for _ in range(100)) == 5
    assert sum(bucket.take(1.0, 100.0 + 0.01 * i) for i in range(1, 201)) == 20
    assert not bucket.take(6.0, 1e6)


def frame(revision: int, faces_revision: int) -> TissueFrame:
    at = np.full((3, 3), revision, np.float32), np.zeros((0, 3), np.float32)
    faces = np.array([[0, 1, 2]], np.uint32), np.zeros((0, 3), np.uint32)
    return TissueFrame('tissue', revision, faces_revision, at, faces)


def test_a_page_is_owed_the_newest_of_what_it_has_not_had_and_faces_once() -> None:
    state, seen = PageState(), ReceivedVersions()
    state.put('state', 'old')
    state.put('state', 'new')
    for revision in range(5):
        state.put('tissue', frame(revision, 1))
    assert list(state.due(seen)) == ['new', frame(4, 1).whole]
    assert not list(state.due(seen))
    assert not state.put('state', 'new')
    state.put('tissue', frame(5, 1))
    assert list(state.due(seen)) == [frame(5, 1).moved]
    state.put('tissue', frame(6, 2))
    state.put('tissue', frame(7, 2))
    assert list(state.due(seen)) == [frame(7, 2).whole]
    assert list(state.due(ReceivedVersions())) == ['new', frame(7, 2).whole]  # one that comes late


def test_text_for_pages_names_files_without_their_folders() -> None:
    said = 'cannot read /home/somebody/scenes/liver.yaml: no such file\n\x1b[31m'
    assert plain(said) == 'cannot read liver.yaml: no such file  [31m'
    assert plain('refused arm/measured_cp, 3 N/m') == 'refused arm/measured_cp, 3 N/m'
    assert len(plain('x' * 100_000)) <= 300


def test_taking_what_waits_never_waits_though_two_threads_take() -> None:
    things: queue.SimpleQueue[int] = queue.SimpleQueue()
    found: list[int] = []
    ends = threading.Event()

    def take() -> None:
        while not ends.is_set():
            found.extend(taken(things))

    threads = [threading.Thread(target=take) for _ in range(2)]
    for thread in threads:
        thread.start()
    for number in range(20_000):
        things.put(number)
    ends.set()
    for thread in threads:
        thread.join(10.0)
        assert not thread.is_alive()
    found.extend(taken(things))
    assert sorted(found) == list(range(20_000))
