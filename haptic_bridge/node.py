"""Node `haptic_bridge`: poses in, forces out, a thousand times a second."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from cutting_trainer_msgs.msg import Contact, ForceSample
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.parameter import Parameter

from haptic_bridge.convention import DeviceConvention
from haptic_bridge.crtk import DeviceState, HoldButton, StateInterface
from haptic_bridge.force_path import ForcePath
from haptic_bridge.operating_state import OperatingStateMachine, State
from haptic_bridge.realtime import prepare, run_real_time
from haptic_bridge.settings import DeviceSettings, HapticsSettings, ToolSettings
from haptic_bridge.stream_watch import StreamWatch
from haptic_bridge.surface import Surface
from haptic_bridge.warm_up import warm_up
from haptic_bridge.wire import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    Sample,
    WireError,
    WrenchStampedCodec,
)
from tissue_sim import ros
from tissue_sim.lifecycle import ManagedNode, Stop, announce_ready, run
from tissue_sim.mesh_follower import MeshFollower
from tissue_sim.parameters import parameter, scene_parameter, seed_parameter
from tissue_sim.refusals import require_frame
from tissue_sim.scene_file import read_section
from tissue_sim.timing import Durations, PeriodicLoop

FOLLOW_PERIOD = 0.003
"""[s] between two looks for meshes of the simulation."""
STATE_PERIOD = 0.02
"""[s] between two looks for changes of the operating state, while the bridge works."""
CLOCK_STEP = 1_000_000
"""[ns] by which the system clock may differ from the stamps before they follow it."""


class SimulationFollower:
    """Keeps up with the simulation: its forces in the fast loop; its meshes in a thread beside it,
    so that decoding one delays no force.

    Args:
        node: to subscribe with.
        on_error: told, as a sentence, that a message could not be used.

    Attributes:
        surface: the newest whole one; None before the first.
    """

    def __init__(self, node: ManagedNode, on_error: Callable[[str], None]) -> None:
        self.surface: Surface | None = None
        self._on_error = on_error
        self._refusals = node.refusals
        self._follower = MeshFollower(node, node.refusals)
        self._codec = ForceSampleCodec()
        self._watch = StreamWatch(ros.FORCE, queues=True)
        self._late = 0
        self._force = ros.polled(node, ForceSample, ros.FORCE, ros.NEWEST_BEST_EFFORT)

    @property
    def report(self) -> dict[str, object]:
        """What /diagnostics says of the simulation's messages; of the mesh see `MeshFollower`."""
        revision, known = self._follower.checked
        return {
            'late_forces': self._late,
            'revision_gaps': self._follower.gaps,
            'mesh_checked_revision': revision,
            'mesh_checked_hash': f'{known:016x}',
            'mesh_mismatches': self._follower.mismatches,
            'stale_meshes': self._follower.stale,
        }

    def cause(self, now_ns: int) -> str:
        """Why the simulation's forces cannot be trusted at this time [ns], '' if they can."""
        return self._watch.cause(now_ns)

    def take_force(self, now_ns: int) -> tuple[Sample | None, int]:
        """The next force, and since when [ns] it would have been here had it not waited anywhere:
        so old is it, however late it is read.

        Args:
            now_ns: monotonic clock [ns].
        """
        try:
            taken = ros.take_numbered(self._force)
            if taken is None:
                return None, now_ns
            sample = self._codec.decode(taken[0])
            require_frame(ros.FORCE, sample.frame_id)
            problem = self._watch.see(taken[1], sample.stamp_ns, now_ns)
        except Exception as error:
            self._refuse(ros.FORCE, error)
            return None, now_ns
        if problem:
            self._on_error(problem)
        if self._watch.late:
            self._late += 1
            return None, now_ns
        return sample, now_ns - self._watch.delay

    def follow_mesh(self) -> None:
        """Takes what has come of the mesh."""
        try:
            self._take_surface()
        except Exception as error:
            self._refuse(ros.MESH, error)
            self._follower.ask()

    def _refuse(self, topic: str, error: Exception) -> None:
        self._refusals.add(topic, error)
        self._on_error(f'message of the simulation: {error}')

    def _take_surface(self) -> None:
        if self._follower.poll():
            self._renew()
        if self._follower.problem:
            self._on_error(f'message of the simulation: {self._follower.problem}')

    def _renew(self) -> None:
        replica = self._follower.replica
        self.surface = Surface(
            replica.positions(),
            replica.triangles,
            revision=replica.revision,
            topology=replica.topology,
            previous=self.surface,
        )


class HapticBridge(ManagedNode):
    """The shell of `ForcePath`.

    Parameters:
        scene: path of the scene file.
        auto_enable: enter ENABLED when device, force and surface are fresh for the first time.
            Never again after that: a FAULT is left by a command only.
        force_scale: hand force over tissue force; may be set while the node runs.
    """

    def __init__(self) -> None:
        super().__init__('haptic_bridge')

    def configure(self) -> None:
        """Reads the scene, compiles the force path, makes the topics."""
        scene = Path(scene_parameter(self))
        seed_parameter(self)
        text = 'enter ENABLED, once, when device, force and surface are fresh'
        self._auto_enable = bool(parameter(self, 'auto_enable', False, text))
        device = read_section(scene, 'device', DeviceSettings)
        tool = read_section(scene, 'tool', ToolSettings)
        haptics = read_section(scene, 'haptics', HapticsSettings)
        profile = device.load_profile()
        warm_up(tool, device, haptics, profile)
        self._path = ForcePath(tool, device, haptics, profile, self.refusals)
        self._machine = OperatingStateMachine(self._cause)
        self._convention = DeviceConvention(device)
        self._watch = StreamWatch(f'{ros.ARM}/measured_cp')
        self._loop = PeriodicLoop(haptics.rate)
        self._latency = Durations('pose_to_force')
        self._real_time = 'the force loop has not started'
        self._faults, self._last_fault, self._was_faulty = 0, '', False
        self._pose_codec = PoseStampedCodec()
        self._wrench_codec = WrenchStampedCodec(f'{ros.ARM}_base')
        self._contact_codec = ContactCodec(ros.FRAME)
        self._pose = ros.polled(self, PoseStamped, f'{ros.ARM}/measured_cp', ros.NEWEST_BEST_EFFORT)
        self._wrench = self.create_publisher(WrenchStamped, f'{ros.ARM}/servo_cf', ros.STREAM)
        self._contact = self.create_publisher(Contact, ros.CONTACT, ros.STREAM)
        self._follower = SimulationFollower(self, self._machine.fault)
        self._interface = StateInterface(self, 'haptic_bridge', self._machine)
        self._device = DeviceState(self, ros.ARM, self._machine)
        self._button = HoldButton(self, ros.ARM, self._machine) if device.hold_button else None
        text = 'hand force over tissue force [-], above 0 to 100'
        parameter(self, 'force_scale', haptics.force_scale, text, settable=True)
        self.add_on_set_parameters_callback(self._set_parameters)
        self._epoch = time.time_ns() - time.monotonic_ns()
        self._stale_trips = 0
        self._diagnostics = ros.Diagnostics(self, self._collect)

    def work(self, stop: Stop) -> None:
        """Runs the force loop in the calling thread until `stop` is set."""
        beside = threading.Thread(target=self._work_beside, args=(stop,), daemon=True)
        beside.start()
        announce_ready(self)
        self._real_time = prepare()
        self.get_logger().info(self._real_time)
        run_real_time(self._loop, self._tick, stop)
        beside.join(1.0)

    def _work_beside(self, stop: Stop) -> None:
        """What a late tick must not wait for. No timer: each turn of rclpy's executor costs more
        than a tick.
        """
        due = 0.0
        while not stop.is_set():
            self._follower.follow_mesh()
            now = time.monotonic()
            if now >= due:
                due = now + STATE_PERIOD
                try:
                    self._watch_state()
                except Exception as error:  # nobody else would say it, nor follow the mesh
                    self._machine.fault(f'the state watch failed: {type(error).__name__}: {error}')
            time.sleep(FOLLOW_PERIOD)

    def rest(self) -> None:
        """Leaves no force behind, and none when it works again: that takes a command."""
        self._auto_enable = False
        if self._machine.state is not State.FAULT:
            self._machine.command('disable')
        self._interface.publish_changes()
        self._send((0.0,) * 6, time.monotonic_ns())
        self._wrench.wait_for_all_acked(Duration(seconds=0.2))

    def release(self) -> None:
        """Publishes the last totals."""
        self.remove_on_set_parameters_callback(self._set_parameters)
        self._diagnostics.publish()

    def _set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for given in parameters:
            if given.name != 'force_scale':
                reason = f'{given.name} is read once, at the start of the node'
                return SetParametersResult(successful=False, reason=reason)
            try:
                self._path.scale_force(given.value)
            except ValueError as error:
                reason = ' '.join(str(error).split())
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _cause(self) -> str:
        now = time.monotonic_ns()
        streams = self._watch.cause(now) or self._follower.cause(now)
        return streams or self._device.cause or self._path.cause(now)

    def _tick(self, _late: int) -> None:
        now = time.monotonic_ns()
        try:
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
            contact = self._contact_codec.encode(tick.contact_stamp_ns, tick.contact)
            self._contact.publish(contact)
        except Exception as error:
            self._machine.fault(f'the force loop failed: {type(error).__name__}: {error}')
            self._send((0.0,) * 6, now)

    def _take_pose(self, now: int) -> Sample | None:
        taken = ros.take_numbered(self._pose)
        if taken is None:
            return None
        try:
            sample = self._pose_codec.decode(taken[0])
        except WireError as error:
            self.refusals.add(f'{ros.ARM}/measured_cp', error)
            raise
        problem = self._watch.see(taken[1], sample.stamp_ns, now, sample.frame_id)
        if problem and self._machine.state is State.ENABLED:
            self._machine.fault(problem)
        return self._convention.pose(sample)

    def _send(self, wrench: tuple[float, ...], now: int) -> None:
        """Publishes a force, stamped with the time [ns] for which it was computed."""
        wrench = self._convention.force(wrench)
        self._wrench.publish(self._wrench_codec.encode(self._epoch + now, wrench))

    def _watch_state(self) -> None:
        # The largest: where the thread lost its turn between the two readings, it is too small.
        epoch = max(time.time_ns() - time.monotonic_ns() for _ in range(3))
        if abs(epoch - self._epoch) > CLOCK_STEP:
            self._epoch = epoch
        if self._button is not None:
            self._button.enforce()
        if (
            self._auto_enable
            and not self._machine.is_stopped
            and not self._device.cause
            and self._path.is_fresh(time.monotonic_ns())
        ):
            self._auto_enable = False
            self._machine.command('enable')
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

    def _collect(self) -> tuple[bytes, str, dict[str, object]]:
        now = time.monotonic_ns()
        path, machine, report = self._path, self._machine, self._loop.report()
        surface = self._follower.surface
        publishers = self.count_publishers(self._pose.topic_name)
        values: dict[str, object] = {
            'operating_state': machine.state,
            'device_state': self._device.state,
            'fault': machine.reason,
            'faults': self._faults,
            'last_fault': self._last_fault,
            'contact': path.contact,
            'contact_time': path.contact_time,
            'force_norm': path.force_norm,
            'max_force': path.max_force,
            'pose_age': path.pose_age(now),
            'pose_publishers': publishers,
            'simulation_age': path.simulation_age(now),
            'stale_trips': path.stale_trips,
            'force_scale': path.haptics.force_scale,
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
        if machine.state is State.FAULT:
            return DiagnosticStatus.ERROR, machine.reason, values
        if machine.state is State.ENABLED and path.is_stale:
            return DiagnosticStatus.WARN, 'the simulation is silent: no force', values
        if publishers > 1:
            topic = self._pose.topic_name
            return DiagnosticStatus.WARN, f'{topic} has {publishers} publishers', values
        return DiagnosticStatus.OK, str(machine.state), values


def main() -> None:
    """Runs the node."""
    run(HapticBridge)


if __name__ == '__main__':
    main()
