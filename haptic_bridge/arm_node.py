"""Node `emulated_arm`: a haptic device after CRTK, with an operator's hand on it."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from sensor_msgs.msg import Joy

from haptic_bridge.arm import EmulatedArm
from haptic_bridge.arm_settings import ArmSettings
from haptic_bridge.convention import DeviceConvention
from haptic_bridge.crtk import StateInterface
from haptic_bridge.hand import Hand, compile_script
from haptic_bridge.operating_state import OperatingStateMachine, State, crtk_types
from haptic_bridge.orientation import from_quaternion, quaternion
from haptic_bridge.realtime import prepare, run_real_time
from haptic_bridge.settings import DeviceSettings
from haptic_bridge.stream_watch import StreamWatch
from haptic_bridge.wire import PoseStampedCodec, TwistStampedCodec, WireError, WrenchStampedCodec
from tissue_sim.lifecycle import ManagedNode, Stop, announce_ready, run
from tissue_sim.parameters import parameter, scene_parameter, seed_parameter
from tissue_sim.refusals import MessageError, require_frame
from tissue_sim.ros import (
    ARM,
    EVENTS,
    HAND,
    LATCHED,
    NEWEST_BEST_EFFORT,
    STREAM,
    Diagnostics,
    listen,
    polled,
    stamp,
    take_numbered,
)
from tissue_sim.scene_file import read_section
from tissue_sim.timing import Durations, PeriodicLoop

_LONGEST_CATCH_UP = 50
_LONGEST_SCRIPT = 86400.0
"""[s]"""
_FARTHEST_GOAL = 1.0
"""[m] from the origin of the tissue frame that a goal of the hand may be."""
_NO_TORQUE = (0.0, 0.0, 0.0)


class ArmNode(ManagedNode):
    """Publishes where the arm is, takes the force for the hand.

    Parameters:
        scene: path of the scene file.
        seconds: [s] duration of the script; 0: as in the scene.
        seed: of the tremor.
        auto_enable: start in the state ENABLED.
        wait_for_bridge: begin the script when the bridge is ENABLED and commands; else when the
            arm itself is ENABLED. In the state PAUSED it stands still.
        guided: the hand has no script; it stays at its start until it is given goals.

    A goal for the hand on `arm/hand/servo_cp`, in the tissue frame as the script is, takes the hand
    off its script for good.

    It speaks as the scene's section `device` says (unit, mirrored axis, sign, force frame), so that
    a bridge with the same scene understands it.
    """

    def __init__(self) -> None:
        super().__init__('emulated_arm')

    def configure(self) -> None:
        """Reads the scene, makes the arm, its hand and its topics."""
        scene = Path(scene_parameter(self))
        text = "duration that the script is stretched to [s]; 0: the script's own"
        seconds = float(parameter(self, 'seconds', 0.0, text, within=(0.0, _LONGEST_SCRIPT)))
        seed = seed_parameter(self)
        settings = read_section(scene, 'arm', ArmSettings)
        device = read_section(scene, 'device', DeviceSettings)
        script = compile_script(settings.script, device.tissue_from_device, seconds)
        body_force = device.force_frame == 'body'
        self._convention = DeviceConvention(device)
        self._frame = device.tissue_from_device
        text = 'begin the script when the bridge commands; else when the arm itself is ENABLED'
        self._waits = bool(parameter(self, 'wait_for_bridge', True, text))
        text = 'the hand has no script: it stays at its start until it is given goals'
        guided = bool(parameter(self, 'guided', False, text))

        def new_arm() -> EmulatedArm:
            hand = Hand(settings.hand, script, seed)
            return EmulatedArm(settings, hand, body_force=body_force, refusals=self.refusals)

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
        self._watch = StreamWatch(f'{ARM}/servo_cf')
        self._machine = OperatingStateMachine(lambda: self._watch.cause(time.monotonic_ns()))
        if parameter(self, 'auto_enable', True, 'start in the state ENABLED'):
            self._machine.command('enable')
        self._loop = PeriodicLoop(settings.rate)
        self._force_age = Durations('force_age')
        self._missed = 0
        self._bridge_enabled = False
        self._done = False
        self._connect(settings.frame_id)

    def _connect(self, frame_id: str) -> None:
        self._cp = PoseStampedCodec(frame_id)
        self._cv = TwistStampedCodec(frame_id)
        self._cf = WrenchStampedCodec(frame_id)
        self._measured_cp = self.create_publisher(PoseStamped, f'{ARM}/measured_cp', STREAM)
        self._measured_cv = self.create_publisher(TwistStamped, f'{ARM}/measured_cv', STREAM)
        self._measured_cf = self.create_publisher(WrenchStamped, f'{ARM}/measured_cf', STREAM)
        self._servo_cf = polled(self, WrenchStamped, f'{ARM}/servo_cf', NEWEST_BEST_EFFORT)
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
        self._real_time = ''
        self._diagnostics = Diagnostics(self, self._status)

    def work(self, stop: Stop) -> None:
        """Runs the loop of the arm in the calling thread."""
        self._real_time = prepare()
        self.get_logger().info(self._real_time)
        self._tick(0)
        announce_ready(self)
        run_real_time(self._loop, self._tick, stop)

    def release(self) -> None:
        """Publishes the last totals."""
        self._diagnostics.publish()

    def _tick(self, _late_ns: int) -> None:
        arm, now = self._arm, time.monotonic_ns()
        self._take_command(now)
        enabled = self._machine.state is State.ENABLED
        self._begun |= self._bridge_enabled and arm.commanded if self._waits else enabled
        arm.script_running = self._begun and self._machine.state is not State.PAUSED
        passed = 1 + self._loop.missed - self._missed
        self._missed = self._loop.missed
        arm.advance(now, enabled=enabled, steps=min(passed, _LONGEST_CATCH_UP))
        self._publish(time.time_ns())
        self._states.publish_changes()
        self._press(self._script.button_at(arm.script_time))
        if arm.script_over and not self._done:
            self._done = True
            print(f'done: {self.get_name()}', flush=True)

    def _take_command(self, now: int) -> None:
        taken = take_numbered(self._servo_cf)
        if taken is None:
            return
        try:
            stamp, _, values = self._cf.decode(taken[0])
        except WireError as error:
            self._arm.refuse(error)
            return
        self._force_age.add(time.time_ns() - stamp)
        # Its stamps are the bridge's affair: the watchdog goes by arrivals.
        problem = self._watch.see(taken[1], 0, now)
        if problem and self._machine.state is State.ENABLED:
            self._machine.fault(problem)
        self._arm.command(stamp, self._convention.force(values)[:3], now)

    def _press(self, pressed: bool) -> None:
        """Publishes the button on event, as CRTK has it: 1 pressed, 0 released."""
        if pressed is not self._pressed:
            self._pressed = pressed
            message = Joy(buttons=[int(pressed)])
            message.header.stamp = stamp(time.time_ns())
            self._button.publish(message)

    def _publish(self, stamp: int) -> None:
        arm, spoken = self._arm, self._convention
        pose = spoken.spoken_pose((*arm.position.tolist(), *arm.orientation.tolist()))
        twist = spoken.spoken_twist((*arm.velocity.tolist(), *arm.angular_velocity.tolist()))
        wrench = spoken.force((*arm.force.tolist(), *_NO_TORQUE))
        self._measured_cp.publish(self._cp.encode(stamp, pose))
        self._measured_cv.publish(self._cv.encode(stamp, twist))
        self._measured_cf.publish(self._cf.encode(stamp, wrench))

    def _guide(self, data: bytes) -> None:
        """Takes a goal for the hand; what cannot be one is refused, and the hand stays."""
        try:
            goal = self._cp.believed(data)
            require_frame(HAND, goal.frame_id)
            position, turn = np.array(goal.values[:3]), np.array(goal.values[3:])
            if np.linalg.norm(position) > _FARTHEST_GOAL:
                text = f'{position} m is farther than {_FARTHEST_GOAL:g} m'
                raise MessageError('not finite or too far', text)
        except MessageError as error:
            self.refusals.add(HAND, error)
            return
        turned = self._frame.rotation().T @ from_quaternion(turn)
        self._arm.guide(self._frame.to_device(position), quaternion(turned))

    def _bridge_state(self, message: Any) -> None:
        self._bridge_enabled = message.state == State.ENABLED

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        arm, machine = self._arm, self._machine
        name, kind = self._script.phase_at(arm.script_time)
        values = (
            self._loop.report()
            | self._force_age.report()
            | {
                'state': machine.state,
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
    """Entry point of the process."""
    run(ArmNode)


if __name__ == '__main__':
    main()
