"""Force loops and frames get processors of their own, where there are enough."""

import os
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_supervisor import ENVIRONMENT, Ledger, command

from cutting_trainer.session import processors, supervisor
from cutting_trainer.session.node_commands import session_nodes
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.processors import ANYWHERE, Work, reserved_processors, shared_out
from cutting_trainer.session.supervisor import Event, Supervisor

KINDS: dict[str, Work] = {
    'arm': 'arm',
    'tissue': 'frames',
    'recorder': 'messages',
    'cutting': 'other',
}
SESSION: list[Work] = ['arm', 'bridge', 'frames', 'messages', 'other']
RECEIVES = """
import ctypes, sys, threading, time

def receive():
    ctypes.CDLL(None).prctl(15, b'dds.udp.7411', 0, 0, 0)
    named.set()
    time.sleep(60.0)

named = threading.Event()
threading.Thread(target=receive, daemon=True).start()
named.wait()
print('ready: ' + sys.argv[1], flush=True)
time.sleep(60.0)
"""
"""A node with a thread whose name is that of one in which DDS receives."""


@pytest.fixture
def own_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions of other tests on this machine reserve nothing here."""
    monkeypatch.setattr(processors, '_ADDRESS', f'\0cutting_trainer.test.{os.getpid()}')


@pytest.mark.parametrize(
    ('work', 'available', 'loops', 'frames'),
    [
        (SESSION, [0, 1], {1}, {0}),
        (SESSION, [2, 5, 6, 7], {7}, {2, 5, 6}),
        (['bridge', *SESSION], [0, 1, 2], {1, 2}, {0}),
        (['bridge', 'frames'], [0, 1], {1}, {0}),
    ],
)
def test_two_force_loops_share_a_processor_and_frames_get_the_others(
    work: list[Work], available: list[int], loops: set[int], frames: set[int]
) -> None:
    processes = {'bridge': loops, 'arm': loops, 'frames': frames}
    receivers = dict.fromkeys(('arm', 'messages', 'frames'), loops)
    assert shared_out(work, available) == (processes, receivers, '')


@pytest.mark.parametrize(
    ('tools', 'available', 'arms'), [(2, [0, 1], {0}), (4, [0, 1, 2, 3], {0, 1}), (3, [4, 5], None)]
)
def test_arms_go_to_the_frames_where_too_few_processors_are_left(
    tools: int, available: list[int], arms: set[int] | None
) -> None:
    found = shared_out(tools * ['arm', 'bridge'] + ['frames'], available)
    assert found.processes.get('arm') == arms
    needed, there = tools + 1, len(available)
    said = f'{2 * tools} force loops and the tissue need {needed} processors, and this session has '
    assert found.remark.startswith(f'{said}{there}: on slow ones frames come late')
    if arms is not None:
        bridges = set(available) - arms
        assert found.processes['frames'] == arms and found.processes['bridge'] == bridges
        assert found.receivers['messages'] == set(available)


@given(st.lists(st.sampled_from(SESSION), max_size=9), st.sets(st.integers(0, 63), min_size=1))
def test_no_processor_has_too_many_loops_and_no_bridge_one_of_frames(
    work: list[Work], available: set[int]
) -> None:
    found = shared_out(work, sorted(available)).processes
    arms, bridges = work.count('arm'), work.count('bridge')
    if not found:
        room = 2 * (len(available) - 1)
        assert 'frames' not in work or arms + bridges > room or not arms + bridges
        return
    assert found['frames'] and not found['frames'] & found['bridge']
    assert found['frames'] | found['bridge'] == available
    of_arms = found['arm']
    with_bridges = bridges + (arms if of_arms == found['bridge'] else 0)
    assert with_bridges <= 2 * len(found['bridge'])
    assert arms <= 2 * len(of_arms)


def test_a_session_says_at_its_start_that_processors_are_too_few(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shared_out(['bridge', 'frames'], [0]).remark.startswith('1 force loop and the tissue ')
    assert not shared_out(['bridge', 'arm'], [0]).remark, 'there is no tissue'
    remark = shared_out(2 * SESSION, [0, 1]).remark
    few = nullcontext(ANYWHERE._replace(remark=remark))
    monkeypatch.setattr(supervisor, 'reserved_processors', lambda _: few)
    events: list[Event] = []
    nodes = [command('tissue_sim', Ledger(tmp_path / 'ledger'))]
    with Supervisor(nodes, tmp_path / 'log', ENVIRONMENT, events.append) as running:
        assert not events
        assert running.start()
    assert ('warning', 'session', remark) in [(e.kind, e.node, e.text) for e in events]


def test_each_node_has_the_work_that_it_does() -> None:
    nodes = session_nodes(Path('scene'), Path('bag'), 0, 1.0, ['grasper'])
    work = {node.name: node.work for node in nodes}
    loops = {name for name, kind in work.items() if kind in ('arm', 'bridge')}
    arms = {'emulated_arm', 'haptic_bridge'}
    assert loops == arms | {f'grasper/{name}' for name in arms}
    assert [name for name, kind in work.items() if kind == 'frames'] == ['tissue_sim']
    assert [name for name, kind in work.items() if kind == 'messages'] == ['recorder']


@pytest.mark.usefixtures('own_address')
def test_a_second_session_of_the_machine_gets_none() -> None:
    with reserved_processors(SESSION) as first, reserved_processors(SESSION) as second:
        assert not second.processes and not second.receivers
        assert second.remark == first.remark
    with reserved_processors(SESSION) as again:
        assert again == first


@pytest.mark.usefixtures('own_address')
def test_nodes_run_on_the_processors_of_their_work(tmp_path: Path) -> None:
    all_of_them = os.sched_getaffinity(0)
    with reserved_processors(SESSION) as reserved:
        expected = reserved.processes
    ledger = Ledger(tmp_path / 'ledger')
    nodes = [replace(command(name, ledger), work=kind) for name, kind in KINDS.items()]
    with Supervisor(nodes, tmp_path / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        for name, pid in supervisor.pids.items():
            own = expected.get(KINDS[name], all_of_them)
            assert os.sched_getaffinity(pid) == own


def threads(pid: int) -> dict[str, set[int]]:
    """Return the processors of the threads of a process, by the name of the thread."""
    folders = Path(f'/proc/{pid}/task').iterdir()
    return {(f / 'comm').read_text().strip(): os.sched_getaffinity(int(f.name)) for f in folders}


@pytest.mark.usefixtures('own_address')
def test_what_receives_messages_of_force_loops_is_on_their_processor(tmp_path: Path) -> None:
    argv = (sys.executable, '-S', '-c', RECEIVES)
    nodes = [NodeCommand(name, (*argv, name), work=kind) for name, kind in KINDS.items()]
    everywhere = os.sched_getaffinity(0)
    expected = shared_out([*KINDS.values()], sorted(everywhere)).processes  # {} of one processor
    with Supervisor(nodes, tmp_path / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        found = {name: threads(pid) for name, pid in supervisor.pids.items()}
    receivers = {name: by_thread.pop('dds.udp.7411') for name, by_thread in found.items()}
    loops = expected.get('bridge', everywhere)
    assert receivers['arm'] == receivers['tissue'] == receivers['recorder'] == loops
    assert [*found['tissue'].values()] == [expected.get('frames', everywhere)]
    assert [*found['recorder'].values()] == [receivers['cutting']] == [everywhere]
