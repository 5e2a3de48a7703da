"""A node is killed, or frozen, while the hand presses on the tissue: what the hand feels, and who
lives on.

Deadlines are measured by the stamps of the messages that were recorded. What the scheduler held the
deciding loop up by is read off the same stamps and allowed for.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from live import (
    HAPTICS,
    MEASURED_CF,
    MEASURED_CP,
    NODES,
    PATIENCE,
    PRESSING,
    ROOT,
    SERVO_CF,
    STEADY,
    TISSUE_FORCE,
    LiveSession,
    Recording,
    deaths,
    free_domain,
    held_up,
    node_words,
    require_limits,
    running,
    two_presses,
    wait_for,
    worst_gap,
    write_scene,
    zero_from,
)
from rosbags.highlevel import AnyReader

from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, PoseStampedCodec
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import node_environment

pytestmark = pytest.mark.live

SECONDS = 7.0
TISSUE_DEADLINE, BRIDGE_DEADLINE = 0.150, 0.030
FROZEN = 0.8
UNWRITTEN = 0.5
"""[s] of a bag that a killed recorder may take along."""
TICK = 0.001
"""[s] between two looks of the bridge for forces of the simulation."""
SAME = 0.02
"""Share of the force by which two presses of the same depth may differ."""


@dataclass(frozen=True)
class Fault:
    """A session in which a node was killed at the time `killed` [s] of its recording."""

    recording: Recording
    killed: float


Kill = Callable[[str], Fault]


@pytest.fixture
def domain() -> int:
    return free_domain()


@pytest.fixture
def session(tmp_path: Path, domain: int) -> Iterator[LiveSession]:
    scene = write_scene(tmp_path, two_presses(), SECONDS, cut_threshold=100.0)
    session = LiveSession(tmp_path, scene, domain)
    yield session
    session.clean()


@pytest.fixture
def witness(tmp_path: Path, domain: int) -> Iterator['subprocess.Popen[str]']:
    """Another recorder in the domain of the session, ready to hear."""
    arguments = ['-r', '__node:=witness', '-p', f'bag:={tmp_path / "seen"}']
    command = node_words('cutting_trainer.bags.recorder_node', *arguments)
    with running(command, node_environment(domain), 'ready: witness') as witness:
        yield witness


@pytest.fixture
def kill(session: LiveSession) -> Kill:
    """Kills a node in contact, and checks what holds for every node: who lives, what is said."""

    def kill_and_record(
        node: str, folder: Path = session.bag, then: Callable[[], None] = lambda: None
    ) -> Fault:
        for name in NODES:
            session.wait_until_said(f'{name} is ready')
        session.wait_until_pressed(PRESSING)
        lived = session.running()
        killed = session.kill(node)
        wait_for(lambda: deaths(session.said), f'the launcher to say that {node} died')
        assert session.running() == {n: p for n, p in lived.items() if n != node}
        assert set(lived) == {*NODES, 'launcher'}
        assert session.end() == Status.NODE_DIED
        assert deaths(session.said) == [node]
        then()
        recording = Recording(folder)
        require_limits(recording)
        fault = Fault(recording, recording.at(killed))
        times, norms = recording.force(SERVO_CF)
        before = (times < fault.killed) & ~held_up(recording, times)
        assert norms[before][-1] > PRESSING
        return fault

    return kill_and_record


def is_complete(folder: Path) -> bool:
    """Whether rosbags reads every message of a bag."""
    with AnyReader([folder]) as reader:
        return sum(1 for _ in reader.messages()) == reader.message_count


def test_force_fades_to_zero_and_stays_when_the_tissue_dies(
    session: LiveSession, kill: Kill
) -> None:
    fault = kill('tissue_sim')
    times, norms = fault.recording.force(SERVO_CF)
    delay = worst_gap(times, fault.killed - 0.1, fault.killed + 0.3)
    zero = zero_from(times, norms) - fault.killed
    print(f'no force after {1e3 * zero:.1f} ms, scheduling delay {1e3 * delay:.1f} ms')
    assert zero <= TISSUE_DEADLINE + TICK + delay
    assert times[-1] > fault.killed + 1.0
    fading = (times > fault.killed) & (times < fault.killed + zero + delay)
    drops = -np.diff(norms[fading]) / (np.diff(times[fading]) + 0.001)
    assert drops.max() < 2 * norms.max() / HAPTICS.fade
    measured, felt = fault.recording.force(MEASURED_CF)
    delay += worst_gap(measured, fault.killed - 0.1, fault.killed + 0.3)
    assert zero_from(measured, felt) - fault.killed <= TISSUE_DEADLINE + TICK + delay
    assert is_complete(session.bag)


def test_arm_lets_go_by_itself_and_the_tissue_comes_to_rest_when_the_bridge_dies(
    session: LiveSession, kill: Kill
) -> None:
    fault = kill('haptic_bridge')
    times, norms = fault.recording.force(MEASURED_CF)
    delay = worst_gap(times, fault.killed - 0.1, fault.killed + 0.3)
    commands, _ = fault.recording.force(SERVO_CF)
    zero = zero_from(times, norms) - max(fault.killed, commands[-1])
    print(f'no force after {1e3 * zero:.1f} ms, scheduling delay {1e3 * delay:.1f} ms')
    assert zero <= BRIDGE_DEADLINE + delay + 0.001  # the way of the last command
    assert times[-1] > fault.killed + 1.0
    frames, kinetic, elastic = fault.recording.read(
        TISSUE_FORCE, ForceSampleCodec(), 'kinetic_energy', 'elastic_energy'
    )
    energy = (kinetic + elastic)[:, 0]
    assert frames[-1] > fault.killed + 1.0
    assert energy[frames > fault.killed + 0.8].max() < 1e-3 * energy[frames < fault.killed][-1]
    assert is_complete(session.bag)


@pytest.mark.thorough
def test_palpation_goes_on_undisturbed_when_cutting_dies(session: LiveSession, kill: Kill) -> None:
    fault = kill('cutting')
    assert_undisturbed(fault)
    assert is_complete(session.bag)


@pytest.mark.thorough
def test_palpation_goes_on_undisturbed_when_the_recorder_dies(
    witness: 'subprocess.Popen[str]',
    session: LiveSession,
    kill: Callable[..., Fault],
    tmp_path: Path,
) -> None:
    fault = kill('recorder', tmp_path / 'seen', lambda: end(witness))
    assert_undisturbed(fault)
    cut_off = Recording(session.bag)
    assert not cut_off.complete
    times, norms = cut_off.force(SERVO_CF)
    last = fault.recording.at(cut_off.start) + times[-1]
    assert 0 < fault.killed - last < UNWRITTEN
    seen, felt = fault.recording.force(SERVO_CF)
    assert norms[-1] in felt[np.abs(seen - last) < 0.1]
    assert norms[-1] > PRESSING or last < fault.killed - STEADY  # from before it was pressed


@pytest.mark.thorough
def test_force_fades_and_comes_back_when_the_tissue_is_frozen_and_goes_on(
    session: LiveSession,
) -> None:
    session.wait_until_pressed(PRESSING)
    lived = session.running()
    stopped = time.time_ns()
    os.kill(lived['tissue_sim'], signal.SIGSTOP)
    time.sleep(FROZEN)
    goes_on = time.time_ns()
    os.kill(lived['tissue_sim'], signal.SIGCONT)
    assert session.end() in (Status.OK, Status.FAILED)  # its rate was not held
    assert deaths(session.said) == []
    recording = Recording(session.bag)
    times, norms = recording.force(SERVO_CF)
    start, end = recording.at(stopped), recording.at(goes_on)
    delay = worst_gap(times, start - 0.1, end)
    silent = (times > start + TISSUE_DEADLINE + TICK + delay) & (times < end)
    assert silent.sum() > 100
    assert not norms[silent].any()
    assert norms[times > end + 0.6].max() > PRESSING
    require_limits(recording)
    states = recording.messages('/haptic_bridge/operating_state')
    assert 'FAULT' not in [recording.bag.read(message).state for message in states]
    assert 'no frame of the simulation for 100 ms' in session.said


def assert_undisturbed(fault: Fault) -> None:
    """The hand feels on as before: nothing at the moment itself, and the same in the next press."""
    times, norms = fault.recording.force(SERVO_CF)
    undelayed = ~held_up(fault.recording, times)
    around = undelayed & (np.abs(times - fault.killed) < 0.2)
    assert np.ptp(norms[around]) < SAME * norms[around].mean()
    poses, positions = fault.recording.read(MEASURED_CP, PoseStampedCodec(), 'position')
    depth = positions[:, 2].max() - positions[:, 2]
    down = poses[depth > depth.max() - 1e-4]
    (border,) = np.flatnonzero(np.diff(down) > 0.2)
    before, after = (
        norms[undelayed & (times > press[0] + 0.3) & (times < press[-1] - 0.3)]
        for press in (down[: border + 1], down[border + 1 :])
    )
    assert down[0] < fault.killed < down[border]
    np.testing.assert_allclose(after, before.mean(), rtol=SAME)
    assert zero_from(times, norms) < times[-1]
    states = fault.recording.messages('/haptic_bridge/operating_state')
    assert 'FAULT' not in [fault.recording.bag.read(message).state for message in states]


def end(witness: 'subprocess.Popen[str]') -> None:
    """Ends a witness in order."""
    witness.send_signal(signal.SIGINT)
    witness.communicate(timeout=20)
    assert witness.returncode == 0


@pytest.mark.thorough
def test_session_goes_on_when_the_disk_is_full_and_says_what_is_not_in_the_bag(
    tmp_path: Path, domain: int
) -> None:
    disk, bag = tmp_path / 'disk', tmp_path / 'bag'
    disk.mkdir()
    mount = f'mount -t tmpfs -o size=260k none {disk}'
    namespace = ['unshare', '--user', '--map-root-user', '--mount', 'sh', '-c']
    if not shutil.which('unshare') or subprocess.run([*namespace, mount], check=False).returncode:
        pytest.skip('no disk of its own: this system lets users mount nothing')
    scene = ROOT / 'bags' / 'samples' / 'straight_cut.yaml'
    demo = [sys.executable, '-m', 'cutting_trainer.cli', 'demo', '--domain', str(domain)]
    words = shlex.join([*demo, '--scene', str(scene), '--bag', str(disk / 'bag')])
    done = subprocess.run(
        [*namespace, f'{mount} && {words}; status=$?; cp -r {disk}/bag {bag}; exit $status'],
        cwd=ROOT,
        env=os.environ | {'COLUMNS': '200'},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == Status.FAILED, done.stderr
    assert 'No space left on device: nothing is recorded from now on' in done.stderr
    (lost,) = map(int, re.findall(r'device: (\d+) messages are not in the bag', done.stderr))
    assert lost > 1000 and 'did not finish its script' not in done.stderr
    assert {path.name for path in bag.iterdir()} == {'bag_0.mcap', 'metadata.yaml', 'log'}
    before = list(open_bag(bag).messages())
    assert not repair_bag(bag).whole
    assert sorted(open_bag(bag).messages(), key=key) == sorted(before, key=key)
    assert len(before) > 500 and is_complete(bag)


def key(message: Recorded) -> tuple[int, str, int]:
    return message.log_time, message.topic, message.sequence
