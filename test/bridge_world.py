"""A device at 1 kHz and a simulation at 30 Hz, played to a bridge in a process of its own."""
# ruff: noqa: E402

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')
messages = pytest.importorskip('cutting_trainer_msgs.msg')
services = pytest.importorskip('cutting_trainer_msgs.srv')

from diagnostic_msgs.msg import DiagnosticArray
from flat_tissue import POSITIONS, TRIANGLES
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.realtime import PRIORITY
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.node_common.timing import request_real_time

ROOT = Path(__file__).resolve().parents[1]
RADIUS = 0.004
K = 80.0
DEPTH = 5e-3
ABOVE, PRESSED = RADIUS + 2e-3, RADIUS - DEPTH
SCHEDULING = 0.03
"""[s] that a shared machine may let a process wait."""


def refused(status: dict[str, str]) -> int:
    """Messages that a node has refused, by its status on /diagnostics."""
    return sum(int(value) for key, value in status.items() if key.startswith('refused '))


MAX_POSE_GAP_S = 0.015
"""Longest time between two poses in a session that counts; the bridge comes to a FAULT at 20 ms."""


@dataclass
class Record:
    """What happened, by the clock of this machine."""

    wrenches: list[StampedMessage] = field(default_factory=list)
    contacts: list[StampedMessage] = field(default_factory=list)
    states: list[tuple[int, str]] = field(default_factory=list)
    statuses: list[dict[str, str]] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    marks: dict[str, float] = field(default_factory=dict)
    longest_pose_gap: float = 0.0

    def forces(self, after: str, delay: float = 0.0, before: str = '') -> np.ndarray:
        """z components [N] stamped from `delay` after one mark up to another."""
        start = self.marks[after] + delay * 1e9
        end = self.marks[before] if before else np.inf
        return np.array([w.values[2] for w in self.wrenches if start <= w.stamp_ns < end])


class HeldUpError(AssertionError):
    """The device, which this test is, was itself kept from running."""


class World:
    """Device at 1 kHz and simulation at 30 Hz over a flat elastic tissue.

    The bridge starts after the simulation, so that it has to ask for the full mesh.
    """

    def __init__(self, record: Record) -> None:
        self.record = record
        self.node = rclpy.create_node('world')
        make, poll = self.node.create_publisher, ros.polled
        self.pose = make(PoseStamped, 'arm/measured_cp', qos.STREAM)
        self.mesh = make(messages.Mesh, ros.MESH, qos.LATCHED)
        self.updates = make(messages.MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self.force = make(messages.ForceSample, ros.FORCE, qos.STREAM)
        types = crtk_types()
        self.command = make(types.command, 'haptic_bridge/state_command', qos.EVENTS)
        self.message = types.command
        self.wrench = poll(self.node, WrenchStamped, 'arm/servo_cf', qos.EVENTS)
        self.contact = poll(self.node, messages.Contact, ros.CONTACT, qos.EVENTS)
        self.state = poll(
            self.node, types.operating_state, 'haptic_bridge/operating_state', qos.LATCHED
        )
        self.status = poll(self.node, DiagnosticArray, ros.DIAGNOSTICS, qos.EVENTS)
        self.log = poll(self.node, Log, '/rosout', qos.STREAM)
        self.place = (0.0, 0.0)
        self.height = ABOVE
        self.poses = self.simulation = True
        self.frame_period = 33  # [ms]
        self.revision = 0
        self.last_pose = self.last_force = 0
        self._codecs = (PoseStampedCodec('arm_base'), ForceSampleCodec('tissue'))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._service = self.node.create_service(services.GetMesh, ros.GET_MESH, self._answer)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._server = threading.Thread(target=self._executor.spin)
        self.mesh.publish(self._full_mesh())
        self._thread.start()
        self._server.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._executor.shutdown()
        self._server.join()
        self.node.destroy_node()

    def move(self, height: float, seconds: float) -> None:
        """Moves the device evenly."""
        start, began = self.height, time.monotonic()
        while (share := (time.monotonic() - began) / seconds) < 1:
            self.height = start + (height - start) * share
            time.sleep(0.002)
        self.height = height

    def wait_for(self, state: str, timeout: float) -> None:
        """Waits until the bridge has announced a state."""
        end = time.monotonic() + timeout
        while not self.record.states or self.record.states[-1][1] != state:
            if time.monotonic() >= end:
                said = f'no {state}: {self.record.states}'
                if (gap := self.record.longest_pose_gap) >= MAX_POSE_GAP_S:
                    raise HeldUpError(f'{said}; the device was held up for {gap:.3f} s')
                raise AssertionError(said)
            time.sleep(0.01)

    def wait_until(self, condition: Callable[[], bool], timeout: float = 5.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, 'waited in vain'
            time.sleep(0.01)

    def encoded_pose(self, stamp: int, height: float) -> bytes:
        return self._codecs[0].encode(stamp, (*self.place, height, 0.0, 0.0, 0.0, 1.0))

    def send_pose(self, now: int, tick: int) -> None:
        self.pose.publish(self.encoded_pose(now, self.height))

    def send_frame(self) -> None:
        self.updates.publish(self.next_delta())
        self.force.publish(self.next_force())

    def _run(self) -> None:
        request_real_time(PRIORITY)
        ticks, deadline, going = 0, time.monotonic(), False
        while not self._stop.is_set():
            if self.poses:
                now = time.time_ns()
                if going:
                    gap = (now - self.last_pose) / 1e9
                    self.record.longest_pose_gap = max(self.record.longest_pose_gap, gap)
                self.last_pose = now
                self.send_pose(now, ticks)
            going = self.poses
            if self.simulation and ticks % self.frame_period == 0:
                self.send_frame()
            self._listen()
            ticks += 1
            deadline += 0.001
            time.sleep(max(deadline - time.monotonic(), 0.0))

    def _listen(self) -> None:
        while (raw := ros.take_raw(self.wrench)) is not None:
            self.record.wrenches.append(WrenchStampedCodec().decode(raw))
        while (raw := ros.take_raw(self.contact)) is not None:
            self.record.contacts.append(ContactCodec().decode(raw))
        while (message := ros.take(self.state)) is not None:
            self.record.states.append((nanoseconds(message.header.stamp), message.state))
        while (message := ros.take(self.log)) is not None:
            self.record.said.append(message.msg)
        while (message := ros.take(self.status)) is not None:
            self.record.statuses.append({v.key: v.value for v in message.status[0].values})

    def _answer(self, _request: object, response: Any) -> Any:
        response.success, response.mesh = True, self._full_mesh()
        return response

    def _full_mesh(self) -> messages.Mesh:
        mesh = messages.Mesh(
            revision=self.revision,
            topology=1,
            rest=POSITIONS.ravel().tolist(),
            displacement=[0.0] * POSITIONS.size,
            fixed=[0] * len(POSITIONS),
            triangles=TRIANGLES.ravel().tolist(),
            triangle_kind=[0] * len(TRIANGLES),
        )
        mesh.header.frame_id = ros.FRAME
        mesh.header.stamp = self.node.get_clock().now().to_msg()
        return mesh

    def next_delta(self) -> messages.MeshDelta:
        """A surface that stays where it is."""
        self.revision += 1
        delta = messages.MeshDelta(
            base_revision=self.revision - 1,
            revision=self.revision,
            topology=1,
            node_count=len(POSITIONS),
            triangle_count=len(TRIANGLES),
            displacement=[0.0] * POSITIONS.size,
        )
        delta.header.stamp = self.node.get_clock().now().to_msg()
        delta.header.frame_id = ros.FRAME
        return delta

    def next_force(self) -> bytes:
        """The answer of a tissue that pushes back with K."""
        heard = self.record.contacts[-1] if self.record.contacts else None
        sequence, state = heard.values[:2] if heard else (0, 0)
        device = heard.values[ContactCodec.fields['device']] if heard else (0.0, 0.0, 1.0)
        stamp = divmod(heard.stamp_ns if heard else 0, 10**9)
        depth = max(RADIUS - device[2], 0.0) if state else 0.0
        values = (self.revision, self.revision, 1, sequence, *stamp, state, *device)
        values += (0.0, 0.0, K * depth, *(0.0,) * 8, K if state else 0.0, 0.0, 0.0, 0.0)
        self.last_force = time.time_ns()
        self.record.frames.append(self.last_force)
        return self._codecs[1].encode(self.last_force, values)


def session(
    scene: Path,
    domain: int,
    play: Callable[[Any, Record], None],
    make_world: Callable[[Record], World] = World,
) -> Record:
    """Runs the bridge in a process of its own through what `play` does."""
    environment = os.environ | {'ROS_DOMAIN_ID': str(domain)}
    arguments = ['-p', f'scene:={scene}', '-p', 'auto_enable:=true']
    bridge = subprocess.Popen(
        [sys.executable, '-m', 'cutting_trainer.haptic_bridge.node', '--ros-args', *arguments],
        cwd=ROOT,
        env=environment,
    )
    rclpy.init(domain_id=domain)
    record = Record()
    world = make_world(record)
    try:
        play(world, record)
        bridge.send_signal(signal.SIGINT)
        record.marks['exit status'] = bridge.wait(10.0)
        time.sleep(0.1)
    finally:
        bridge.kill()
        bridge.wait()
        world.close()
        rclpy.shutdown()
    return record
