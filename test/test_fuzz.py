"""A session that is sent what nobody should send loses no node, and gives out nothing bad."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from live import ROOT

from bench.trials.fuzz_messages import KINDS, Maker, huge
from bench.trials.fuzz_verdict import (
    MAX_LINES_PER_SECOND,
    MAX_LOOP_PERIOD_S,
    MAX_MEMORY_GROWTH,
    MAX_SILENCE_S,
    MEMORY_ALLOWANCE_MB,
    Node,
    busiest_second,
    problems,
)
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_process import _Log

messages = pytest.importorskip('cutting_trainer_msgs.msg')


def well() -> Node:
    return Node(
        before=100.0, after=100.0, hears=2, spoke=10.0, values={'refused a: b': '3', 'rate': '30'}
    )


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (
            {'after': MAX_MEMORY_GROWTH * 100.0 + MEMORY_ALLOWANCE_MB + 2 * 5.0 + 1.0},
            '311 MB at the end',
        ),
        ({'period': MAX_LOOP_PERIOD_S + 0.1}, 'stood still'),
        ({'spoke': 10.0 - MAX_SILENCE_S - 1.0}, 'said nothing'),
        ({'spoke': None}, 'said nothing'),
        ({'silence': MAX_SILENCE_S + 1.0}, 'said nothing'),
        ({'values': {'rate': '30'}}, 'counted nothing'),
        ({'busiest': MAX_LINES_PER_SECOND + 1}, 'lines into its log'),
    ],
)
def test_a_node_that_is_not_well_is_found(change: dict, said: str) -> None:
    assert problems('viewer', well(), 11.0, 5.0) == []
    node = well()
    for name, value in change.items():
        setattr(node, name, value)
    (found,) = problems('viewer', node, 11.0, 5.0)
    assert 'viewer' in found and said in found


def test_the_busiest_second_of_a_log_is_found() -> None:
    lines = ['[WARN] [100.5] [viewer]: a', '[WARN] [100.9] [viewer]: b', 'ready: viewer']
    assert busiest_second('\n'.join([*lines, '[INFO] [101.0] [viewer]: c'])) == 2
    assert busiest_second('') == 0


def test_the_same_seed_makes_the_same_messages_and_hardly_any_is_as_it_was_heard() -> None:
    from rclpy.serialization import serialize_message

    heard = [serialize_message(messages.Contact(state=1, proxy_radius=0.004))]
    drawn = [
        (
            str(maker.made(messages.MeshDelta)),
            [maker.message(kind, messages.Contact, heard) for kind in KINDS[2:] for _ in range(50)],
        )
        for maker in (Maker(4), Maker(4), Maker(5))
    ]
    assert drawn[0] == drawn[1] != drawn[2]
    assert sum(data != heard[0] for data in drawn[0][1]) > 80


def test_a_line_that_a_node_repeats_is_in_its_log_once_with_the_count(tmp_path: Path) -> None:
    log = _Log(tmp_path / 'log' / 'viewer.log')
    for line in ('a', *['too long'] * 1000, 'b', 'b'):
        log.write(line)
    log.close()
    written = (tmp_path / 'log' / 'viewer.log').read_text().splitlines()
    assert written == ['a', 'too long', '(the same 999 times more)', 'b', '(the same 1 times more)']


@pytest.mark.parametrize('name', ['Contact', 'Mesh', 'MeshDelta', 'StringStamped'])
def test_a_message_is_as_huge_as_was_asked_for(name: str) -> None:
    data = huge(getattr(messages, name), 1_000_000)
    assert data is not None
    assert 1_000_000 <= len(data) < 1_001_000


@pytest.mark.thorough
@pytest.mark.real_time
def test_a_session_survives_malformed_messages_floods_and_huge_ones(tmp_path: Path) -> None:
    asked = ('--messages', '10000', '--flood', '0.5', '--largest', '5', '--json')
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'bench',
            'fuzz',
            *asked,
            '--bag',
            str(tmp_path / 'bag'),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    outcome = json.loads(done.stdout)
    assert outcome['failures'] == []
    assert done.returncode == Status.OK
    assert outcome['messages'] >= 10_000
    assert outcome['topics'] >= 20
    assert outcome['services'] >= 20
    assert set(outcome['kinds']) == {*KINDS, 'requests', 'flood', 'huge'}
    assert all(node['refused'] for node in outcome['nodes'].values())
