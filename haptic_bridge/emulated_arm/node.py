"""Node `emulated_arm`: an emulated haptic device with a CRTK interface and an operator's hand."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from sensor_msgs.msg import Joy

from cutting_trainer.haptic_bridge.devices.convention import DeviceConvention
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.faults import DriverFaults
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.cdr_codec import (
    PoseStampedCodec,
    TwistStampedCodec,
    WireError,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.crtk import StateInterface
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, name_of, run
from cutting_trainer.node_common.operating_state import CrtkState, OperatingStateMachine, crtk_types
from cutting_trainer.node_common.orientation import from_quaternion, quaternion
from cutting_trainer.node_common.output import announce
from cutting_trainer.node_common.parameters import (
    parameter,
    scene_parameter,
    seed_parameter,
    tool_parameter,
)
from cutting_trainer.node_common.publishers import PublisherMonitor
from cutting_trainer.node_common.qos import EVENTS, LATCHED, NEWEST_BEST_EFFORT, STREAM
from cutting_trainer.node_common.realtime import prepare, run_real_time
from cutting_trainer.node_common.rejections import MessageError, require_frame
from cutting_trainer.node_common.ros import (
    ARM,
    HAND,
    Diagnostics,
    listen,
    polled,
    publish_raw,
    stamp,
    take_numbered,
)
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.node_common.stream_monitor import StreamMonitor
from cutting_trainer.node_common.timing import Durations, PeriodicLoop

_MAX_CATCH_UP = 50
_POLL_PERIOD_NS = 50_000_000
"""[ns] between two checks for the publisher of commands."""
_MAX_SCRIPT_S = 86400.0
"""[s]"""
_MAX_GOAL_DISTANCE_M = 1.0
"""[m] Largest distance of a goal of the hand from the origin of the tissue frame."""
_NO_TORQUE = (0.0, 0.0, 0.0)


class ArmNode(ManagedNode):
    """Publishes the state of the arm, and subscribes to the force on the hand.

    Parameters:
        scene: path of the scene file.
        tool: name of its tool in the section `tools`; empty: the first.
        seconds: [s] duration of the script; 0: as in the scene.
        seed: of the tremor.
        auto_enable: start in the state ENABLED.
        wait_for_bridge: begin the script when the bridge is ENABLED and commands; else when the
            arm itself is ENABLED. In the state PAUSED it stands still.
        guided: the hand has no script; it stays at its start until a goal arrives.
        faults: faults of the driver (`cutting_trainer.haptic_bridge.emulated_arm.faults`).

    A goal for the hand on `arm/hand/servo_cp`, in the tissue frame as the script is, takes the hand
    off its script for good.

    It follows the scene's section `device` (unit, mirrored axis, sign, force frame), so that
    a bridge with the same scene understands it.
    """

    def __init__(self) -> None:
        super().__init__('emulated_arm')

    def configure(self) -> None:
        """Read the scene, create the arm, its hand and its topics."""
        scene = Path(scene_parameter(self))
        text = "duration to which the script is stretched [s]; 0: the script's own"
        seconds = float(parameter(self, 'seconds', 0.0, text, within=(0.0, _MAX_SCRIPT_S)))
        seed = seed_parameter(self)
        tool = tool_parameter(self)
        settings = read_section(scene, 'arm', ArmSettings, tool)
        device = read_section(scene, 'device', DeviceSettings, tool)
        script = compile_script(settings.require_script(), device.tissue_from_device, seconds)
        body_force = device.force_frame == 'body'
        self._convention = DeviceConvention(device)
        self._frame = device.tissue_from_device
        text = 'begin the script when the bridge commands; else when the arm itself is ENABLED'
        self._waits = bool(parameter(self, 'wait_for_bridge', True, text))
        text = 'the hand has no script: it stays at its start until a goal arrives'
        guided = bool(parameter(self, 'guided', False, text))

        def new_arm() -> EmulatedArm:
            hand = EmulatedHand(settings.hand, script, seed)
            return EmulatedArm(settings, hand, body_force=body_force, rejections=self.rejections)

        for guide in (False, True):  # compiles the kernels before the clock runs
            arm = new_arm()
            if guide:
                arm.guide(arm.position, arm.orientation)
            arm.advance(0, enabled=False)
        self._arm = new_arm()
        if guided:
            self._arm.guide(self._arm.position, self._arm.orientation)
        self._begun = False
        self._script = script
        text = 'faults of the driver, as in "turn=30 gain=5"; for trials of the probe'
        self._faults = DriverFaults.read(str(parameter(self, 'faults', '', text)))
        self._force_topic = f'{ARM}/{device.force_topic}'
        self._watch = StreamMonitor(self._force_topic)
        self._senders = PublisherMonitor(self, [self._force_topic])
        self._machine = OperatingStateMachine(
            lambda: self._watch.cause(time.monotonic_ns()) or self._senders.cause,
            latches=False,
        )
        if parameter(self, 'auto_enable', True, 'start in the state ENABLED'):
            self._machine.command('enable')
        number = ('', *tool_names(scene)).index(tool)
        self._loop = PeriodicLoop(settings.rate, phase=(number + 1) / 2)
        self._force_age = Durations('force_age')
        self._missed = self._next_look = 0
        self._bridge_enabled = False
        self._done = False
        self._connect(settings.frame_id)

    def _connect(self, frame_id: str) -> None:
        self._frame_id, self._started = frame_id, time.monotonic()
        self._cp = PoseStampedCodec(frame_id)
        self._cv = TwistStampedCodec(frame_id)
        self._cf = WrenchStampedCodec(frame_id)
        self._measured_cp = self.create_publisher(PoseStamped, f'{ARM}/measured_cp', STREAM)
        self._measured_cv = self.create_publisher(TwistStamped, f'{ARM}/measured_cv', STREAM)
        self._measured_cf = self.create_publisher(WrenchStamped, f'{ARM}/measured_cf', STREAM)
        self._servo_cf = polled(self, WrenchStamped, self._force_topic, NEWEST_BEST_EFFORT)
        self._button = self.create_publisher(Joy, f'{ARM}/button', EVENTS)
        self._pressed: bool | None = None
        self._states = StateInterface(self, ARM, self._machine)
        self._bridge = listen(
            self,
            crtk_types().operating_state,
            'haptic_bridge/operating_state',
            self._bridge_state,
            LATCHED,
        )
        self._goals = self.create_subscription(PoseStamped, HAND, self._guide, EVENTS, raw=True)
        self._held: tuple[float, ...] | None = None
        self._real_time = ''
        self._diagnostics = Diagnostics(self, self._status)

    @property
    def progress(self) -> int:
        """Return the number of loop iterations."""
        return self._loop.ticks

    def work(self, stop: Stop) -> None:
        """Run the loop of the arm in the calling thread."""
        self._real_time = prepare()
        self.get_logger().info(self._real_time)
        self._tick(0)
        announce_ready(self)
        run_real_time(self._loop, self._tick, stop)

    def release(self) -> None:
        """Publish the last totals."""
        self._diagnostics.publish()

    def _tick(self, _late_ns: int) -> None:
        arm, now = self._arm, time.monotonic_ns()
        if now >= self._next_look:
            self._next_look = now + _POLL_PERIOD_NS
            if stranger := self._senders.look(now * 1e-9):
                self._machine.fault(stranger)
        self._take_command(now)
        enabled = self._machine.state is CrtkState.ENABLED
        self._begun |= self._bridge_enabled and arm.commanded if self._waits else enabled
        arm.script_running = self._begun and self._machine.state is not CrtkState.PAUSED
        passed = 1 + self._loop.missed - self._missed
        self._missed = self._loop.missed
        arm.advance(now, enabled=enabled, steps=min(passed, _MAX_CATCH_UP))
        self._publish(time.time_ns())
        self._states.publish_changes()
        self._press(self._script.button_at(arm.script_time))
        if arm.script_over and not self._done:
            self._done = True
            announce(f'done: {name_of(self)}')

    def _take_command(self, now: int) -> None:
        taken = take_numbered(self._servo_cf)
        if taken is None:
            if self._faults.held and self._held is not None:
                self._arm.command(time.time_ns(), self._held, now)
            return
        try:
            stamp, _, values = self._cf.decode(taken[0])
        except WireError as error:
            self._arm.reject(error)
            return
        self._force_age.add(time.time_ns() - stamp)
        # The bridge checks its own stamps: the watchdog goes by arrivals.
        problem = self._watch.see(taken[1], 0, now)
        if problem and self._machine.state is CrtkState.ENABLED:
            self._machine.fault(problem)
        self._held = self._faults.force(self._convention.force(values)[:3])
        self._arm.command(stamp, self._held, now)

    def _press(self, pressed: bool) -> None:
        """Publish the button on event, as CRTK has it: 1 pressed, 0 released."""
        if pressed is not self._pressed:
            self._pressed = pressed
            message = Joy(buttons=[int(pressed)])
            message.header.stamp = stamp(time.time_ns())
            self._button.publish(message)

    def _publish(self, stamp: int) -> None:
        arm, spoken = self._arm, self._convention
        pose = spoken.to_device_pose(tuple(arm.pose.tolist()))
        twist = spoken.to_device_twist(tuple(arm.twist.tolist()))
        wrench = spoken.force((*arm.force.tolist(), *_NO_TORQUE))
        frame = self._faults.frame(self._frame_id, time.monotonic() - self._started)
        if frame != self._frame_id:
            self._frame_id, self._cp = frame, PoseStampedCodec(frame)
            self._faults = replace(self._faults, frame_after=0.0)
        publish_raw(self._measured_cp, self._cp.encode(stamp, self._faults.pose(pose)))
        publish_raw(self._measured_cv, self._cv.encode(stamp, twist))
        publish_raw(self._measured_cf, self._cf.encode(stamp, wrench))

    def _guide(self, data: bytes) -> None:
        """Decode a goal for the hand; an invalid one is rejected, and the hand stays."""
        try:
            goal = self._cp.believed(data)
            if goal.frame_id:  # clients of CRTK leave it empty
                require_frame(HAND, goal.frame_id)
            position, orientation = np.array(goal.values[:3]), np.array(goal.values[3:])
            if np.linalg.norm(position) > _MAX_GOAL_DISTANCE_M:
                text = f'{position} m is farther than {_MAX_GOAL_DISTANCE_M:g} m'
                raise MessageError('not finite or too far', text)
        except MessageError as error:
            self.rejections.add(HAND, error)
            return
        turned = self._frame.rotation().T @ from_quaternion(orientation)
        self._arm.guide(self._frame.to_device(position), quaternion(turned))

    def _bridge_state(self, message: Any) -> None:
        self._bridge_enabled = message.state == CrtkState.ENABLED

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        arm, machine = self._arm, self._machine
        name, kind = self._script.phase_at(arm.script_time)
        values = (
            self._loop.report()
            | self._force_age.report()
            | {
                'state': machine.state,
                'stranger': self._senders.cause,
                'real_time': self._real_time,
                'watchdog_trips': arm.watchdog_trips,
                'force_norm': math.hypot(*arm.force.tolist()),
                'phase': name,
                'phase_kind': kind,
                'script_time': arm.script_time,
                'script_seconds': self._script.seconds,
            }
        )
        if arm.watchdog_trips and not arm.commanded:
            return DiagnosticStatus.WARN, 'servo_cf has stopped: no force on the hand', values
        return DiagnosticStatus.OK, machine.reason or str(machine.state), values


def main() -> None:
    """Run the node."""
    run(ArmNode)


if __name__ == '__main__':
    main()
