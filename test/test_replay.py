"""What a replay plays and when, what it can reach, and with whom it does not mix."""

import itertools
import os
import pty
import re
import select
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from bag_copies import rewritten
from cutting_trainer_msgs.msg import ForceSample, Mesh, MeshDelta
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Joy

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.playback_control import STEP_S, Playhead
from cutting_trainer.bags.playback_messages import (
    ReadAhead,
    RecordedHand,
    RecordedStream,
    duration,
)
from cutting_trainer.bags.playback_publishers import HandPlayer, SessionPlayer
from cutting_trainer.bags.qos_adaptation import publisher_qos
from cutting_trainer.bags.reader import Bag, Recorded, open_bag
from cutting_trainer.bags.topic_names import (
    BUTTONS,
    CONTACT,
    FORCE,
    FORCES,
    MESH,
    OF_DEVICE,
    OF_TISSUE,
    POSE,
    REPLAYED,
    SERVO_CF,
    UPDATES,
)
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.recordings.replay_command import _Over, handle_keys, replay_nodes
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / 'bags' / 'samples' / 'format_2' / 'straight_cut'
SUBSCRIBERS = {
    MESH: qos.LATCHED,
    UPDATES: qos.UPDATES,
    FORCE: qos.STREAM,
    CONTACT: qos.NEWEST_BEST_EFFORT,
    POSE: qos.NEWEST_BEST_EFFORT,
    SERVO_CF: qos.NEWEST_BEST_EFFORT,
}
"""What our own nodes ask for."""


def test_the_playhead_goes_by_the_clock_times_the_rate_and_stands_while_paused() -> None:
    head = Playhead(1.0, 9.0, rate=2.0)
    assert head.move(100.0) == 1.0
    head.toggle()
    assert head.move(101.0) == pytest.approx(3.0)
    head.toggle()
    assert head.move(105.0) == pytest.approx(3.0)
    head.step()
    assert head.move(106.0) == pytest.approx(3.0 + STEP_S)
    head.toggle()
    assert head.move(200.0) == 9.0 and head.over


def test_a_loop_begins_again_where_the_replay_began() -> None:
    head = Playhead(2.0, 4.0, loop=True)
    head.toggle()
    head.move(0.0)
    assert head.move(2.5) == 2.0
    assert head.rounds == 1 and not head.over


def test_a_jump_ends_within_the_part_that_is_replayed() -> None:
    head = Playhead(2.0, 4.0)
    for asked, reached in ((0.0, 2.0), (3.0, 3.0), (9.0, 4.0)):
        head.seek(asked)
        assert head.position == reached


def test_keys_pause_step_and_end() -> None:
    head = Playhead(0.0, 9.0)
    handle_keys(' ', head)
    assert not head.paused
    handle_keys('xs', head)
    assert head.paused and head.position == pytest.approx(STEP_S)
    with pytest.raises(_Over):
        handle_keys('q', head)


def test_a_stream_gives_every_message_once_in_order_and_none_early() -> None:
    bag = open_bag(SAMPLE)
    first = next(iter(bag.messages())).log_time
    middle = (next(iter(bag.messages(OF_TISSUE))).log_time - first) * 1e-9 + 2.0
    stream = RecordedStream(bag, OF_TISSUE, 0.0)
    early = list(stream.due(middle))
    late = list(stream.due(1e9))
    assert [*early, *late] == list(bag.messages(OF_TISSUE))
    assert early[-1].log_time <= first + middle * 1e9 < late[0].log_time


def test_what_goes_wrong_while_reading_ahead_is_raised_where_it_is_due() -> None:
    first = next(iter(open_bag(SAMPLE).messages()))

    def damaged() -> Iterator[Recorded]:
        yield from [first] * 700
        raise BagError('damaged')

    ahead = ReadAhead(damaged())
    read = iter(ahead)
    assert [next(read) for _ in range(700)] == [first] * 700
    with pytest.raises(BagError, match='damaged'):
        next(read)
    endless = ReadAhead(itertools.repeat(first))
    assert next(iter(endless)) == first
    endless.close()


def test_entering_in_the_middle_works_from_the_next_keyframe() -> None:
    bag = open_bag(SAMPLE)
    keyframes = [m.log_time for m in bag.messages([MESH])]
    start = (keyframes[-1] - next(iter(bag.messages())).log_time) * 1e-9 - 1.0
    replica, seen = MeshReplica(), []
    for m in RecordedStream(bag, OF_TISSUE, start).due(1e9):
        seen.append(m.topic)
        if m.topic == MESH:
            replica.load(bag.read(m))
        elif m.topic == UPDATES:
            assert replica.apply(bag.read(m))
    assert seen.count(MESH) == 1 and FORCE in seen[: seen.index(MESH)]
    whole = MeshReplica()
    for m in bag.messages([MESH, UPDATES]):
        (whole.load if m.topic == MESH and whole.revision < 0 else whole.apply)(bag.read(m))  # type: ignore[operator]
    assert replica.hash() == whole.hash()


def test_the_recorded_hand_is_where_it_was() -> None:
    bag = open_bag(SAMPLE)
    hand = RecordedHand(bag)
    first, last = hand.span
    assert 0.0 <= first < last <= duration(bag)
    assert hand.pose(-1.0) == hand.pose(first)
    assert hand.pose(last + 9.0).stamp_ns > hand.pose((first + last) / 2).stamp_ns


BUTTON = BUTTONS[0]
PRESSES = {1.0: 0, 1.5: 1, 3.0: 0}
"""[s] of the session at which the button changes, and to what."""


@pytest.fixture
def pressed(tmp_path: Path) -> Bag:
    """The sample with a hand that presses its button."""
    begin = open_bag(SAMPLE).span[0]
    events = [
        (BUTTON, begin + round(time * 1e9), serialize_message(Joy(buttons=[state])))
        for time, state in PRESSES.items()
    ]
    return open_bag(rewritten(SAMPLE, tmp_path / 'pressed', added=events))


def test_the_button_does_what_it_did_and_after_a_way_back_is_as_it_was_there(pressed: Bag) -> None:
    hand = RecordedHand(pressed)
    recorded = [(BUTTON, m.data) for m in pressed.messages([BUTTON])]
    assert [pressed.read(m).buttons[0] for m in pressed.messages([BUTTON])] == [0, 1, 0]
    given, done = hand.events(0, 0.5)
    assert (given, done) == ([], 0)
    for position in np.linspace(0.5, 4.0, 20):
        events, done = hand.events(done, position)
        given += events
    assert given == recorded and done == 3
    assert hand.events(done, 2.0) == ([recorded[1]], 2)
    assert hand.events(done, 4.0) == ([], 3)
    assert hand.events(0, 4.0) == (recorded, 3)


def test_a_replayed_topic_suits_every_subscriber_of_ours() -> None:
    bag = open_bag(SAMPLE)
    for topic, wanted in SUBSCRIBERS.items():
        offered = publisher_qos(bag.profiles(topic))
        compatibility, reason = qos_check_compatible(offered, wanted)
        assert compatibility != QoSCompatibility.ERROR, (topic, reason)
        assert offered.depth >= 1


def test_nodes_of_a_replay_speak_to_no_device_unless_told_to() -> None:
    def remapped(drive_device: bool) -> list[str]:
        nodes = replay_nodes(Path('scene.yaml'), None, drive_device=drive_device)
        bridge = next(node for node in nodes if node.name == 'haptic_bridge')
        return [word for word in bridge.argv if ':=/replay' in word]

    names = ('measured_cp', 'button', 'clutch')
    of_device = [f'arm/{name}:=/replay/arm/{name}' for name in names]
    forces = [f'{force[1:]}:=/replay{force}' for force in FORCES]
    assert 'arm/servo_cf:=/replay/arm/servo_cf' in forces
    assert remapped(False) == [*of_device, *forces]
    assert remapped(True) == of_device


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    with reserved_domain('free') as domain:
        rclpy.init(context=context, domain_id=domain)
        yield context
        rclpy.shutdown(context=context)


@pytest.mark.long
def test_a_recorded_force_is_played_to_a_device_only_when_told_to(context: rclpy.Context) -> None:
    for drive in (False, True):
        player = SessionPlayer(
            context, Playhead(0.0, 1.0), open_bag(SAMPLE), 0.0, drive_device=drive
        )
        assert (SERVO_CF in player.topics) == drive
        assert all((topic in player.topics) != drive for topic in (*OF_DEVICE, BUTTON))
        player.stop()


def hand_player(context: rclpy.Context, playhead: Playhead, bag: Bag) -> HandPlayer:
    player = HandPlayer(context, playhead, RecordedHand(bag))
    player.advertise()
    return player


@pytest.mark.live
def test_the_hand_goes_once_the_bridge_is_enabled_and_presses_its_button_again(
    context: rclpy.Context, pressed: Bag
) -> None:
    playhead = Playhead(1.2, 4.0, rate=2.0)
    player = hand_player(context, playhead, pressed)
    node = rclpy.create_node('bridge', context=context)
    states = node.create_publisher(
        crtk_types().operating_state, '/haptic_bridge/operating_state', qos.LATCHED
    )
    presses = ros.polled(node, Joy, f'{REPLAYED}{BUTTON}', qos.EVENTS)
    heard: list[int] = []

    def hear() -> None:
        while (message := ros.take(presses)) is not None:
            heard.append(message.buttons[0])

    try:
        player.start()
        time.sleep(0.5)
        hear()
        assert playhead.paused and playhead.position == 1.2 and heard == [0]
        states.publish(crtk_types().operating_state(state='PAUSED'))  # its button is to be held
        deadline = time.monotonic() + 20.0
        while not playhead.over and time.monotonic() < deadline:
            hear()
            time.sleep(0.01)
        time.sleep(0.2)
        hear()
        assert playhead.over and player.stop_reason == '' and player.faulted is None
        assert heard == [0, 1, 0]
    finally:
        player.stop()
        node.destroy_node()


@pytest.mark.live
def test_a_bridge_that_was_enabled_too_shortly_to_be_heard_ends_the_replay(
    context: rclpy.Context,
) -> None:
    playhead = Playhead(0.0, 5.0)
    player = hand_player(context, playhead, open_bag(SAMPLE))
    node = rclpy.create_node('bridge', context=context)
    state = crtk_types().operating_state
    states = node.create_publisher(state, '/haptic_bridge/operating_state', qos.LATCHED)
    try:
        states.publish(state(state='FAULT'))  # a latched topic keeps the newest: ENABLED is gone
        player.start()
        deadline = time.monotonic() + 20.0
        while player.faulted is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert player.faulted == playhead.position == 0.0
    finally:
        player.stop()
        node.destroy_node()


@pytest.mark.long
def test_a_bridge_that_says_nothing_is_not_waited_for_for_ever(context: rclpy.Context) -> None:
    player = hand_player(context, Playhead(0.0, 5.0), open_bag(SAMPLE))
    try:
        player.watch(100.0)
        player.watch(129.0)
        assert player.stop_reason == ''
        player.watch(131.0)
        assert player.stop_reason.startswith('the haptic bridge was not enabled within 30 s')
    finally:
        player.stop()


@pytest.mark.live
def test_a_session_is_shown_as_it_was_and_ends_when_somebody_else_publishes(
    context: rclpy.Context,
) -> None:
    bag = open_bag(SAMPLE)
    node = rclpy.create_node('onlooker', context=context)
    topics = ((Mesh, MESH, qos.LATCHED), (MeshDelta, UPDATES, qos.UPDATES))
    mesh, deltas = (ros.polled(node, *topic) for topic in topics)
    forces = ros.polled(node, ForceSample, FORCE, qos.STREAM)
    wrenches = ros.polled(node, WrenchStamped, SERVO_CF, qos.NEWEST_BEST_EFFORT)
    playhead = Playhead(0.0, duration(bag), rate=4.0)
    player = SessionPlayer(context, playhead, bag, 0.0, drive_device=False)
    replica, heard = MeshReplica(), 0
    try:
        player.reject_live_input(player.topics)
        assert player.stop_reason == ''
        player.advertise()
        time.sleep(1.0)
        playhead.toggle()
        player.start()
        deadline = time.monotonic() + 20.0
        while not playhead.over and time.monotonic() < deadline:
            if (message := ros.take(mesh)) is not None and replica.revision < 0:
                replica.load(message)
            while (message := ros.take(deltas)) is not None:
                replica.apply(message)
            # The bag is older than the torque in this message.
            heard += (sample := ros.take(forces)) is not None and not sample.torque.any()
            assert ros.take_raw(wrenches) is None
            time.sleep(0.002)
        assert playhead.over and heard > 20 and replica.step > 100
        intruder = node.create_publisher(ForceSample, FORCE, qos.STREAM)
        deadline = time.monotonic() + 10.0
        while not player.stop_reason and time.monotonic() < deadline:
            time.sleep(0.05)
        assert 'onlooker publishes /tissue/force' in player.stop_reason
        node.destroy_publisher(intruder)
    finally:
        player.stop()
        node.destroy_node()


@pytest.mark.long
def test_a_replay_into_a_live_graph_is_refused_in_one_line(context: rclpy.Context) -> None:
    node = rclpy.create_node('live_arm', context=context)
    node.create_publisher(ForceSample, FORCE, qos.STREAM)
    player = SessionPlayer(context, Playhead(0.0, 1.0), open_bag(SAMPLE), 0.0, drive_device=False)
    try:
        player.reject_live_input(player.topics)
        assert player.stop_reason.startswith('live_arm publishes /tissue/force')
    finally:
        player.stop()
        node.destroy_node()


class Terminal:
    """A command on a terminal of its own.

    Attributes:
        process: of the command.
    """

    def __init__(self, *arguments: str) -> None:
        self._ours, self._theirs = pty.openpty()
        self._settings = termios.tcgetattr(self._theirs)
        self._said = ''
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'cutting_trainer.cli', *arguments],
            cwd=ROOT,
            env=os.environ | {'TERM': 'xterm', 'COLUMNS': '120'},
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
        )

    def press(self, key: str) -> None:
        os.write(self._ours, key.encode())

    def wait_for(self, pattern: str) -> re.Match[str]:
        """The last match of a pattern in what was said since the last call; waits for one."""
        deadline = time.monotonic() + 60.0
        while not (found := list(re.finditer(pattern, self._said))):
            assert time.monotonic() < deadline, self._said
            if select.select([self._ours], [], [], 0.1)[0]:
                self._said += os.read(self._ours, 1 << 16).decode(errors='replace')
        self._said = ''
        return found[-1]

    def end(self) -> int:
        """Waits for the end; returns the exit status."""
        return self.process.wait(30.0)

    def is_as_before(self) -> bool:
        """Whether the terminal has the settings that it had."""
        return termios.tcgetattr(self._theirs) == self._settings


@pytest.mark.live
def test_keys_of_a_terminal_pause_a_replay_step_it_and_end_it() -> None:
    options = ('--as-recorded', '--loop', '--start', '2', '--rate', '0.5', '--domain', 'free')
    terminal = Terminal('replay', str(SAMPLE), *options)
    try:
        began = float(terminal.wait_for(r'replaying[^\n]*?([\d.]+) of [\d.]+ s').group(1))
        terminal.press(' ')
        paused = r'paused[^\n]*?([\d.]+) of [\d.]+ s'
        terminal.wait_for(paused)
        stood = float(terminal.wait_for(paused).group(1))
        assert 2.0 <= began <= stood
        terminal.press('s')
        while (stepped := float(terminal.wait_for(paused).group(1))) == stood:
            pass
        assert stepped == pytest.approx(stood + STEP_S, abs=0.011)
        terminal.press('q')
        assert terminal.end() == 0
        assert terminal.is_as_before()
    finally:
        terminal.process.kill()
        terminal.process.wait()


@pytest.mark.live
@pytest.mark.thorough
def test_the_recorded_hand_cuts_the_tissue_again(tmp_path: Path) -> None:
    command = [
        sys.executable,
        '-m',
        'cutting_trainer.cli.main',
        'replay',
        str(SAMPLE),
        '--domain',
        'free',
    ]
    done = subprocess.run(
        [*command, '-o', str(tmp_path / 'bag')],
        cwd=ROOT,
        env=os.environ,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    bag = open_bag(tmp_path / 'bag')
    assert SERVO_CF not in bag.topics() and f'/replay{SERVO_CF}' in bag.topics()
    cut = [m for m in map(bag.read, bag.messages([UPDATES])) if m.cut_step]
    assert cut


def test_a_start_beyond_the_end_is_refused() -> None:
    from cutting_trainer.recordings.replay_command import ReplayOptions, replay

    options = ReplayOptions(SAMPLE, True, 1.0, 1e4, False, 'free', None, False)
    with pytest.raises(SessionError, match='the session lasts'):
        replay(options)
