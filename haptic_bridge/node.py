"""Node `haptic_bridge`: subscribes to device poses and tissue forces, commands forces at 1 kHz."""

import math
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from cutting_trainer_msgs.msg import Contact
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.parameter import Parameter

from cutting_trainer.haptic_bridge.device_inputs import DeviceInputs
from cutting_trainer.haptic_bridge.devices.convention import DeviceConvention
from cutting_trainer.haptic_bridge.devices.probe_graph import Wiring
from cutting_trainer.haptic_bridge.e_stop_topic import EStop, Listener
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.indexing import scaled
from cutting_trainer.haptic_bridge.indexing_topic import IndexingTopic
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.haptic_bridge.simulation_follower import SimulationFollower
from cutting_trainer.haptic_bridge.warm_up import warm_up
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import (
    PoseStampedCodec,
    StampedMessage,
    WireError,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.crtk import DeviceState, HoldButton, StateInterface
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, run
from cutting_trainer.node_common.operating_state import (
    AutoEnable,
    CrtkState,
    OperatingStateMachine,
    crtk_types,
)
from cutting_trainer.node_common.parameters import (
    parameter,
    scene_parameter,
    seed_parameter,
    tool_parameter,
)
from cutting_trainer.node_common.publishers import PublisherMonitor
from cutting_trainer.node_common.realtime import prepare, run_real_time
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.node_common.stream_monitor import StreamMonitor
from cutting_trainer.node_common.timing import Durations, PeriodicLoop
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE, BladeConstants
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction
from cutting_trainer.tissue_sim.contact.tool import ToolMode
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

STATE_POLL_PERIOD_S = 0.02
"""[s] between two polls of the operating state and for any mesh, while the bridge works."""
GRAPH_CHECK_PERIOD_S = 0.25
"""[s] between two checks of the graph for a subscriber of the force, while force is on."""
WATCHED = (f'{ros.ARM}/measured_cp', ros.FORCE, ros.MESH, ros.MESH_UPDATES)
"""Topics that move the hand; each may have one publisher."""
CLOCK_STEP_NS = 1_000_000
"""[ns] by which the system clock may differ from the stamps before they follow it."""


SCALES = ('force_scale', 'motion_scale')
SETTABLE = (*SCALES, 'tool_mode')
"""Parameters that may change while the node runs."""
MODES = {mode.name.lower(): mode for mode in ToolMode}
"""Modes of the tool by the names that a scene and the parameter give them."""


class HapticBridge(ManagedNode):
    """ROS interface of `ForcePath`.

    Parameters:
        scene: path of the scene file.
        tool: name of its tool in the section `tools`; empty: the first.
        auto_enable: enter ENABLED when device, force and surface are fresh for the first time.
            Never again after that: a FAULT is left by a command only. Never after an E-STOP.
        e_stop_pressed: E-STOP is pressed from the start, as it was when this node died.
        force_scale: hand force over tissue force; may be set while the node runs.
        motion_scale: tool motion over hand motion; may be set while the node runs.
        tool_mode: one of `MODES`; may be set while the node runs. A blade in the tissue stays one
            until it is out.
        accepted_publishers: see `accepted_publishers`.
    """

    def __init__(self) -> None:
        super().__init__('haptic_bridge')
        text = 'E-STOP is pressed from the start: for a node that replaces a stopped one'
        pressed = bool(parameter(self, 'e_stop_pressed', False, text))
        self._machine = OperatingStateMachine(self._cause, pressed=pressed)
        self._e_stop: EStop | None = None
        Listener(self)

    def configure(self) -> None:
        """Read the scene, compile the force path, create the topics."""
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        text = 'enter ENABLED, once, when device, force and surface are fresh'
        wanted = bool(parameter(self, 'auto_enable', False, text))
        name, names = tool_parameter(self), ('', *tool_names(scene))
        device = read_section(scene, 'device', DeviceSettings, name)
        tool = read_section(scene, 'tool', ToolSettings, name)
        haptics = read_section(scene, 'haptics', HapticsSettings, name)
        number = names.index(name)
        profile = device.load_profile()
        text = 'hand force over tissue force [-], 0.001 to 100'
        felt = parameter(self, 'force_scale', haptics.force_scale, text, settable=True)
        text, scale = 'tool motion over hand motion [-], 0.001 to 100', device.tissue_from_device
        device = scaled(device, parameter(self, 'motion_scale', scale.scale, text, settable=True))
        resistance, friction, constants = of_tissue(scene)
        warm_up(tool, device, haptics, profile, friction)
        self._path = ForcePath(
            tool,
            device,
            haptics,
            profile,
            self.rejections,
            resistance,
            friction,
            constants,
            number,
        )
        self._path.coupling.change(force_scale=felt)
        self._machine.start_anew()
        self._auto_enable = AutoEnable(self._machine, wanted=wanted)
        self._convention = DeviceConvention(device)
        self._watch = StreamMonitor(f'{ros.ARM}/measured_cp')
        self._loop = PeriodicLoop(haptics.rate, phase=number / 2)
        self._latency = Durations('pose_to_force')
        self._real_time = 'the force loop has not started'
        self._faults, self._last_fault, self._was_faulty = 0, '', False
        self._pose_codec = PoseStampedCodec()
        self._wrench_codec = WrenchStampedCodec(f'{ros.ARM}_base')
        self._pose = ros.polled(self, PoseStamped, f'{ros.ARM}/measured_cp', qos.NEWEST_BEST_EFFORT)
        self._wrench = self.create_publisher(
            WrenchStamped, f'{ros.ARM}/{device.force_topic}', qos.STREAM
        )
        self._contact = self.create_publisher(Contact, ros.CONTACT, qos.STREAM)
        self._indexing = IndexingTopic(self, self._path.coupling)
        self._senders = PublisherMonitor(self, WATCHED, accepted_publishers(self, device))
        self._follower = SimulationFollower(self, self._machine.fault)
        self._interface = StateInterface(self, 'haptic_bridge', self._machine)
        self._device = DeviceState(self, ros.ARM, self._machine)
        self._button = HoldButton(self, ros.ARM, self._machine) if device.hold_button else None
        stop_button = -1 if device.e_stop_button is None else device.e_stop_button
        self._e_stop = EStop(self, self._machine, stop_button, passes_on=len(names) > 1)
        types = crtk_types()
        understood = {
            f'{ros.ARM}/operating_state': types.operating_state,
            'haptic_bridge/state_command': types.command,
        }
        self._wiring, self._wiring_due = Wiring(self, self._wrench, understood), 0.0
        text = f'what the tool is: {" or ".join(MODES)}; used once no blade is in the tissue'
        mode = parameter(self, 'tool_mode', tool.mode, text, settable=True)
        self._path.next_mode = mode_of(mode)
        self._inputs = DeviceInputs(self, device, self._path)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        self._epoch = time.time_ns() - time.monotonic_ns()
        self._stale_trips = 0
        self._diagnostics = ros.Diagnostics(self, self._collect)

    @property
    def progress(self) -> int:
        """Return the number of loop iterations."""
        return self._loop.ticks

    def work(self, stop: Stop) -> None:
        """Run the force loop in the calling thread until `stop` is set."""
        beside = threading.Thread(target=self._work_beside, args=(stop,), daemon=True)
        beside.start()
        announce_ready(self)
        self._real_time = prepare()
        self.get_logger().info(self._real_time)
        run_real_time(self._loop, self._tick, stop)
        beside.join(1.0)

    def _work_beside(self, stop: Stop) -> None:
        """Do the work that must not delay a tick, in a thread of its own.

        There is no timer: each iteration of rclpy's executor costs more than a tick.
        """
        due = 0.0
        while not stop.is_set():
            now = time.monotonic()
            if now >= due or self._follower.mesh_is_due:
                self._follower.follow_mesh()
            self._indexing.publish_changes()
            if now >= due:
                due = now + STATE_POLL_PERIOD_S
                try:
                    self._watch_state()
                except Exception as error:  # nothing else reports it, nor follows the mesh
                    self._machine.fault(f'the state watch failed: {type(error).__name__}: {error}')
            self._follower.wait(max(due - time.monotonic(), 0.0))

    def rest(self) -> None:
        """Set the force to zero; after the next activation force takes a command."""
        self._auto_enable.forgo()
        if self._machine.state is not CrtkState.FAULT:
            self._machine.command('disable')
        self._interface.publish_changes()
        self._send((0.0,) * 6, time.monotonic_ns())
        self._wrench.wait_for_all_acked(Duration(seconds=0.2))

    def release(self) -> None:
        """Publish the last totals."""
        self.remove_on_set_parameters_callback(self._check_parameters)
        self.remove_post_set_parameters_callback(self._use_parameters)
        self._diagnostics.publish()
        self._e_stop = None

    def press_e_stop(self) -> None:
        """Press E-STOP, on request of the launcher."""
        self._machine.press()
        if (e_stop := self._e_stop) is not None:  # a cleanup in another thread sets it to None
            e_stop.confirm()

    def poll_e_stop(self) -> None:
        """Poll E-STOP while no tick does, and publish a change; called from a thread."""
        e_stop = self._e_stop  # a cleanup in another thread sets it to None
        if not self.is_active and e_stop is not None:
            with suppress(InvalidHandle, RCLError):  # the node is being cleaned up
                e_stop.poll(time.time_ns())

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Reject a request with any invalid parameter: all of it is used, or nothing."""
        for given in parameters:
            if given.name not in SETTABLE:
                reason = f'{given.name} is read only at the start of the node'
                return SetParametersResult(successful=False, reason=reason)
        try:
            for given in parameters:
                if given.name == 'tool_mode':
                    mode_of(given.value)
            self._path.coupling.check(**scales_of(parameters))
        except ValueError as error:
            reason = ' '.join(str(error).split())
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _use_parameters(self, parameters: list[Parameter]) -> None:
        self._path.coupling.change(**scales_of(parameters))
        for given in parameters:
            if given.name == 'tool_mode':
                self._path.next_mode = mode_of(given.value)

    def _cause(self) -> str:
        now = time.monotonic_ns()
        streams = self._watch.cause(now) or self._follower.cause(now)
        streams = streams or self._senders.cause
        return streams or self._device.cause or self._path.cause(now) or self._wiring.cause()

    def _tick(self, _late: int) -> None:
        now = time.monotonic_ns()
        try:
            assert self._e_stop is not None
            self._e_stop.poll(self._epoch + now)
            pose = self._take_pose(now)
            sample, sample_ns = self._follower.take_force(now)
            tick = self._path.tick(
                now,
                state=self._machine.state,
                pose=pose,
                sample=sample,
                sample_ns=sample_ns,
                surface=self._follower.surface,
            )
            self._send(tick.wrench, now)
            if pose is not None:
                self._latency.add(time.time_ns() - pose.stamp_ns)
            if tick.fault:
                self._machine.fault(tick.fault)
            ros.publish_raw(self._contact, tick.message)
        except Exception as error:
            self._machine.fault(f'the force loop failed: {type(error).__name__}: {error}')
            self._send((0.0,) * 6, now)

    def _take_pose(self, now: int) -> StampedMessage | None:
        taken = ros.take_numbered(self._pose)
        if taken is None:
            return None
        try:
            sample = self._pose_codec.decode(taken[0])
        except WireError as error:
            self.rejections.add(f'{ros.ARM}/measured_cp', error)
            raise
        problem = self._watch.see(taken[1], sample.stamp_ns, now, sample.frame_id)
        if problem and self._machine.state is CrtkState.ENABLED:
            self._machine.fault(problem)
        return self._convention.pose(sample)

    def _send(self, wrench: tuple[float, ...], now: int) -> None:
        """Publish a force, stamped with the time [ns] at which it was computed."""
        wrench = self._convention.force(wrench)
        ros.publish_raw(self._wrench, self._wrench_codec.encode(self._epoch + now, wrench))

    def _watch_state(self) -> None:
        # The largest: a thread preempted between the two readings gives too small a value.
        epoch = max(time.time_ns() - time.monotonic_ns() for _ in range(3))
        if abs(epoch - self._epoch) > CLOCK_STEP_NS:
            self._epoch = epoch
        if stranger := self._senders.look(time.monotonic()):
            self._machine.fault(stranger)
        if self._button is not None:
            self._button.enforce()
        self._inputs.poll()
        self._auto_enable.look(self._can_begin)
        now = time.monotonic()
        if self._machine.state is CrtkState.ENABLED and now >= self._wiring_due:
            self._wiring_due = now + GRAPH_CHECK_PERIOD_S
            if cause := self._wiring.cause():
                self._machine.fault(cause)
        reason = self._machine.reason
        if reason and not self._was_faulty:
            self._faults += 1
            self._last_fault = reason
        self._was_faulty = bool(reason)
        if self._path.stale_trips != self._stale_trips:
            self._stale_trips = self._path.stale_trips
            self.get_logger().warning(
                f'no frame of the simulation for {self._path.haptics.stale_after * 1e3:g} ms: '
                'the force fades',
                throttle_duration_sec=1.0,
            )
        self._interface.publish_changes()

    def _can_begin(self) -> bool:
        return (
            not (self._device.cause or self._senders.cause)
            and self._path.is_fresh(time.monotonic_ns())
            and not self._wiring.cause()
        )

    def _collect(self) -> tuple[bytes, str, dict[str, object]]:
        now = time.monotonic_ns()
        path, machine, report = self._path, self._machine, self._loop.report()
        surface = self._follower.surface
        publishers = self.count_publishers(self._pose.topic_name)
        values: dict[str, object] = {
            'operating_state': machine.state,
            'e_stop': 'pressed' if machine.e_stopped else 'released',
            'device_state': self._device.state,
            'fault': machine.reason,
            'faults': self._faults,
            'last_fault': self._last_fault,
            'contact': path.contact,
            'tool_mode': path.mode.name.lower(),
            'contact_time': path.contact_time,
            'force_norm': path.force_norm,
            'max_force': path.max_force,
            'pose_age': path.pose_age(now),
            'pose_publishers': publishers,
            'stranger': self._senders.cause,
            'simulation_age': path.simulation_age(now),
            'stale_trips': path.stale_trips,
            'force_scale': path.haptics.force_scale,
            'motion_scale': path.coupling.indexing.scale,
            'clutched': path.coupling.indexing.clutched,
            'energy': path.energy,
            'damping': path.damping,
            'revision': surface.revision if surface is not None else -1,
            **self._follower.report,
            'tick_us_p50': report.get('busy_p50', 0.0) * 1e6,
            'tick_us_p99': report.get('busy_p99', 0.0) * 1e6,
            'real_time': self._real_time,
            **self._latency.report(),
            **report,
        }
        if machine.state is CrtkState.FAULT:
            return DiagnosticStatus.ERROR, machine.reason, values
        if machine.state is CrtkState.ENABLED and path.is_stale:
            return DiagnosticStatus.WARN, 'the simulation is silent: no force', values
        if publishers > 1:
            topic = self._pose.topic_name
            return DiagnosticStatus.WARN, f'{topic} has {publishers} publishers', values
        return DiagnosticStatus.OK, str(machine.state), values


def accepted_publishers(node: ManagedNode, device: DeviceSettings) -> frozenset[str]:
    """Return who may publish the inputs: by the scene, and by the launcher's parameter."""
    text = 'nodes, as /name, separated by commas: as device.accepted_publishers of the scene'
    given = str(parameter(node, 'accepted_publishers', '', text))
    return frozenset((*device.accepted_publishers, *filter(None, given.split(','))))


def mode_of(name: object) -> ToolMode:
    """Return the mode of a name.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in MODES:
        raise ValueError(f'tool_mode is {name!r:.40}: it must be {" or ".join(MODES)}')
    return MODES[str(name)]


def scales_of(parameters: list[Parameter]) -> dict[str, Any]:
    """Return the scales among parameters; both together make the coupling stiff."""
    return {given.name: given.value for given in parameters if given.name in SCALES}


def of_tissue(scene: Path) -> tuple[float, Friction, BladeConstants]:
    """Return the largest cutting resistance of the tissue by blade length [N/m], inf if it is
    unknown, its friction, and the constants of a blade in it.
    """
    try:
        tissue = read_section(scene, 'tissue', TissueSettings)
    except SceneError:  # a scene for the device alone, or one that tissue_sim rejects
        return math.inf, NO_FRICTION, UNKNOWN_BLADE
    m, of = tissue.material, tissue.region_values
    pairs = zip(of('toughness'), of('blade_friction'), strict=True)
    most = max(sum(pair) for pair in [(m.toughness, m.blade_friction), *pairs])
    return most, m.dry_friction, tissue.blade_constants


def main() -> None:
    """Run the node."""
    run(HapticBridge)


if __name__ == '__main__':
    main()
