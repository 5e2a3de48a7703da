"""What every node shell shares: names, QoS, polled subscriptions, diagnostics, a clean end."""

import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import CallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service_introspection import ServiceIntrospectionState

FRAME = 'tissue'

MESH = 'tissue/mesh'
MESH_UPDATES = 'tissue/mesh_updates'
GET_MESH = 'tissue/get_mesh'
FORCE = 'tissue/force'
FRAME_INPUTS = 'tissue/frame_inputs'
CONTACT = 'tool/contact'
CUT = 'cutting/cut'
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
UPDATES = _reliable(30)
EVENTS = _reliable(10)


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


def take(subscription: Any) -> Any | None:
    """The next message of a polled subscription, or None."""
    taken = subscription.handle.take_message(subscription.msg_type, False)
    return None if taken is None else taken[0]


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
    service.configure_introspection(node.get_clock(), EVENTS, what)


class Diagnostics:
    """Publishes one status of this node on /diagnostics, once a second.

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
        self._timer = node.create_timer(1.0, self.publish)

    def publish(self) -> None:
        """Publishes now; the last one before the end of a node is called by hand."""
        level, message, values = self._collect()
        status = DiagnosticStatus(level=level, name=self._node.get_name(), message=message)
        status.values = [KeyValue(key=k, value=_text(v)) for k, v in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f'{value:.9g}' if isinstance(value, float) else str(value)


class Stop:
    """A flag that a signal handler may set at any moment; `threading.Event` can deadlock there."""

    def __init__(self) -> None:
        self._set = False

    def set(self) -> None:
        """Asks for the end."""
        self._set = True

    def is_set(self) -> bool:
        """Whether the end is asked for."""
        return self._set

    def wait(self) -> None:
        """Returns soon after `set`."""
        while not self._set:
            time.sleep(0.05)


def announce_ready(node: Node) -> None:
    """Tells the launcher, by a line on standard output, that the node does its work."""
    print(f'ready: {node.get_name()}', flush=True)


def run(make_node: Callable[[], Node], work: Callable[[Any, Stop], None] | None = None) -> Any:
    """Runs a node to SIGINT or SIGTERM and ends it in order; the main of every node.

    Callbacks are served by an executor. Where `work` is given, the executor has a thread of its own
    and `work(node, stop)` has the main thread; it returns soon after `stop` is set. A node may have
    a method `close()`, called before it is destroyed. A ValueError while the node is made ends the
    process with that one sentence and exit status 2.

    Returns:
        The node, destroyed.
    """
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    stop = Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        node = make_node()
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr, flush=True)
        rclpy.shutdown()
        raise SystemExit(2) from None
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = threading.Thread(target=_spin, args=(executor, node, stop), daemon=True)
    spinner.start()
    try:
        if work is None:
            stop.wait()
        else:
            work(node, stop)
    finally:
        stop.set()
        spinner.join(2.0)
        if hasattr(node, 'close'):
            node.close()
        node.destroy_node()
        rclpy.shutdown()
    return node


def _spin(executor: SingleThreadedExecutor, node: Node, stop: Stop) -> None:
    while not stop.is_set():
        try:
            executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return
        except Exception as error:
            # Bytes of another type than the topic's, say: no reason to be deaf from then on.
            said = f'a callback failed: {type(error).__name__}: {error}'
            node.get_logger().error(said, throttle_duration_sec=1.0)
