"""Claims about the launcher behind a page: what it does for lines, and what it tells back."""

import json
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from cutting_trainer.session.node_commands import RECORDER_NODE, TISSUE_NODE, VIEWER_NODE
from cutting_trainer.session.node_process import parse_message
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.supervisor import Event
from cutting_trainer.session.view_command import ViewOptions, _Session, run_view
from cutting_trainer.viewer.access_control import TOKEN_VARIABLE, PageError

pytestmark = pytest.mark.long

SCENE = load_scene('block')
OPTIONS = ViewOptions('block', '127.0.0.1', 0, attach=False, seed=0, domain='free')


class Launched:
    """A session without nodes: what was started, ended and answered."""

    def __init__(self, folder: Path) -> None:
        self.replaced: list[Any] = []
        self.answers: list[dict[str, str]] = []
        self.terminal = Console(
            record=True, quiet=False, width=300, file=(folder / 'said').open('w')
        )
        self.session = _Session(SCENE, OPTIONS, folder, self.terminal)
        self._supervisor: Any = SimpleNamespace(
            replace=lambda commands: (self.replaced.append(commands), True)[1],
            remove=lambda names: None,
            answer=lambda name, text: self.answers.append(json.loads(text)),
        )
        self._tell = self.session.event_handler(SessionProgress(self.terminal, 1))

    def line(self, text: str) -> None:
        """A line `message: ...` of the viewer."""
        if (content := parse_message(text)) is not None:  # else the supervisor counts it
            self._tell(Event('message', VIEWER_NODE, text, content))
        self.session.serve(self._supervisor)


@pytest.fixture
def launched(tmp_path: Path) -> Launched:
    return Launched(tmp_path)


@pytest.mark.parametrize(
    'line',
    [
        '{',
        '[' * 60_000,
        '[1]',
        'x' * 70_000,
        '{"ask": "restart", "scene": "' + 'x' * 200_000 + '"}',
        '{"ask": "restart", "scene": "../../etc/passwd"}',
        '{"ask": "restart", "scene": "/etc/passwd"}',
        '{"ask": "restart", "scene": ["block"]}',
        '{"ask": "restart", "scene": "block", "method": "__class__"}',
        '{"ask": "restart", "method": {"a": 1}}',
        '{"ask": "restart", "tissue": {"stiffness": 1.5}}',
        '{"ask": "restart", "tissue": {"stiffness": 9, "toughness": 1}}',
        '{"ask": "restart", "tissue": {"stiffness": NaN, "toughness": 1}}',
        '{"ask": "restart", "tissue": [1, 1]}',
        '{"ask": "record"}',
        '{"ask": "record", "on": "yes"}',
        '{"ask": ["restart"]}',
        '{"page": {"a": "[red]"}}',
    ],
)
def test_no_line_ends_a_session_or_starts_what_is_not_on_offer(
    launched: Launched, line: str
) -> None:
    launched.line(line)
    assert not launched.replaced
    for answer in launched.answers:
        assert len(json.dumps(answer)) < 1000
        assert answer['scene'] == 'block'
        assert 'passwd' not in answer['problem'] and 'class' not in answer['problem']
    launched.line('{"ask": "restart"}')
    assert TISSUE_NODE in {command.name for command in launched.replaced[-1]}


def test_scene_of_the_list_is_begun_and_said(launched: Launched) -> None:
    launched.line('{"ask": "restart", "scene": "liver", "method": "delete"}')
    assert launched.answers[-1]['scene'] == 'liver'
    launched.line('{"ask": "restart", "method": "delete"}')
    assert launched.answers[-1]['method'] == 'delete'
    assert not any(answer['problem'] for answer in launched.answers)


def test_another_tissue_is_that_of_its_scene_times_factors_in_every_region(
    launched: Launched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        'cutting_trainer.session.view_command.new_bag', lambda *_: tmp_path / 'bags' / 'pad-1'
    )

    def of(file: Path) -> tuple[float, ...]:
        tissue = load_scene(str(file)).tissue
        (fat,) = tissue.regions
        skin = tissue.material
        return skin.youngs_modulus, fat.youngs_modulus or 0, skin.toughness, fat.toughness or 0

    own = np.array(of(load_scene('pad').path))
    launched.line('{"ask": "attempt", "scene": "pad", "subject": "p-01"}')
    tissue = {'stiffness': 1.5, 'toughness': 0.5}
    launched.line(json.dumps({'ask': 'restart', 'tissue': tissue}))
    file = tmp_path / 'pad-stiffness-1.5-toughness-0.5.yaml'
    for again in (False, True):
        *_, nodes, recorder = launched.replaced
        assert all(str(file) in ' '.join(command.argv) for command in nodes)
        assert of(file) == pytest.approx(own * [1.5, 1.5, 0.5, 0.5])
        assert f'scene:="{file}"' in ' '.join(recorder[0].argv)  # of an exercise of its own
        assert launched.answers[-1]['scene'] == 'pad' and launched.answers[-1]['tissue'] == tissue
        if not again:
            launched.line('{"ask": "restart"}')
    launched.line('{"ask": "attempt", "scene": "pad", "subject": "p-01"}')
    *_, nodes, recorder = launched.replaced
    assert not any(str(file) in ' '.join(command.argv) for command in [*nodes, *recorder])
    assert launched.answers[-1]['tissue'] == {'stiffness': 1.0, 'toughness': 1.0}
    launched.line(json.dumps({'ask': 'restart', 'tissue': tissue}))
    launched.line('{"ask": "restart", "scene": "liver", "method": "combined"}')
    assert launched.answers[-1]['tissue'] == {'stiffness': 1.0, 'toughness': 1.0}
    assert not any(answer['problem'] for answer in launched.answers)


def test_recording_is_named_without_its_folders(
    launched: Launched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        'cutting_trainer.session.view_command.new_bag', lambda *_: tmp_path / 'block-1'
    )
    launched.line('{"ask": "record", "on": true}')
    assert [command.name for command in launched.replaced[-1]] == [RECORDER_NODE]
    assert launched.answers[-1]['recording'] == 'block-1'


def test_viewer_reads_a_scene_only_once_it_or_the_nodes_have_started(
    launched: Launched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        'cutting_trainer.session.view_command.new_bag', lambda *_: tmp_path / 'block-1'
    )

    def told(ask: str) -> list[str]:
        count = len(launched.answers)
        launched.line(ask)
        return [answer['scene_file'] for answer in launched.answers[count:]]

    block, liver = str(SCENE.path), str(load_scene('liver').path)
    assert told('{"ask": "state"}') == [block]
    assert told('{"ask": "record", "on": true}') == ['', '']  # it would undo the force scale
    assert told('{"ask": "restart", "scene": "/etc/passwd"}') == ['']
    assert told('{"ask": "restart", "scene": "liver"}') == ['', '', liver]
    assert told('{"ask": "record", "on": false}') == ['', '']
    assert told('{"ask": "restart"}') == ['', liver]  # the file may have been changed
    assert told('{"ask": "state"}') == [liver]


def test_requests_that_come_faster_than_they_are_done_are_bounded(launched: Launched) -> None:
    for _ in range(1000):
        launched._tell(Event('message', VIEWER_NODE, '', {'ask': 'record', 'on': False}))
    assert len(launched.session._asked) <= 16


def test_page_for_others_without_a_name_is_refused_before_anything_starts() -> None:
    for host in ('0.0.0.0', '::', '192.168.1.4'):
        options = ViewOptions('block', host, 0, attach=True, seed=0, domain=0)
        with pytest.raises(PageError, match='--allow-host'):
            run_view(options)


def test_lines_for_the_launcher_that_are_broken_or_no_objects_are_nothing() -> None:
    for line in (
        '',
        '{',
        '[]',
        '[' * 100_000,
        '"ask"',
        '{"ask": "restart", "scene": "' + 'x' * 70_000,
    ):
        assert parse_message(line) is None
    assert parse_message('{"ask": "state"}') == {'ask': 'state'}


class Ended:
    """A program of the trainer that has ended with an output."""

    def __init__(self, status: int, output: str) -> None:
        self.status, self._output, self.ended = status, output.encode(), False

    def output(self) -> bytes:
        return self._output

    def end(self) -> None:
        self.ended = True


def row(number: int, state: str = 'scored') -> dict[str, Any]:
    about = {'subject': 'p-01', 'exercise': 'vessel', 'attempt': number, 'begun': float(number)}
    return about | {'bag': f'/secret/vessel-{number}', 'state': state, 'points': 1, 'passed': True}


def test_attempts_are_told_newest_first_without_folders_and_their_replay_is_served_beside(
    launched: Launched, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []
    rows = json.dumps([row(1), row(2, 'bag is gone'), row(3)])
    monkeypatch.setenv(TOKEN_VARIABLE, 'of-this-test')

    def program(*words: str) -> Any:
        asked.append(words)
        return Ended(0, rows) if words[0] == 'attempts' else SimpleNamespace(status=None)

    monkeypatch.setattr('cutting_trainer.session.beside_page._Program', program)
    launched.line('{"ask": "state"}')
    told = launched.answers[-1]['attempts']
    assert [each['bag'] for each in told] == ['vessel-3', 'vessel-1']  # type: ignore[index]
    assert not any('secret' in json.dumps(answer) for answer in launched.answers)
    launched.line('{"ask": "watch", "bags": ["vessel-2"], "number": 5}')
    assert 'could not be done' in launched.answers[-1]['problem']
    launched.line('{"ask": "watch", "bags": ["vessel-3", "vessel-1"], "number": 6}')
    words = asked[-1]
    assert words[:5] == ('view', '--bag', '/secret/vessel-3', '--beside', '/secret/vessel-1')
    with socket.create_server(('127.0.0.1', int(words[words.index('--port') + 1]))):
        launched.line('')
    number, link = launched.answers[-1]['replay']
    assert int(number) == 6 and link.endswith('token=of-this-test')


def test_an_attempt_is_recorded_with_its_subject_until_its_score(
    launched: Launched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refreshed: list[int] = []
    monkeypatch.setattr(
        'cutting_trainer.session.view_command.new_bag', lambda *_: tmp_path / 'bags' / 'vessel-1'
    )
    monkeypatch.setattr(launched.session._attempts, 'refresh', lambda: refreshed.append(1))
    launched.line('{"ask": "attempt", "scene": "block", "subject": "p-01"}')  # no exercise
    assert 'could not be done' in launched.answers[-1]['problem'] and not launched.replaced
    launched.line('{"ask": "attempt", "scene": "vessel", "subject": "p-01"}')
    nodes, recorder = launched.replaced
    assert TISSUE_NODE in {command.name for command in nodes}
    said = ' '.join(recorder[0].argv)
    assert 'subject:="p-01"' in said and 'attempt:="1"' in said
    assert launched.answers[-1]['recording'] == 'vessel-1'
    launched.line('{"ask": "finish"}')
    assert launched.answers[-1]['recording'] == '' and refreshed
    launched.line('{"ask": "record", "on": true}')  # of the operator: it goes on after a score
    launched.line('{"ask": "finish"}')
    assert launched.answers[-1]['recording'] == 'vessel-1'
