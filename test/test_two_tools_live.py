"""Two arms in one tissue over DDS: what is felt through it, who lives on when one of them dies."""

import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from live import (
    PATIENCE,
    ROOT,
    SERVO_CF,
    LiveSession,
    Recording,
    free_domain,
    held_up,
    node_words,
    phase,
    wait_for,
    worst_gap,
    write_scene,
    zero_from,
)
from ruamel.yaml import YAML
from std_msgs.msg import Empty

from cutting_trainer.bags.comparison import compare
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec
from cutting_trainer.node_common.qos import EVENTS
from cutting_trainer.node_common.ros import E_STOP
from cutting_trainer.recordings.html_report import write_report
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import MODULES
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.tool import ContactState

pytestmark = pytest.mark.real_time

SECONDS = 9.0
OTHER = (0.012, 0.008)
TOUCHED, LIFTED = 0.0110, 0.0220
"""Heights of the tips [m]; the surface is at 10 mm and the radius 4 mm."""
HELD = 0.01
"""[N] on the hand of the grasper while it holds the tissue."""
FAULT_TIME = 0.010
"""[s] from the timeout of a driver that has died to zero force: 30 ms with the usual 20 ms."""
NAMES = ('emulated_arm', 'haptic_bridge')
RATE = 500.0
"""[Hz] of arms and bridges: four loops of 1 kHz and their recorder take more than two slow cores.
The rate of two arms is a figure, not a claim of these tests (`bench/figures/arms_two_tools.py`)."""


def two_arms(folder: Path) -> Path:
    """The block, pressed by the first arm for long; the second one grasps it and lifts."""
    spot = (-0.012, -0.008)
    presses = [
        phase('approach', (*spot, 0.0190, 1.0), share=1.0),
        phase('palpate', (*spot, TOUCHED, 0.6), (*spot, TOUCHED, 6.0), share=6.5),
        phase('retract', (*spot, 0.0300, 1.0), share=1.5),
    ]
    path = write_scene(folder, presses, SECONDS, cut_threshold=100.0)
    scene = YAML(typ='safe').load(path)
    closing: dict[str, Any] = {'kind': 'rest', 'share': 0.4, 'button': True, 'name': 'close'}
    grasps = [
        phase('approach', (*OTHER, 0.0190, 1.0), share=1.0),
        phase('palpate', (*OTHER, TOUCHED, 1.0), share=1.5),
        closing,
        phase('palpate', (*OTHER, LIFTED, 1.0), (*OTHER, LIFTED, 2.0), share=4.1),
        {**closing, 'name': 'open'},
        phase('retract', (*OTHER, 0.0300, 1.0), share=1.6),
    ]
    start = {'position': [*OTHER, 0.030]}
    scene['haptics']['rate'] = scene['arm']['rate'] = RATE
    scene['tools'] = {
        'grasper': {
            'tool': {'mode': 'open_grasper'},
            'device': {'mode_button': 0},
            'arm': {'rate': RATE, 'script': {'start': start, 'seconds': SECONDS, 'phases': grasps}},
        }
    }
    with path.open('w') as file:
        YAML().dump(scene, file)
    return path


@pytest.fixture
def session(tmp_path: Path) -> Iterator[LiveSession]:
    session = LiveSession(tmp_path, two_arms(tmp_path), free_domain())
    yield session
    session.clean()


def states(recording: Recording, tool: str) -> np.ndarray:
    """The states of a tool in the tissue, frame by frame."""
    return recording.read(f'{tool}/tissue/force', ForceSampleCodec(), 'state')[1].ravel()


def test_one_presses_while_the_other_lifts_and_all_is_the_same_again(
    session: LiveSession, tmp_path: Path
) -> None:
    assert not session.complaints()
    recording = Recording(session.bag)
    assert (states(recording, '') == ContactState.TOUCHING).sum() > 30
    assert (states(recording, '/grasper') == ContactState.INSIDE).sum() > 30
    _, force, state = recording.read('/grasper/tissue/force', ForceSampleCodec(), 'force', 'state')
    assert force[state.ravel() == ContactState.INSIDE, 2].min() < -0.02  # it pulls the tissue up
    for number, tool in enumerate(('', '/grasper')):
        _, tools = recording.read(f'{tool}/tool/contact', ContactCodec(), 'tool')
        assert set(tools.ravel()) == {number}
    bag = open_bag(session.bag)
    scene = load_scene(str(restore_scene(bag, tmp_path)))
    result = compare(bag, recomputation(scene), pose_check(scene))
    assert result.identical, result
    assert not result.missing
    assert result.forces == 2 * result.frames
    write_report(session.bag, tmp_path / 'report.html')
    page = (tmp_path / 'report.html').read_text()
    row = next(line for line in page.splitlines() if 'grasper' in line)
    held = float(re.findall(r'<td>([\d.]+)</td>', row[row.index('grasper') :])[1])
    stamps, state = recording.read('/grasper/tissue/force', ForceSampleCodec(), 'state')
    inside = np.diff(stamps)[state.ravel()[:-1] == ContactState.INSIDE].sum()
    assert held == pytest.approx(inside, abs=0.3)


def test_a_press_of_e_stop_stops_both_hands(session: LiveSession) -> None:
    for name in NAMES:
        session.wait_until_said(f'grasper/{name} is ready')
    session.wait_until_pressed(0.07)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=session.domain)
    node = rclpy.create_node('operator', context=context)
    try:
        publisher = node.create_publisher(Empty, E_STOP, EVENTS)
        wait_for(lambda: publisher.get_subscription_count() >= 2, 'both bridges to listen')
        now = time.time_ns()
        publisher.publish(Empty())
        session.end()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    recording = Recording(session.bag)
    at = recording.at(now)
    for tool in ('', '/grasper'):
        times, norms = recording.force(tool + SERVO_CF)
        assert times[-1] > at + 1.0
        assert zero_from(times, norms) < at + 0.3


def test_a_tool_that_the_scene_lacks_is_refused(tmp_path: Path) -> None:
    words = node_words(MODULES['haptic_bridge'], '-p', f'scene:={two_arms(tmp_path)}')
    environment = os.environ | {'ROS_DOMAIN_ID': str(free_domain())}
    done = subprocess.run(
        [*words, '-p', 'tool:=scissors'],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == Status.BAD_INPUT
    assert "section tools has no 'scissors': known are grasper" in done.stdout + done.stderr


def kill(session: LiveSession, node: str) -> int:
    """Kills a node of the grasper while it holds the tissue; returns when [ns]."""
    for name in NAMES:
        session.wait_until_said(f'grasper/{name} is ready')
    session.wait_until_pressed(0.07)
    session.wait_until_pressed(HELD, '/grasper')
    found = [
        int(entry.name)
        for entry in Path('/proc').iterdir()
        if entry.name.isdecimal() and is_of_grasper(entry, session.scene, node)
    ]
    (process,) = found
    now = time.time_ns()
    os.kill(process, signal.SIGKILL)
    wait_for(
        lambda: f'grasper/{node} died' in session.said, f'the launcher to say that {node} died'
    )
    return now


def is_of_grasper(entry: Path, scene: Path, node: str) -> bool:
    try:
        words = (entry / 'cmdline').read_text().split('\0')
    except OSError:
        return False
    module = f'cutting_trainer.haptic_bridge{".emulated_arm" * (node == "emulated_arm")}.node'
    return module in words and '__ns:=/grasper' in words and any(str(scene) in w for w in words)


@pytest.mark.parametrize(
    'node', ['emulated_arm', pytest.param('haptic_bridge', marks=pytest.mark.thorough)]
)
def test_when_one_arm_or_bridge_dies_the_other_tool_goes_on(
    session: LiveSession, node: str
) -> None:
    killed = kill(session, node)
    assert session.end() == Status.NODE_DIED
    recording = Recording(session.bag)
    at = recording.at(killed)
    times, norms = recording.force(SERVO_CF)
    after = (times > at + 1.0) & (times < at + 2.0)
    felt = norms[after & ~held_up(recording, times)]
    assert len(felt) > 100
    assert felt.min() > 0.0  # the other hand presses on, and is not let go
    if node == 'emulated_arm':  # its bridge is in FAULT
        others, zero = recording.force('/grasper' + SERVO_CF)
        assert others[-1] > at + 1.0
        delay = worst_gap(others, at - 0.1, at + 0.3)
        assert zero[(others < at) & ~held_up(recording, others)][-1] > HELD
        after = zero_from(others, zero) - at
        print(f'no force after {1e3 * after:.1f} ms, scheduling delay {1e3 * delay:.1f} ms')
        timeout = load_scene(str(session.scene)).haptics.device_timeout
        assert after <= timeout + FAULT_TIME + delay
    frames, state = recording.read('/grasper/tissue/force', ForceSampleCodec(), 'state')
    assert not state[frames > at + 1.0].any()  # the jaws have let go
