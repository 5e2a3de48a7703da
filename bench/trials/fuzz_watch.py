"""Observation of the nodes of a fuzzed session: finite messages, memory, liveness."""

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from cutting_trainer_msgs.msg import Contact, ForceSample, Mesh, MeshDelta
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node as RosNode
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from visualization_msgs.msg import MarkerArray

from bench.trials.fuzz_verdict import Node
from bench.trials.soak import sample_process
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
)
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.node_common.stamps import nanoseconds

MAX_COORDINATE_M = 1e3
"""Limit of published coordinates."""
_POLL_PERIOD_S = 0.02
_MEMORY_PERIOD_S = 0.5
_MAX_PROBLEMS = 20
_ALL = QoSProfile(
    depth=500, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)


class NodeObserver:
    """Observe published messages and processes in a thread.

    Args:
        node: node to subscribe with; it belongs to no executor.
        pids: returns the process ids by the names of the nodes.
        forged: returns whether a message of a topic is the fuzzer's.

    Attributes:
        nodes: observations by name of the node.
        problems: invalid published messages.
        seen: number of checked messages of the nodes, by topic.
    """

    def __init__(
        self,
        node: RosNode,
        pids: Callable[[], Mapping[str, int]],
        forged: Callable[[str, bytes], bool],
    ) -> None:
        self.nodes: defaultdict[str, Node] = defaultdict(Node)
        self.problems: list[str] = []
        self.seen: Counter[str] = Counter()
        self._node, self._pids, self._forged = node, pids, forged
        newest, best_effort = ros.polled, qos.NEWEST_BEST_EFFORT
        fast: tuple[tuple[Any, str, StampedCodec], ...] = (
            (Contact, ros.CONTACT, ContactCodec()),
            (ForceSample, ros.FORCE, ForceSampleCodec()),
            (PoseStamped, f'{ros.ARM}/measured_cp', PoseStampedCodec()),
        )
        self._fast = [(newest(node, kind, name, best_effort), codec) for kind, name, codec in fast]
        slow = ((Mesh, ros.MESH), (MeshDelta, ros.MESH_UPDATES), (MarkerArray, ros.MARKERS))
        self._slow = [newest(node, kind, name, best_effort) for kind, name in slow]
        self._statuses = ros.polled(node, DiagnosticArray, ros.DIAGNOSTICS, _ALL)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Store the present memory as that before the first bad message."""
        for name, megabytes in self._memory():
            self.nodes[name].before = megabytes
            heard = self._node.get_subscriber_names_and_types_by_node(name, '/')
            self.nodes[name].hears = len(heard)

    def end(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()
        self._measure()

    def _run(self) -> None:
        due = 0.0
        while not self._stop.is_set():
            time.sleep(_POLL_PERIOD_S)
            self._look()
            if time.monotonic() >= due:
                due = time.monotonic() + _MEMORY_PERIOD_S
                self._measure()

    def _memory(self) -> list[tuple[str, float]]:
        looks = [sample_process(name, pid, 0.0) for name, pid in self._pids().items()]
        return [(seen.subject, seen.values['memory [MB]']) for seen in looks if seen is not None]

    def _measure(self) -> None:
        for name, megabytes in self._memory():
            seen = self.nodes[name]
            seen.after, seen.most = megabytes, max(seen.most, megabytes)

    def _look(self) -> None:
        for subscription, codec in self._fast:
            if (data := self._take(subscription)) is not None:
                self._check_fast(subscription.topic_name, codec, data)
        for subscription in self._slow:
            if (data := self._take(subscription)) is not None:
                self._check_numbers(subscription.topic_name, ros.read(data, subscription.msg_type))
        while (data := ros.take_raw(self._statuses)) is not None:
            if not self._forged(self._statuses.topic_name, data):
                said = ros.read(data, DiagnosticArray)
                for status in said.status:
                    values = {pair.key: pair.value for pair in status.values}
                    self.nodes[status.name].speaks(nanoseconds(said.header.stamp) * 1e-9, values)

    def _take(self, subscription: Any) -> bytes | None:
        data = ros.take_raw(subscription)
        if data is None or self._forged(subscription.topic_name, data):
            return None
        self.seen[subscription.topic_name] += 1
        return data

    def _check_fast(self, topic: str, codec: StampedCodec, data: bytes) -> None:
        try:
            codec.believed(data)
        except MessageError as error:
            self._report(f'{topic}: {error}')

    def _check_numbers(self, topic: str, message: Any) -> None:
        for name, numbers in numbers_of(message):
            if not (np.abs(numbers) <= MAX_COORDINATE_M).all():  # a NaN is not
                self._report(f'{topic}: {name} has a number that is not finite or too far')

    def _report(self, problem: str) -> None:
        if len(self.problems) < _MAX_PROBLEMS:
            self.problems.append(problem)


def numbers_of(message: Any) -> list[tuple[str, np.ndarray]]:
    """Return the numbers of a mesh or of markers that are coordinates, by name."""
    if isinstance(message, MarkerArray):
        points = [(p.x, p.y, p.z) for marker in message.markers for p in marker.points]
        places = [marker.pose.position for marker in message.markers]
        return [
            ('points', np.array(points, float)),
            ('positions', np.array([(p.x, p.y, p.z) for p in places], float)),
        ]
    return [(name, np.asarray(getattr(message, name))) for name in ('rest', 'displacement')]
