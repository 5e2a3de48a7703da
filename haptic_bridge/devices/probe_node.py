"""Node `probe_device`: records a connected arm, and pushes it gently on request."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from cutting_trainer.haptic_bridge.devices.placement import (
    PlacementError,
    find_touch,
    why_no_touch,
)
from cutting_trainer.haptic_bridge.devices.probe_force import (
    MAX_UNCERTAINTY_DEG,
    direction_uncertainty,
)
from cutting_trainer.haptic_bridge.devices.probe_pose import find_rotation
from cutting_trainer.haptic_bridge.devices.probe_stream import (
    MAX_GAP_S,
    PUSH_FORCE_N,
    Poses,
    ProbeCheck,
    find_move,
)
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec, WrenchStampedCodec
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.orientation import from_quaternion
from cutting_trainer.node_common.qos import EVENTS, LATCHED, STREAM
from cutting_trainer.node_common.ros import polled, take, take_raw

FIRST_POSE_TIMEOUT_S = 5.0
"""[s] in which a publisher, and its first pose, must appear."""
MAX_SILENCE_S = 1.0
"""[s] without a pose after which a guided placement ends."""
MAX_PUSH_TRAVEL_M = 0.03
"""[m] Motion of the tip at which a push is stopped."""
_ANY_STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT
)
_POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
_PERIOD_S = 0.001
_RAMP, _HOLD, _REST, _MEAN = 0.05, 0.35, 0.35, 0.2
_MAX_ROUNDS = 3
"""Largest number of pushes along each axis and back, if the hand is not still enough for fewer."""
_SILENCE_S = 0.6
"""[s] without commands, in which a driver must release; then zero is sent."""
_FEW, _MAX_FRAMES = 100, 16
_NO_WRENCH = (0.0,) * 6


class ProbeError(RuntimeError):
    """The probe was stopped; the message is a sentence."""


class Pushes(NamedTuple):
    """Results of pushes along each axis and back, and after the last command.

    Attributes:
        forces: sent [N], shape (n, 3).
        yields: deflections of the tip [m], shape (n, 3).
        felt: `measured_cf` under each less that before it [N], shape (n, 3); NaN: not published.
        tool: orientation of the tool, shape (3, 3).
        times: since the last command [s], shape (n,).
        along: remaining deflection of the tip [m], shape (n,).
        deflection: of the tip under the last push [m].
        still_felt: share of the push that `measured_cf` had at the end, shape (1,).
    """

    forces: np.ndarray
    yields: np.ndarray
    felt: np.ndarray
    tool: np.ndarray
    times: np.ndarray
    along: np.ndarray
    deflection: float
    still_felt: np.ndarray


class DeviceProbe(Node):
    """Subscribes to `<arm>/measured_cp`. Publishes nothing before `push` is called.

    Args:
        arm: namespace of the device.
        context: of rclpy.
        force_topic: below `arm`, where the device takes the force.

    Attributes:
        frames: each frame_id of the poses.
    """

    def __init__(
        self, arm: str, context: Context | None = None, force_topic: str = 'servo_cf'
    ) -> None:
        super().__init__('probe_device', context=context)
        self.pose_topic, self.force_topic = f'{arm}/measured_cp', f'{arm}/{force_topic}'
        self.felt_topic = f'{arm}/measured_cf'
        self.frames: set[str] = set()
        self._arm = arm
        self._types = crtk_types()
        self._poses = polled(self, PoseStamped, self.pose_topic, _ANY_STREAM)
        self._state = polled(self, self._types.operating_state, f'{arm}/operating_state', LATCHED)
        self._wrenches = polled(self, WrenchStamped, self.felt_topic, _ANY_STREAM)
        self._codec, self._wrench_codec = PoseStampedCodec(), WrenchStampedCodec()
        self._clear()

    def _clear(self) -> None:
        self._arrivals: list[float] = []
        self._stamps: list[float] = []
        self._values: list[tuple[float, ...]] = []
        self._felt: list[tuple[float, ...]] = []

    def find(self) -> ProbeCheck:
        """Wait for the publisher of poses, and check it."""
        deadline = time.monotonic() + FIRST_POSE_TIMEOUT_S
        while not (found := self.get_publishers_info_by_topic(self._full(self.pose_topic))):
            if time.monotonic() > deadline:
                return ProbeCheck('publisher', 'wrong', 'none', self._nobody())
            time.sleep(0.05)
        kinds = {info.topic_type for info in found}
        if kinds != {_POSE_TYPE}:
            other = ', '.join(sorted(kinds - {_POSE_TYPE}))
            text = f'{self.pose_topic} is of type {other}, not {_POSE_TYPE}: the driver is too old'
            return ProbeCheck('publisher', 'wrong', other, text)
        if len(found) > 1:
            names = ', '.join(sorted(info.node_name for info in found))
            text = f'{self.pose_topic} has {len(found)} publishers ({names}): end all but one'
            return ProbeCheck('publisher', 'wrong', f'{len(found)} publishers', text)
        if found[0].qos_profile.reliability != ReliabilityPolicy.RELIABLE:
            text = (
                f'{self.pose_topic} is published best effort: the bridge hears it, but CRTK '
                'clients are reliable and never match'
            )
            return ProbeCheck('publisher', 'wrong', 'best effort', text)
        return ProbeCheck('publisher', 'ok', 'one, reliable')

    def listen(self, seconds: float) -> Poses | None:
        """Return poses of the next seconds; None if fewer than three arrive.

        It waits `FIRST_POSE_TIMEOUT_S` at least.
        """
        self._drain()
        self._clear()
        deadline = time.monotonic() + max(FIRST_POSE_TIMEOUT_S, seconds)
        began = time.monotonic()
        while time.monotonic() < deadline:
            self._drain()
            enough = len(self._arrivals) >= 3 and time.monotonic() - began >= seconds
            if enough:
                return self._all()
            time.sleep(_PERIOD_S)
        return self._all() if len(self._arrivals) >= 3 else None

    def await_move(self, noise: float, timeout: float) -> np.ndarray | None:
        """Return the next move that ends at rest, shape (3,), in the unit sent.

        None after `timeout` [s].

        Args:
            noise: extent of the positions at rest, in that unit.
            timeout: [s].
        """
        self._drain()
        self._clear()
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            time.sleep(0.05)
            self._drain()
            if not self._arrivals:
                continue
            poses = self._all()
            move = find_move(poses.arrivals, poses.positions, noise)
            if move is not None:
                return move
        return None

    def await_touch(self, metres: float, timeout: float, name: str) -> np.ndarray:
        """Return where the tip rests after its next move, in the unit sent, shape (3,).

        Args:
            metres: one unit of the positions [m].
            timeout: [s].
            name: of the point, for the message.

        Raises:
            PlacementError: it did not move there, or was not still, or the driver fell silent.
        """
        self._drain()
        self._clear()
        began, deadline = time.time(), time.monotonic() + timeout
        while time.monotonic() < deadline:
            time.sleep(0.05)
            self._drain()
            if time.time() - max([began, *self._arrivals[-1:]]) > MAX_SILENCE_S:
                raise PlacementError(
                    f'{self.pose_topic} fell silent before {name} was touched: see whether its '
                    'driver runs, and begin again'
                )
            if self._arrivals:
                poses = self._all()
                if (found := find_touch(poses.arrivals, poses.positions, metres)) is not None:
                    return found
        raise why_no_touch(np.array(self._values).reshape(-1, 7)[:, :3], metres, name)

    def await_rotation(self, timeout: float) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the orientations before and after the next rotation, as sent, shape (4,) each."""
        self._drain()
        self._clear()
        deadline = time.monotonic() + timeout
        turned = None
        while turned is None and time.monotonic() < deadline:
            time.sleep(0.05)
            self._drain()
            if self._arrivals:
                poses = self._all()
                turned = find_rotation(poses.arrivals, poses.values[:, 3:])
        return np.array(self._values[0][3:] if self._values else (0.0, 0.0, 0.0, 1.0)), turned

    def state(self, timeout: float = 1.0) -> str:
        """Return the operating state that the device publishes; '' where it publishes none."""
        deadline = time.monotonic() + timeout
        name = ''
        while not name and time.monotonic() < deadline:
            while (message := take(self._state)) is not None:
                name = message.state
            time.sleep(0.02)
        return name

    def enable(self) -> None:
        """Enable the device, and wait until it says so."""
        topic = f'{self._arm}/state_command'
        publisher = self.create_publisher(self._types.command, topic, EVENTS)
        deadline = time.monotonic() + FIRST_POSE_TIMEOUT_S
        while not publisher.get_subscription_count() and time.monotonic() < deadline:
            time.sleep(0.02)
        publisher.publish(self._types.command(string='enable'))
        while self.state(_REST) != 'ENABLED' and time.monotonic() < deadline:
            pass

    def push(self, metres: float) -> 'Pushes':
        """Push the tip slowly along each axis and back, release it, then stop commanding.

        Args:
            metres: one unit of the positions [m].

        Raises:
            ProbeError: somebody else commands the device, it went silent, or moved too far.
        """
        others = self.count_publishers(self._full(self.force_topic))
        if others:
            raise ProbeError(
                f'{self.force_topic} has a publisher already: end the bridge, then push again'
            )
        publisher = self.create_publisher(WrenchStamped, self.force_topic, STREAM)
        codec = WrenchStampedCodec(f'{self._arm}_base')

        def send(force: np.ndarray) -> None:
            wrench = (*force.tolist(), 0.0, 0.0, 0.0)
            publisher.publish(codec.encode(time.time_ns(), wrench))

        one_round = PUSH_FORCE_N * np.vstack([np.eye(3), -np.eye(3)])
        answers: list[tuple[np.ndarray, np.ndarray]] = []
        try:
            self._hold(send, lambda _: np.zeros(3), 2 * _REST, metres)
            for rounds in range(1, _MAX_ROUNDS + 1):
                answers += [self._yield(send, force, metres) for force in one_round]
                forces = np.tile(one_round, (rounds, 1))
                yields, felt = (np.array(each) for each in zip(*answers, strict=True))
                if direction_uncertainty(forces, yields) < MAX_UNCERTAINTY_DEG / 2:
                    break
            tool = from_quaternion(self._values[-1][3:])
            along = forces[np.argmax(np.linalg.norm(yields, axis=1))]
            return Pushes(forces, yields, felt, tool, *self._stop_commanding(send, along, metres))
        finally:
            for _ in range(20):
                publisher.publish(codec.encode(time.time_ns(), _NO_WRENCH))
                time.sleep(_PERIOD_S)

    def _yield(
        self, send: Callable[[np.ndarray], None], force: np.ndarray, metres: float
    ) -> tuple[np.ndarray, np.ndarray]:
        before, felt_before = self._mean(), self._mean_felt()
        self._hold(send, lambda t: min(t / _RAMP, 1.0) * force, _RAMP + _HOLD, metres)
        pushed, felt = self._mean(), self._mean_felt()
        self._hold(send, lambda t: max(1 - t / _RAMP, 0.0) * force, _RAMP + _REST, metres)
        return metres * (pushed - (before + self._mean()) / 2), felt - felt_before

    def _stop_commanding(
        self, send: Callable[[np.ndarray], None], force: np.ndarray, metres: float
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """Push once more, then send nothing for `_SILENCE_S`."""
        before, felt_before = self._mean(), self._mean_felt()
        self._hold(send, lambda t: min(t / _RAMP, 1.0) * force, _RAMP + _HOLD, metres)
        pushed, felt = metres * (self._mean() - before), self._mean_felt() - felt_before
        deflection = float(np.linalg.norm(pushed))
        direction = pushed / max(deflection, 1e-9)
        self._clear()
        began = time.time()
        while time.time() - began < _SILENCE_S:
            time.sleep(_PERIOD_S)
            self._drain()
        poses = self._all()
        along = metres * (poses.positions.reshape(-1, 3) - before) @ direction
        size = max(float(np.linalg.norm(felt)), 1e-9)
        share = np.array([(self._mean_felt() - felt_before) @ felt / size**2])
        return poses.arrivals - began, along, deflection, share

    def _hold(
        self,
        send: Callable[[np.ndarray], None],
        force: Callable[[float], np.ndarray],
        seconds: float,
        metres: float,
    ) -> None:
        self._drain()
        self._clear()
        began = received = last = time.monotonic()
        while (elapsed := time.monotonic() - began) < seconds:
            send(force(elapsed))
            time.sleep(_PERIOD_S)
            count = len(self._arrivals)
            self._drain()
            now = time.monotonic()
            # A delay of this process itself says nothing about the device.
            held_up = now - last > MAX_GAP_S
            received = now if len(self._arrivals) > count or held_up else received
            last = now
            if now - received > 5 * MAX_GAP_S:
                raise ProbeError(f'{self.pose_topic} fell silent under the push: stopped')
            if self._values and metres * self._strayed() > MAX_PUSH_TRAVEL_M:
                raise ProbeError(
                    f'the tip moved by more than {1e3 * MAX_PUSH_TRAVEL_M:g} mm under '
                    f'{PUSH_FORCE_N:g} N: stopped; hold the arm, loosely'
                )

    def _mean(self) -> np.ndarray:
        poses = self._all()
        return poses.positions[poses.arrivals >= poses.arrivals[-1] - _MEAN].mean(axis=0)

    def _strayed(self) -> float:
        """Return the distance of the newest position from the first, in the unit sent."""
        return math.dist(self._values[0][:3], self._values[-1][:3])

    def _mean_felt(self) -> np.ndarray:
        """Return the recent `measured_cf` [N], shape (3,); NaN where it is not published."""
        late = self._felt[-_FEW:]
        return np.mean(late, axis=0) if late else np.full(3, np.nan)

    def _drain(self) -> None:
        while (raw := take_raw(self._wrenches)) is not None:
            self._felt.append(self._wrench_codec.decode(raw).values[:3])
        while (raw := take_raw(self._poses)) is not None:
            sample = self._codec.decode(raw)
            self._arrivals.append(time.time())
            self._stamps.append(sample.stamp_ns * 1e-9)
            self._values.append(sample.values)
            if len(self.frames) < _MAX_FRAMES:
                self.frames.add(sample.frame_id)

    def _all(self) -> Poses:
        return Poses(np.array(self._arrivals), np.array(self._stamps), np.array(self._values))

    def _full(self, topic: str) -> str:
        return self.resolve_topic_name(topic)

    def _nobody(self) -> str:
        like = [
            name for name, _ in self.get_topic_names_and_types() if name.endswith('measured_cp')
        ]
        others = [name for name in sorted(like) if self.count_publishers(name)]
        hint = (
            f'there is {", ".join(others)}: name its namespace with --arm'
            if others
            else 'start the driver, in this ROS domain and on this network'
        )
        return f'nobody publishes {self.pose_topic}: {hint}'
