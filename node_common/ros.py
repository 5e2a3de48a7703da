"""Shared parts of all nodes: topic names, polled subscriptions, diagnostics."""

import math
import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy._rclpy_pybind11 import RMWError
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState

from cutting_trainer.node_common import output
from cutting_trainer.node_common.qos import EVENTS, STREAM
from cutting_trainer.node_common.rejections import TISSUE_FRAME, MessageError
from cutting_trainer.node_common.stamps import seconds_and_nanoseconds

FRAME = TISSUE_FRAME

MESH = 'tissue/mesh'
MESH_UPDATES = 'tissue/mesh_updates'
GET_MESH = 'tissue/get_mesh'
RESET_TISSUE = 'tissue/reset'
FORCE = 'tissue/force'
FRAME_INPUTS = 'tissue/frame_inputs'
PIECES = 'tissue/pieces'
TISSUE_STATE = 'tissue/state'
CUTTING_STATE = 'cutting/state'
CONTACT = 'tool/contact'
INDEXING = 'haptic_bridge/indexing'
CUT = 'cutting/cut'
MESH_RECOVERY_SERVICES = ('cutting/get_mesh', 'haptic_bridge/get_mesh', 'viewer/get_mesh')
"""Services that return the tissue after its owner has died."""
ARM = 'arm'
HAND = f'{ARM}/hand/servo_cp'
E_STOP = 'haptic_bridge/e_stop'
DIAGNOSTICS = '/diagnostics'
MARKERS = 'viewer/markers'
STATIC_FRAMES = 'tf_static'
"""In the namespace, as all but the diagnostics: two trainers in one domain share no frame."""


DIAGNOSTICS_TIMEOUT_S = 1.5
"""Time without a message on /diagnostics after which a loop publishes it itself."""


def stamp(nanoseconds: int) -> Time:
    """Return a time since the epoch [ns] as a message."""
    seconds, rest = seconds_and_nanoseconds(nanoseconds)
    return Time(sec=seconds, nanosec=rest)


class PolledGroup(CallbackGroup):
    """Callback group of subscriptions that a loop polls by `take`; no executor serves it."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


def polled(node: Node, message_type: Any, topic: str, qos: QoSProfile) -> Any:
    """Subscribe for polling with `take` or `take_raw`; no callback ever runs."""
    return node.create_subscription(
        message_type, topic, lambda _: None, qos, callback_group=PolledGroup()
    )


def read(data: bytes, message_type: Any, most: float = math.inf) -> Any:
    """Return a message from CDR bytes.

    Args:
        data: the bytes.
        message_type: expected type.
        most: largest accepted size [bytes].

    Raises:
        MessageError: there are too many bytes, or they are no such message.
    """
    if len(data) > most:
        raise MessageError('too large', f'{len(data)} bytes: this node accepts {most:.0f}')
    try:
        return deserialize_message(data, message_type)
    except (RMWError, ValueError) as error:  # a string that is not UTF-8 is a ValueError
        said = str(error).partition(', at ')[0]
        raise MessageError('no such message', f'{len(data)} bytes: {said}') from None


def take(subscription: Any, most: float = math.inf) -> Any | None:
    """Return the next message of a polled subscription, or None.

    The message is read from its bytes: rclpy reports an unreadable message as no message.

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
    """Subscribe with a callback that may raise `MessageError`; the node's `rejections` count it.

    Args:
        node: a managed node.
        message_type, topic, qos, options: as for `create_subscription`.
        hear: callback.
        most: largest accepted size [bytes]; 0: the node's parameter `max_message`.
    """

    def hear_raw(data: bytes) -> None:
        try:
            hear(read(data, message_type, most or node.max_message))
        except Exception as error:  # no message may stop the node
            node.rejections.add(topic, error)

    return node.create_subscription(message_type, topic, hear_raw, qos, raw=True, **options)


def take_raw(subscription: Any) -> bytes | None:
    """Return the next message of a polled subscription as CDR bytes, or None."""
    taken = subscription.handle.take_message(subscription.msg_type, True)
    return None if taken is None else taken[0]


def take_numbered(subscription: Any) -> tuple[bytes, int] | None:
    """Return the next message's bytes and its publisher's sequence number, 0 without one."""
    taken = subscription.handle.take_message(subscription.msg_type, True)
    return None if taken is None else (taken[0], taken[1]['publication_sequence_number'] or 0)


def publish_raw(publisher: Any, data: bytes) -> None:
    """Publish a message given as CDR bytes, in a third of the time of `Publisher.publish`."""
    publisher.handle.publish_raw(data)


def introspect(node: Node, service: Any, *, contents: bool = True) -> None:
    """Publish the calls of a service on `<service>/_service_event`, to be recorded.

    Args:
        node: whose clock stamps them.
        service: as `create_service` returned it.
        contents: whether with requests and responses; else only the fact and time of a call.
    """
    state = ServiceIntrospectionState.CONTENTS if contents else ServiceIntrospectionState.METADATA
    service.configure_introspection(node.get_clock(), STREAM, state)


class Diagnostics:
    """Publishes one status of this node on /diagnostics, once a second.

    The status has the name of the node, with the namespace: `haptic_bridge`, or
    `left/haptic_bridge`.

    Args:
        node: the node.
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
        # A clock of its own: with `use_sim_time` that of the node may stand still.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(1.0, self.publish, clock=clock)

    def catch_up(self) -> None:
        """Publish if the executor is late; for a loop that computes much.

        The executor's thread waits several times for the interpreter's lock before a callback, each
        time as long as the loop computes without releasing it: ten times with long frames.
        """
        if time.monotonic() - self._spoke > DIAGNOSTICS_TIMEOUT_S:
            self.publish()

    def publish(self) -> None:
        """Publish now; a node calls this before its end."""
        self._spoke = time.monotonic()
        level, message, values = self._collect()
        rejections = getattr(self._node, 'rejections', None)
        if rejections is not None:
            values |= rejections.values() | {'log_lines_dropped': output.dropped()}
            if news := rejections.news():
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
