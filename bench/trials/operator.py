"""Operator of a session: guides the hand, enables the force, and records observations."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import rclpy
from cutting_trainer_msgs.msg import ForceSample, MeshDelta
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bench.trials.chaos_verdict import Observations
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import WrenchStampedCodec
from cutting_trainer.node_common.operating_state import CrtkState, crtk_types
from cutting_trainer.node_common.orientation import quaternion
from cutting_trainer.session.node_commands import BRIDGE_NODE
from cutting_trainer.session.scene_loader import Scene

POLL_PERIOD_S = 0.002
GOAL_PERIOD_S = 1 / 60
COMMAND_PERIOD_S = 0.5
FAULTS = 'chaos/fault'


class Operator:
    """Guide the hand, enable arm and bridge whenever they are disabled, and record observations.

    It runs in a thread, in the role of a person: nothing else enables a force.

    Args:
        scene: scene whose script the hand repeats, each time at another place.
        domain: ROS domain.
        seed: seed of those places.
        seconds: duration of the script [s]; 0: its own.
        forged: returns whether a message of a topic is not from the session's nodes; it is ignored.
    """

    def __init__(
        self,
        scene: Scene,
        domain: int,
        seed: int,
        seconds: float = 0.0,
        forged: Callable[[str, bytes], bool] = lambda topic, data: False,
    ) -> None:
        self.seen = Observations()
        self._forged = forged
        self._seconds = seconds or scene.arm.require_script().seconds
        script = scene.arm.require_script()
        points = [w.position for phase in script.phases for w in phase.waypoints]
        self._path = np.array([script.start.position, *points])
        rotation = script.start.rotation()
        self._orientation = quaternion(np.eye(3) if rotation is None else rotation)
        self._random = np.random.default_rng(seed)
        self._began = time.monotonic()
        self._round, self._shift = -1, np.zeros(3)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = node = Node('operator', context=self._context)
        types = crtk_types()
        self._command_type = types.command
        self._wrench = WrenchStampedCodec()
        self._servo = ros.polled(node, WrenchStamped, f'{ros.ARM}/servo_cf', qos.STREAM)
        self._felt = ros.polled(node, WrenchStamped, f'{ros.ARM}/measured_cf', qos.STREAM)
        self._force = ros.polled(node, ForceSample, ros.FORCE, qos.STREAM)
        self._updates = ros.polled(node, MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self._goals = node.create_publisher(PoseStamped, ros.HAND, qos.EVENTS)
        self._states = {
            name: ros.polled(node, types.operating_state, f'{name}/operating_state', qos.LATCHED)
            for name in (ros.ARM, BRIDGE_NODE)
        }
        self._commands = {
            name: node.create_publisher(types.command, f'{name}/state_command', qos.EVENTS)
            for name in self._states
        }
        self._reset = node.create_client(Trigger, f'{BRIDGE_NODE}/reset_e_stop')
        self._newest: dict[str, Any] = {}
        self._faults = node.create_publisher(String, FAULTS, qos.HISTORY)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def now(self) -> float:
        """Time since the start [s]."""
        return time.monotonic() - self._began

    def log_fault(self, fault: str) -> None:
        """Publish a fault for the bag."""
        self._faults.publish(String(data=fault))

    def take_seen(self) -> Observations:
        """Return the observations since the last call; they take 24 MB a minute."""
        seen, self.seen = self.seen, Observations()
        return seen

    def end(self) -> None:
        """Stop the thread and destroy the node."""
        self._stop.set()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _run(self) -> None:
        goal_due = ask_due = 0.0
        while not self._stop.is_set():
            time.sleep(POLL_PERIOD_S)
            self._listen()
            self._executor.spin_once(timeout_sec=0)
            now = self.now
            if now >= goal_due:
                goal_due = now + GOAL_PERIOD_S
                self._goals.publish(self._goal(now))
            if now >= ask_due:
                ask_due = now + COMMAND_PERIOD_S
                self._enable(now)

    def _enable(self, now: float) -> None:
        """Send the next command towards an enabled force: the bridge refuses before the arm."""
        for name in (ros.ARM, BRIDGE_NODE):
            newest = self._newest.get(name)
            if newest is not None and not newest.is_homed:
                word = 'home'
            elif newest is None or newest.state != CrtkState.ENABLED:
                word = 'resume' if newest and newest.state == CrtkState.PAUSED else 'enable'
            else:
                continue
            if name == BRIDGE_NODE:
                self.seen.enabled.append(now)
                if self._reset.service_is_ready():  # a fuzzer may have pressed E-STOP
                    self._reset.call_async(Trigger.Request())
            self._commands[name].publish(self._command_type(string=word))

    def _take(self, subscription: Any) -> Iterator[bytes]:
        """Return messages of the session's nodes since the last call."""
        topic = subscription.topic_name
        while (data := ros.take_raw(subscription)) is not None:
            if not self._forged(topic, data):
                yield data

    def _listen(self) -> None:
        seen = self.seen
        for subscription, rows in ((self._servo, seen.commanded), (self._felt, seen.felt)):
            for raw in self._take(subscription):
                sample = self._wrench.decode(raw)
                rows.append((self.now, sample.stamp_ns * 1e-9, *sample.values[:3]))
        for _ in self._take(self._force):
            seen.samples.append(self.now)
        for raw in self._take(self._updates):
            seen.topologies.append((self.now, ros.read(raw, MeshDelta).topology))
        for name, states in self._states.items():
            for raw in self._take(states):
                self._newest[name] = state = ros.read(raw, states.msg_type)
                if name == BRIDGE_NODE:
                    seen.states.append((self.now, state.state))

    def _goal(self, now: float) -> PoseStamped:
        moment = now / self._seconds
        if int(moment) != self._round:
            self._round = int(moment)
            self._shift[:2] = self._random.uniform(-0.004, 0.004, 2)
        at = (moment % 1.0) * (len(self._path) - 1)
        position = [np.interp(at, np.arange(len(self._path)), axis) for axis in self._path.T]
        goal = PoseStamped()
        goal.header.frame_id, goal.header.stamp = ros.FRAME, ros.stamp(time.time_ns())
        p, q = goal.pose.position, goal.pose.orientation
        p.x, p.y, p.z = (float(x) for x in np.array(position) + self._shift)
        q.x, q.y, q.z, q.w = (float(x) for x in self._orientation)
        return goal
