"""Force loops and frames get processors of their own, where there are enough."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_supervisor import ENVIRONMENT, Ledger, command

from cutting_trainer.session import processors
from cutting_trainer.session.node_commands import session_nodes
from cutting_trainer.session.processors import Work, reserved_processors, shared_out
from cutting_trainer.session.supervisor import Supervisor

SESSION: list[Work] = ['force loop', 'force loop', 'frames', 'other', 'other']


@pytest.fixture
def own_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions of other tests on this machine reserve nothing here."""
    monkeypatch.setattr(processors, '_ADDRESS', f'\0cutting_trainer.test.{os.getpid()}')


@pytest.mark.parametrize(
    ('work', 'available', 'loops', 'frames'),
    [
        (SESSION, [0, 1], {1}, {0}),
        (SESSION, [2, 5, 6, 7], {7}, {2, 5, 6}),
        (['force loop', *SESSION], [0, 1, 2], {1, 2}, {0}),
        (['force loop', 'frames'], [0, 1], {1}, {0}),
    ],
)
def test_two_force_loops_share_a_processor_and_frames_get_the_others(
    work: list[Work], available: list[int], loops: set[int], frames: set[int]
) -> None:
    assert shared_out(work, available) == {'force loop': loops, 'frames': frames}


@given(st.lists(st.sampled_from(SESSION), max_size=9), st.sets(st.integers(0, 63), min_size=1))
def test_no_processor_has_both_and_each_kind_has_one_or_nothing_is_shared_out(
    work: list[Work], available: set[int]
) -> None:
    found = shared_out(work, sorted(available))
    if found:
        assert found['frames'] and found['force loop']
        assert not found['frames'] & found['force loop']
        assert found['frames'] | found['force loop'] == available
        assert work.count('force loop') <= 2 * len(found['force loop'])
    else:
        missing = not {'force loop', 'frames'} <= set(work)
        assert missing or work.count('force loop') > 2 * (len(available) - 1)


def test_arms_and_bridges_have_force_loops_and_the_tissue_has_frames() -> None:
    nodes = session_nodes(Path('scene'), Path('bag'), 0, 1.0, ['grasper'])
    work = {node.name: node.work for node in nodes}
    loops = {name for name, kind in work.items() if kind == 'force loop'}
    arms = {'emulated_arm', 'haptic_bridge'}
    assert loops == arms | {f'grasper/{name}' for name in arms}
    assert [name for name, kind in work.items() if kind == 'frames'] == ['tissue_sim']


@pytest.mark.usefixtures('own_address')
def test_a_second_session_of_the_machine_gets_none() -> None:
    with reserved_processors(SESSION) as first, reserved_processors(SESSION) as second:
        assert second == {}
    with reserved_processors(SESSION) as again:
        assert again == first


@pytest.mark.usefixtures('own_address')
def test_nodes_run_on_the_processors_of_their_work(tmp_path: Path) -> None:
    all_of_them = os.sched_getaffinity(0)
    with reserved_processors(SESSION) as reserved:
        expected = dict(reserved)
    kinds: dict[str, Work] = {'arm': 'force loop', 'tissue': 'frames', 'cutting': 'other'}
    ledger = Ledger(tmp_path / 'ledger')
    nodes = [replace(command(name, ledger), work=kind) for name, kind in kinds.items()]
    with Supervisor(nodes, tmp_path / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        for name, pid in supervisor.pids.items():
            own = expected.get(kinds[name], all_of_them)
            assert os.sched_getaffinity(pid) == own
