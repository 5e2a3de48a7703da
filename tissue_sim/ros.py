"""What every node shell shares: names, QoS, polled subscriptions, diagnostics."""

import math
import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy._rclpy_pybind11 import RMWError
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState

from tissue_sim.refusals import TISSUE_FRAME, MessageError
from tissue_sim.stamps import seconds_and_nanoseconds

FRAME = TISSUE_FRAME

MESH = 'tissue/mesh'
MESH_UPDATES = 'tissue/mesh_updates'
GET_MESH = 'tissue/get_mesh'
FORCE = 'tissue/force'
FRAME_INPUTS = 'tissue/frame_inputs'
CONTACT = 'tool/contact'
CUT = 'cutting/cut'
MESH_KEEPERS = ('cutting/get_mesh', 'haptic_bridge/get_mesh', 'viewer/get_mesh')
"""Services that know the tissue when the one that owns it has died."""
ARM = 'arm'
HAND = f'{ARM}/hand/servo_cp'
DIAGNOSTICS = '/diagnostics'
MARKERS = 'viewer/markers'
STATIC_FRAMES = '/tf_static'


def _reliable(depth: int, *, latched: bool = False) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


STREAM = _reliable(500)
"""Publishers of streams. Deep: a recorder loses nothing while it is held up for a moment."""
NEWEST_BEST_EFFORT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
"""Subscribers that use only the newest sample: a late one is worth less than the next."""
LATCHED = _reliable(1, latched=True)
UPDATES = _reliable(150)
"""Five seconds of deltas: a link may be away for so long before those behind it miss some."""
EVENTS = _reliable(10)


HISTORY = _reliable(1000, latched=True)
"""Of what is said seldom and must be known to who comes later, all of it."""


LATE = 1.5
"""[s] without a word on /diagnostics after which a loop speaks itself."""


def stamp(nanoseconds: int) -> Time:
    """A time since the epoch [ns] as a message."""
    seconds, rest = seconds_and_nanoseconds(nanoseconds)
    return Time(sec=seconds, nanosec=rest)


class PolledGroup(CallbackGroup):
    """Subscriptions that no executor serves: a loop takes from them itself (see `take`)."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


def polled(node: Node, message_type: Any, topic: str, qos: QoSProfile) -> Any:
    """Subscribes for polling with `take` or `take_raw`; no callback will ever run."""
    return node.create_subscription(
        message_type, topic, lambda _: None, qos, callback_group=PolledGroup()
    )


def read(data: bytes, message_type: Any, most: float = math.inf) -> Any:
    """A message from CDR bytes as they came.

    Args:
        data: the bytes.
        message_type: what they are taken for.
        most: bytes of a message that is accepted.

    Raises:
        MessageError: they are too many, or no such message.
    """
    if len(data) > most:
        raise MessageError('too large', f'{len(data)} bytes: this node accepts {most:.0f}')
    try:
        return deserialize_message(data, message_type)
    except (RMWError, ValueError) as error:  # a string that is not UTF-8 is a ValueError
        said = str(error).partition(', at ')[0]
        raise MessageError('no such message', f'{len(data)} bytes: {said}') from None


def take(subscription: Any, most: float = math.inf) -> Any | None:
    """The next message of a polled subscription, or None.

    By way of its bytes: a message that cannot be read would look as if there were none.

    Raises:
        MessageError: see `read`.
    """
    data = take_raw(subscription)
    return None if data is None else read(data, subscription.msg_type, most)


def listen(
    node: Any,
    message_type: Any,
    topic: str,
    hear: Callable[[Any], None],
    qos: QoSProfile,
    *,
    most: float = 0.0,
    **options: Any,
) -> Any:
    """Subscribes with a callback that may raise `MessageError`; the node's `refusals` count it.

    Args:
        node: a managed node.
        message_type, topic, qos, options: as for `create_subscription`.
        hear: takes a message.
        most: bytes of a message that is accepted; 0: as the node's `max_message` says.
    """

    def hear_raw(data: bytes) -> None:
        try:
            hear(read(data, message_type, most or node.max_message))
        except Exception as error:  # whatever a message does, the node goes on
            node.refusals.add(topic, error)

    return node.create_subscription(message_type, topic, hear_raw, qos, raw=True, **options)


def take_raw(subscription: Any) -> bytes | None:
    """The next message of a polled subscription as CDR bytes, or None."""
    taken = subscription.handle.take_message(subscription.msg_type, True)
    return None if taken is None else taken[0]


def take_numbered(subscription: Any) -> tuple[bytes, int] | None:
    """As `take_raw`, with the number that its publisher gave the message; 0 where it gives none."""
    taken = subscription.handle.take_message(subscription.msg_type, True)
    return None if taken is None else (taken[0], taken[1]['publication_sequence_number'] or 0)


def introspect(node: Node, service: Any, *, contents: bool = True) -> None:
    """Lets a service publish its calls on `<service>/_service_event`, where they are recorded.

    Args:
        node: whose clock stamps them.
        service: as `create_service` returned it.
        contents: with requests and responses; without, only that and when there was a call.
    """
    what = ServiceIntrospectionState.CONTENTS if contents else ServiceIntrospectionState.METADATA
    service.configure_introspection(node.get_clock(), STREAM, what)


class Diagnostics:
    """Publishes one status of this node on /diagnostics, once a second.

    It is called as the node is, with the namespace: `haptic_bridge`, or `left/haptic_bridge`.

    Args:
        node: the node to speak for.
        collect: called at each publication; returns (level, message, values). Levels are those of
            `diagnostic_msgs/DiagnosticStatus`; values are turned into strings.
    """

    def __init__(
        self, node: Node, collect: Callable[[], tuple[bytes, str, dict[str, object]]]
    ) -> None:
        self._node = node
        self._collect = collect
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, EVENTS)
        self._spoke = time.monotonic()
        self._timer = node.create_timer(1.0, self.publish)

    def catch_up(self) -> None:
        """Publishes if the executor is late with it; for a loop that computes much.

        The executor's thread waits for the interpreter again and again on the way to a callback,
        each time for all that the loop computes without giving it up: long frames, ten times.
        """
        if time.monotonic() - self._spoke > LATE:
            self.publish()

    def publish(self) -> None:
        """Publishes now; the last one before the end of a node is called by hand."""
        self._spoke = time.monotonic()
        level, message, values = self._collect()
        refusals = getattr(self._node, 'refusals', None)
        if refusals is not None:
            values |= refusals.values()
            if news := refusals.news():
                self._node.get_logger().warning(news)
        if not getattr(self._node, 'is_active', True):
            level, message = DiagnosticStatus.WARN, 'inactive'
        name = self._node.get_fully_qualified_name().lstrip('/')
        status = DiagnosticStatus(level=level, name=name, message=message)
        status.values = [KeyValue(key=k, value=_text(v)) for k, v in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp(time.time_ns())
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f'{value:.9g}' if isinstance(value, float) else str(value)
