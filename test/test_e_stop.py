"""E-STOP on a running bridge: pressed in every way, under a flood, in FAULT, over its death.

The bridge runs under the launcher's supervisor, a device and a tissue are played to it. Deadlines
are those of the stamps in the recorded forces.
"""

import os
import pty
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import rclpy
from bridge_world import DEPTH, PRESSED, K, Record, World
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool, Empty
from std_srvs.srv import Trigger

from bench.flood import OFFERED_WORDS_PER_S, Flood
from cutting_trainer.node_common import qos, ros
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import BRIDGE_NODE, node_command, node_environment
from cutting_trainer.session.supervisor import Event, Supervisor

pytestmark = pytest.mark.live

FELT = K * DEPTH
SCENE = """
tool: {radius: 0.004, coupling_stiffness: 200}
device: {profile: dvrk_mtm, e_stop_button: 1}
haptics: {soft_start: 0.0, device_timeout: 0.5, stale_after: 1.0}
"""
"""A test that gets no turn is no fault here."""
PRESSES = 100
"""How often E-STOP is pressed while words are sent."""


class StoppedWorld(World):
    """A world with everything that presses E-STOP, and that hears what becomes of it."""

    def __init__(self, record: Record) -> None:
        self.e_stopped: list[bool] = []
        super().__init__(record)
        self.place = (0.01, -0.01)
        self.press_topic = self.node.create_publisher(Empty, ros.E_STOP, qos.EVENTS)
        self.button = self.node.create_publisher(Joy, 'arm/button', qos.EVENTS)
        self.client = self.node.create_client(Trigger, 'haptic_bridge/reset_e_stop')
        self.node.create_subscription(
            Bool, 'haptic_bridge/e_stopped', lambda m: self.e_stopped.append(m.data), qos.LATCHED
        )

    def say(self, word: str) -> None:
        self.command.publish(self.message(string=word))

    def reset(self) -> str:
        """Calls the service; returns what it says."""
        self.wait_until(self.client.service_is_ready)
        answer = self.client.call_async(Trigger.Request())
        self.wait_until(answer.done)
        return str(answer.result().message)

    def enable(self) -> None:
        """Enables the bridge, and waits until the tissue is felt."""
        self.wait_until(lambda: self.record.states[-1][1] == 'DISABLED')
        self.say('enable')
        self.wait_until(lambda: self.record.states[-1][1] == 'ENABLED')
        self.wait_until(lambda: self.record.wrenches[-1].values[2] > 0.9 * FELT)

    def stop(self, press: Callable[[], Any]) -> None:
        """Presses, and waits until the bridge says so."""
        told = len(self.e_stopped)
        press()
        self.wait_until(lambda: True in self.e_stopped[told:])

    def heard(self) -> int:
        """Resets, and returns the stamp [ns] of the tick that heard the press before."""
        return int(self.reset().rpartition(' at ')[2].removesuffix(' ns'))


class Session:
    """What was seen, in the order of `play`."""

    def __init__(self) -> None:
        self.record = Record()
        self.heard: dict[str, int] = {}
        self.under_flood: list[int] = []
        self.seen: dict[str, Any] = {}
        self.events: list[Event] = []

    def play(self, world: StoppedWorld, supervisor: Supervisor, key: Callable[[], Any]) -> None:
        self._ways(world, key)
        self._in_fault(world)
        self._flooded(world)
        self._killed(world, supervisor)

    def _ways(self, world: StoppedWorld, key: Callable[[], Any]) -> None:
        ways: dict[str, Callable[[], Any]] = {
            'topic': lambda: world.press_topic.publish(Empty()),
            'word': lambda: world.say('e_stop'),
            'button': lambda: world.button.publish(Joy(buttons=[0, 1])),
            'key': key,
        }
        world.wait_for('ENABLED', 60.0)
        world.wait_until(lambda: world.client.service_is_ready() and len(world.e_stopped) > 0)
        world.move(PRESSED, 0.2)
        world.wait_until(lambda: world.record.wrenches[-1].values[2] > 0.9 * FELT)
        for name, press in ways.items():
            world.stop(press)
            for word in ('enable', 'disable', 'resume', 'home', 'nonsense'):
                world.say(word)
            time.sleep(0.1)
            self.seen[name] = world.record.states[-1][1]
            if name == 'button':
                self.seen['held'] = world.reset()
                world.button.publish(Joy(buttons=[0, 0]))
                time.sleep(0.1)
            self.heard[name] = world.heard()
            world.enable()

    def _in_fault(self, world: StoppedWorld) -> None:
        world.poses = False
        world.wait_for('FAULT', 3.0)
        world.stop(lambda: world.press_topic.publish(Empty()))
        world.poses = True
        world.say('enable')
        time.sleep(0.3)
        self.seen['in fault'] = world.record.states[-1][1]
        world.reset()
        world.enable()

    def _flooded(self, world: StoppedWorld) -> None:
        domain = str(world.node.context.get_domain_id())
        environment = os.environ | {'ROS_DOMAIN_ID': domain}
        topic = world.command.topic_name
        with closing(Flood(topic, OFFERED_WORDS_PER_S, environment)) as flood:
            for _ in range(PRESSES):
                flood.begin()
                time.sleep(0.05)
                world.stop(lambda: world.press_topic.publish(Empty()))
                flood.pause()
                self.under_flood.append(world.heard())
                world.enable()

    def _killed(self, world: StoppedWorld, supervisor: Supervisor) -> None:
        pid = supervisor.pids[BRIDGE_NODE]
        world.stop(lambda: world.press_topic.publish(Empty()))
        os.kill(pid, signal.SIGKILL)
        world.wait_until(lambda: supervisor.pids.get(BRIDGE_NODE, pid) != pid, 20.0)
        told = len(world.e_stopped)
        world.wait_until(lambda: len(world.e_stopped) > told, 30.0)
        world.say('enable')
        time.sleep(1.0)  # everything is fresh, and auto_enable was set for this node
        self.seen['killed'] = (world.e_stopped[-1], world.record.states[-1][1])
        world.reset()
        world.say('enable')
        world.wait_for('ENABLED', 5.0)


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The bridge that the launcher starts again with auto_enable: only E-STOP may hold it back."""
    folder = tmp_path_factory.mktemp('e_stop')
    scene = folder / 'flat.yaml'
    scene.write_text(SCENE)
    seen = Session()
    ours, theirs = pty.openpty()
    stdin, sys.stdin = sys.stdin, os.fdopen(theirs)
    with pytest.MonkeyPatch.context() as patch, reserved_domain('free') as domain:
        patch.setattr('cutting_trainer.session.terminal_keys._of_another', lambda terminal: False)
        command = node_command(BRIDGE_NODE, {'scene': str(scene), 'auto_enable': True})
        command = command.__class__(
            command.name, command.argv, e_stop_arguments=command.e_stop_arguments
        )
        rclpy.init(domain_id=domain)
        world = StoppedWorld(seen.record)
        problems: list[BaseException] = []

        def play() -> None:
            try:
                seen.play(world, supervisor, lambda: os.write(ours, b' '))
            except BaseException as error:
                problems.append(error)

        actor = threading.Thread(target=play)
        environment = node_environment(domain)
        tell = seen.events.append
        try:
            with Supervisor(
                [command], folder / 'log', environment, tell, restart=True
            ) as supervisor:
                assert supervisor.start(), supervisor.outcome
                actor.start()
                supervisor.run(120.0, tick=lambda _: actor.is_alive())
        finally:
            world.close()
            rclpy.shutdown()
            sys.stdin = stdin
        if problems:
            raise problems[0]
    return seen


def nonzero_after(record: Record, heard: int) -> int:
    """Recorded forces from a tick on, to the next time that the bridge is ENABLED."""
    enabled = next((t for t, s in record.states if t > heard and s == 'ENABLED'), np.inf)
    return sum(heard <= w.stamp_ns < enabled - 50e6 and any(w.values) for w in record.wrenches)


@pytest.mark.parametrize('way', ['topic', 'word', 'button', 'key'])
def test_every_way_presses_it_and_the_force_is_zero_with_the_tick_that_hears_it(session, way):
    assert session.seen[way] == 'FAULT'
    assert nonzero_after(session.record, session.heard[way]) == 0
    before = [w.values[2] for w in session.record.wrenches if w.stamp_ns < session.heard[way]]
    assert before[-1] > 0.9 * FELT


def test_commands_are_refused_with_the_name_of_the_reset(session):
    said = [s for s in session.record.said if 'reset_e_stop' in s]
    assert said, session.record.said


def test_it_is_not_released_while_the_devices_button_is_held(session):
    assert 'still pressed' in session.seen['held']


def test_it_holds_when_it_is_pressed_in_fault(session):
    assert session.seen['in fault'] == 'FAULT'


def test_under_a_flood_of_words_each_is_heard_and_is_zero_force_with_its_tick(session):
    assert len(set(session.under_flood)) == PRESSES
    for heard in session.under_flood:
        assert nonzero_after(session.record, heard) == 0


def test_a_bridge_that_is_killed_is_started_again_with_it_and_does_not_enable_itself(session):
    assert session.seen['killed'] == (True, 'FAULT')
    assert [e.kind for e in session.events].count('died') == 1
