"""Node `probe_device`: listens to a connected arm, and pushes it gently where that is asked for."""

import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from haptic_bridge.operating_state import crtk_types
from haptic_bridge.probe import (
    LONGEST_GAP,
    PUSH,
    Check,
    Poses,
    extent,
    find_move,
)
from haptic_bridge.wire import PoseStampedCodec, WrenchStampedCodec
from tissue_sim.ros import EVENTS, LATCHED, STREAM, polled, take, take_raw

PATIENCE = 5.0
"""[s] in which a publisher, and its first pose, must be there."""
FARTHEST_PUSH = 0.03
"""[m] by which a push may move the tip before it is broken off."""
_ANY_STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT
)
_POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
_PERIOD = 0.001
_RAMP, _HOLD, _REST, _MEAN = 0.05, 0.2, 0.25, 0.05
_NO_WRENCH = (0.0,) * 6


class ProbeError(RuntimeError):
    """The probe was broken off; the message is a sentence."""


class DeviceProbe(Node):
    """Listens on `<arm>/measured_cp`. Publishes nothing before `push` is called.

    Args:
        arm: namespace of the device.
        context: of rclpy.
    """

    def __init__(self, arm: str, context: Context | None = None) -> None:
        super().__init__('probe_device', context=context)
        self.pose_topic, self.force_topic = f'{arm}/measured_cp', f'{arm}/servo_cf'
        self._arm = arm
        self._types = crtk_types()
        self._poses = polled(self, PoseStamped, self.pose_topic, _ANY_STREAM)
        self._state = polled(self, self._types.operating_state, f'{arm}/operating_state', LATCHED)
        self._codec = PoseStampedCodec()
        self._clear()

    def _clear(self) -> None:
        self._arrivals: list[float] = []
        self._stamps: list[float] = []
        self._values: list[tuple[float, ...]] = []

    def find(self) -> Check:
        """Waits for the publisher of poses, and says what is wrong with it."""
        deadline = time.monotonic() + PATIENCE
        while not (found := self.get_publishers_info_by_topic(self._full(self.pose_topic))):
            if time.monotonic() > deadline:
                return Check('publisher', 'wrong', 'none', self._nobody())
            time.sleep(0.05)
        kinds = {info.topic_type for info in found}
        if kinds != {_POSE_TYPE}:
            other = ', '.join(sorted(kinds - {_POSE_TYPE}))
            text = f'{self.pose_topic} is of type {other}, not {_POSE_TYPE}: the driver is too old'
            return Check('publisher', 'wrong', other, text)
        if len(found) > 1:
            names = ', '.join(sorted(info.node_name for info in found))
            text = f'{self.pose_topic} has {len(found)} publishers ({names}): end all but one'
            return Check('publisher', 'wrong', f'{len(found)} publishers', text)
        if found[0].qos_profile.reliability != ReliabilityPolicy.RELIABLE:
            text = (
                f'{self.pose_topic} is published best effort: the bridge hears it, but CRTK '
                'clients are reliable and never match'
            )
            return Check('publisher', 'wrong', 'best effort', text)
        return Check('publisher', 'ok', 'one, reliable')

    def listen(self, seconds: float) -> Poses | None:
        """Poses of the next seconds; None if there are not even three within `PATIENCE`."""
        self._drain()
        self._clear()
        deadline = time.monotonic() + max(PATIENCE, seconds)
        began = time.monotonic()
        while time.monotonic() < deadline:
            self._drain()
            enough = len(self._arrivals) >= 3 and time.monotonic() - began >= seconds
            if enough:
                return self._all()
            time.sleep(_PERIOD)
        return self._all() if len(self._arrivals) >= 3 else None

    def await_move(self, noise: float, timeout: float) -> np.ndarray | None:
        """The next move that ends at rest, shape (3,), in the unit sent; None after `timeout` [s].

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

    def state(self, timeout: float = 1.0) -> str:
        """The operating state that the device announces; '' where it announces none."""
        deadline = time.monotonic() + timeout
        name = ''
        while not name and time.monotonic() < deadline:
            while (message := take(self._state)) is not None:
                name = message.state
            time.sleep(0.02)
        return name

    def enable(self) -> None:
        """Enables the device."""
        topic = f'{self._arm}/state_command'
        publisher = self.create_publisher(self._types.command, topic, EVENTS)
        deadline = time.monotonic() + PATIENCE
        while not publisher.get_subscription_count() and time.monotonic() < deadline:
            time.sleep(0.02)
        publisher.publish(self._types.command(string='enable'))

    def push(self, metres: float) -> tuple[np.ndarray, np.ndarray]:
        """Pushes the tip along each axis and back, slowly, and lets go.

        Args:
            metres: one unit of the positions [m].

        Returns:
            Forces [N] and by how much the tip gave way [m], each of shape (6, 3).

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

        forces = PUSH * np.vstack([np.eye(3), -np.eye(3)])
        try:
            self._hold(send, lambda _: np.zeros(3), 2 * _REST, metres)
            return forces, np.array([self._yield(send, force, metres) for force in forces])
        finally:
            for _ in range(20):
                publisher.publish(codec.encode(time.time_ns(), _NO_WRENCH))
                time.sleep(_PERIOD)

    def _yield(
        self, send: Callable[[np.ndarray], None], force: np.ndarray, metres: float
    ) -> np.ndarray:
        before = self._mean()
        self._hold(send, lambda t: min(t / _RAMP, 1.0) * force, _RAMP + _HOLD, metres)
        pushed = self._mean()
        self._hold(send, lambda t: max(1 - t / _RAMP, 0.0) * force, _RAMP + _REST, metres)
        return metres * (pushed - (before + self._mean()) / 2)

    def _hold(
        self,
        send: Callable[[np.ndarray], None],
        force: Callable[[float], np.ndarray],
        seconds: float,
        metres: float,
    ) -> None:
        self._drain()
        self._clear()
        began = heard = last = time.monotonic()
        while (elapsed := time.monotonic() - began) < seconds:
            send(force(elapsed))
            time.sleep(_PERIOD)
            count = len(self._arrivals)
            self._drain()
            now = time.monotonic()
            # Where this process was held up itself, that says nothing about the device.
            held_up = now - last > LONGEST_GAP
            heard = now if len(self._arrivals) > count or held_up else heard
            last = now
            if now - heard > 5 * LONGEST_GAP:
                raise ProbeError(f'{self.pose_topic} fell silent under the push: broken off')
            if self._values and metres * extent(self._all().positions[::20]) > FARTHEST_PUSH:
                raise ProbeError(
                    f'the tip moved by more than {1e3 * FARTHEST_PUSH:g} mm under {PUSH:g} N: '
                    'broken off; hold the arm, loosely'
                )

    def _mean(self) -> np.ndarray:
        poses = self._all()
        return poses.positions[poses.arrivals >= poses.arrivals[-1] - _MEAN].mean(axis=0)

    def _drain(self) -> None:
        while (raw := take_raw(self._poses)) is not None:
            sample = self._codec.decode(raw)
            self._arrivals.append(time.time())
            self._stamps.append(sample.stamp_ns * 1e-9)
            self._values.append(sample.values)

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
