"""A node is killed under a pressing hand and started again: the force is back, and nobody else has
been restarted.
"""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from live import (
    ABOVE,
    NODES,
    PRESSED,
    PRESSING,
    ROOT,
    SERVO_CF,
    SPOT,
    LiveSession,
    Recording,
    deaths,
    free_domain,
    phase,
    require_limits,
    wait_for,
    write_scene,
)

from cutting_trainer.session.node_commands import node_environment

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

SECONDS = 200.0
"""Longer than it takes, even on a busy machine: the test interrupts the session."""
KILLED = ('tissue_sim', 'haptic_bridge')


@contextmanager
def killed_and_started_again(session: LiveSession, node: str) -> Iterator[int]:
    """Gives when the node was killed [ns since the epoch], once the hand feels the tissue again."""
    command, others = session.command(node), session.running()
    killed = session.kill(node)
    wait_for(lambda: node in deaths(session.said), 'the launcher to say so')
    with subprocess.Popen(command, cwd=ROOT, env=node_environment(session.domain)) as again:
        try:
            session.wait_until_pressed(PRESSING)
            lived = session.running()
            assert {n: p for n, p in lived.items() if n != node} == {
                n: p for n, p in others.items() if n != node
            }
            yield killed
        finally:
            again.kill()


@pytest.fixture(scope='module')
def played(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[LiveSession, Recording, dict[str, float]]]:
    """Session, recording, and when each node was killed [s] of it."""
    folder = tmp_path_factory.mktemp('recovery')
    down = phase('palpate', (*SPOT, PRESSED, 1.0), (*SPOT, PRESSED, 199.0), share=199.0)
    script = [phase('approach', (*SPOT, ABOVE, 1.0), share=1.0), down]
    session = LiveSession(folder, write_scene(folder, script, SECONDS, 100.0), free_domain())
    try:
        for name in NODES:
            session.wait_until_said(f'{name} is ready')
        session.wait_until_pressed(PRESSING)
        with (
            killed_and_started_again(session, KILLED[0]) as first,
            killed_and_started_again(session, KILLED[1]) as second,
        ):
            session.interrupt()
            session.end()
        recording = Recording(session.bag)
        times = (recording.at(first), recording.at(second))
        yield session, recording, dict(zip(KILLED, times, strict=True))
    finally:
        session.clean()


@pytest.mark.parametrize('node', KILLED)
def test_force_was_gone_and_is_back_after_the_node_was_started_again(played, node):
    _, recording, killed = played
    times, norms = recording.force(SERVO_CF)
    end = min([t for t in killed.values() if t > killed[node]], default=times[-1])
    since = (times > killed[node]) & (times < end)
    assert norms[times < killed[node]][-1] > PRESSING
    gone = since & (times > killed[node] + 0.2)
    assert not norms[gone][0]
    assert norms[gone].max() > PRESSING


def test_no_force_exceeds_the_limits_and_each_death_is_said(played):
    session, recording, _ = played
    require_limits(recording)
    assert deaths(session.said) == list(KILLED)


def test_a_simulation_that_comes_back_is_no_fault(played):
    _, recording, killed = played
    states = recording.messages('/haptic_bridge/operating_state')
    said = [
        recording.bag.read(m).state
        for m in states
        if recording.at(m.log_time) < killed['haptic_bridge']
    ]
    assert 'FAULT' not in said
