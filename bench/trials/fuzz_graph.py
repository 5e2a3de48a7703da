"""Fuzzer of a running graph: it sends to every subscribed topic and every service."""

import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bench.trials.fuzz_messages import KINDS, Kind, Maker, huge
from cutting_trainer.bags.message_class import message_class
from cutting_trainer.node_common import qos, ros
from cutting_trainer.session.node_commands import RECORDER_NODE

BURST_MESSAGES = 100
"""Number of messages between two pauses."""
MESSAGES_PER_TOPIC = 2000
"""Number of messages to one topic before the next topic."""
REQUESTS_PER_SERVICE = 20
"""Number of requests to one service, half of them at once."""
ANSWER_TIMEOUT_S = 2.0
"""Timeout of an answer."""
EXCLUDED_SERVICES = ('change_state', 'set_parameters', 'set_parameters_atomically')
"""Services of every node that may end or stop it on a valid request."""
HUGE_MESSAGE_PAUSE_S = 0.1
"""Pause after each huge message."""
MIN_RATE_SHARE = 0.5
"""Share of their usual rate that the force commands must keep; the messages slow down below it."""
RATE_INTERVAL_S = 0.25
"""Interval over which that rate is measured."""
MIN_PAUSE_S, MAX_PAUSE_S = 1e-3, 0.04
"""Shortest and longest pause between two bursts [s]."""
_DEPTH = 200


class SentMessages:
    """Record of sent messages, by which a subscriber distinguishes them from those of the nodes."""

    def __init__(self) -> None:
        self._hashes: set[int] = set()

    def add(self, topic: str, data: bytes) -> None:
        """Register a message before it is published."""
        self._hashes.add(hash((topic, data)))

    def has(self, topic: str, data: bytes) -> bool:
        """Return whether the fuzzer has sent it."""
        return hash((topic, data)) in self._hashes


@dataclass
class Target:
    """Topic to send to.

    Attributes:
        topic: name of the topic.
        message_type: class of its messages.
        latched: a subscription is transient local.
        weight: relative frequency of its choice.
        heard: valid messages.
        publisher: publisher of the fuzzer.
    """

    topic: str
    message_type: Any
    latched: bool
    weight: float
    heard: list[bytes] = field(default_factory=list)
    publisher: Any = None


class Fuzzer:
    """Send in a thread, topic by topic, as fast as the nodes can process: while the force
    commands come as they should it goes faster, else slower.

    Args:
        node: node to send with; it belongs to no executor.
        seed: seed of all random numbers.
        own: nodes that get no messages.
        sent: record of sent messages.
        commands: returns the number of force commands so far.

    Attributes:
        messages: number of messages, by topic or service.
        kinds: number of messages, by kind.
        targets, clients: topics and services to send to.
        answers: number of answers of services.
        problem: reason of an early end, '' if none.
        done: all messages are sent.
    """

    def __init__(
        self,
        node: Node,
        seed: int,
        own: tuple[str, ...],
        sent: SentMessages,
        commands: Callable[[], int],
    ) -> None:
        self.sent = sent
        self.messages: Counter[str] = Counter()
        self.kinds: Counter[str] = Counter()
        self.answers = 0
        self.done = False
        self.problem = ''
        self._node, self._own = node, own
        self._commands, self._enough = commands, 0.0
        self._pause, self._looked, self._counted = 0.01, time.monotonic(), commands()
        self._maker, self._random = Maker(seed), random.Random(seed)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.targets = self._find_topics()
        self._subscriptions = [self._ear(target) for target in self.targets]
        self.clients = self._find_services()

    def hear(self, most: int = 12) -> None:
        """Collect valid messages; call it for some seconds before `start`."""
        for target, subscription in zip(self.targets, self._subscriptions, strict=True):
            if (data := ros.take_raw(subscription)) is not None and len(target.heard) < most:
                target.heard.append(data)

    def start(self, messages: int, flood: float, largest: int) -> None:
        """Begin to send.

        Args:
            messages: number of messages.
            flood: [s] for which each fast topic is flooded afterwards.
            largest: bytes of one message to each topic that can have so many.
        """
        count, elapsed = self._commands() - self._counted, time.monotonic() - self._looked
        self._enough = MIN_RATE_SHARE * count / elapsed
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for target in self.targets:
            latched = DurabilityPolicy.TRANSIENT_LOCAL
            target.publisher = self._node.create_publisher(
                target.message_type,
                target.topic,
                QoSProfile(
                    depth=1 if target.latched else _DEPTH,
                    history=HistoryPolicy.KEEP_LAST,
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=latched if target.latched else DurabilityPolicy.VOLATILE,
                ),
            )
        time.sleep(1.0)  # until they are found
        arguments = messages, flood, largest
        self._thread = threading.Thread(target=self._run, args=arguments, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop sending and destroy the publishers."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        for target in self.targets:
            if target.publisher is not None:
                self._node.destroy_publisher(target.publisher)
                target.publisher = None

    def _run(self, messages: int, flood: float, largest: int) -> None:
        try:
            self._send_all(messages)
            for target in self.targets:
                if target.topic.rsplit('/', 1)[-1] in _FAST:
                    self._flood(target, flood)
            for target in self.targets:
                if not self._stop.is_set():
                    self._send_huge(target, largest)
        except Exception as error:
            self.problem = f'the fuzzer failed: {type(error).__name__}: {error}'
        self.done = True

    def _send_all(self, messages: int) -> None:
        weights = [target.weight for target in self.targets]
        calls = 0
        while self.messages.total() < messages and not self._stop.is_set():
            (target,) = self._random.choices(self.targets, weights)
            left = messages - self.messages.total()
            for _ in range(0, min(MESSAGES_PER_TOPIC, left), BURST_MESSAGES):
                self._burst(target, min(BURST_MESSAGES, left))
                if self._stop.is_set():
                    return
            if self.clients:
                calls += 1
                self._call(self.clients[calls % len(self.clients)])

    def _burst(self, target: Target, count: int) -> None:
        for kind in self._random.choices(KINDS, _SHARES, k=count):
            data = self._maker.message(kind, target.message_type, target.heard)
            self._publish(target, data)
            self.kinds[kind] += 1
        self._pace()

    def _pace(self) -> None:
        """Pause; the pause grows while the force loop of the nodes does not keep up."""
        now = time.monotonic()
        if now - self._looked >= RATE_INTERVAL_S:
            count = self._commands()
            keeps_up = (count - self._counted) / (now - self._looked) >= self._enough
            self._looked, self._counted = now, count
            self._pause = self._pause * 0.8 if keeps_up else min(2 * self._pause, MAX_PAUSE_S)
        time.sleep(max(self._pause, MIN_PAUSE_S))

    def _publish(self, target: Target, data: bytes) -> None:
        self.sent.add(target.topic, data)
        target.publisher.publish(data)
        self.messages[target.topic] += 1

    def _call(self, client: Any) -> None:
        for _ in range(2):
            asked = REQUESTS_PER_SERVICE // 2
            for _ in range(asked):
                request = self._maker.made(client.srv_type.Request)
                client.handle.send_request(request)
                self.messages[client.srv_name] += 1
                self.kinds['requests'] += 1
            self._take_answers(client, asked)

    def _take_answers(self, client: Any, asked: int) -> None:
        deadline, got = time.monotonic() + ANSWER_TIMEOUT_S, 0
        while got < asked and time.monotonic() < deadline:
            if client.handle.take_response(client.srv_type.Response)[1] is None:
                time.sleep(0.001)
            else:
                got += 1
        self.answers += got

    def _flood(self, target: Target, seconds: float) -> None:
        """Send ten messages each millisecond, half of them valid."""
        began, count = time.monotonic(), 0
        while (elapsed := time.monotonic() - began) < seconds and not self._stop.is_set():
            for _ in range(min(round(_FLOOD_RATE_HZ * elapsed) - count, BURST_MESSAGES)):
                kind: Kind = 'overwritten' if target.heard else 'made'
                good = target.heard[count % len(target.heard)] if target.heard else b''
                made = self._maker.message(kind, target.message_type, target.heard)
                self._publish(target, made if count % 4 else good or made)
                self.kinds['flood'] += 1
                count += 1
            time.sleep(0.0005)

    def _send_huge(self, target: Target, size: int) -> None:
        data = huge(target.message_type, size)
        if data is not None:
            self._publish(target, data)
            self.kinds['huge'] += 1
            time.sleep(HUGE_MESSAGE_PAUSE_S)

    def _find_topics(self) -> list[Target]:
        found = []
        for topic, types in sorted(self._node.get_topic_names_and_types()):
            hearers = [
                info
                for info in self._node.get_subscriptions_info_by_topic(topic)
                if info.node_name not in self._own
            ]
            if not hearers or topic.endswith(f'/{ros.E_STOP}'):
                continue  # any request to it presses E-STOP: none can be malformed
            asked = {info.qos_profile.durability for info in hearers}
            latched = DurabilityPolicy.TRANSIENT_LOCAL in asked
            acted_on = any(info.node_name != RECORDER_NODE for info in hearers)
            kind = message_class(types[0])
            found.append(Target(topic, kind, latched, 4.0 if acted_on else 1.0))
        return found

    def _find_services(self) -> list[Any]:
        return [
            self._node.create_client(message_class(types[0]), name)
            for name, types in sorted(self._node.get_service_names_and_types())
            if name.rsplit('/', 1)[-1] not in EXCLUDED_SERVICES
            and name.split('/')[1] not in self._own
        ]

    def _ear(self, target: Target) -> Any:
        profile = qos.LATCHED if target.latched else qos.NEWEST_BEST_EFFORT
        return ros.polled(self._node, target.message_type, target.topic, profile)


_FAST = ('measured_cp', 'measured_cv', 'measured_cf', 'servo_cf', 'contact')
"""Base names of the topics at 1 kHz."""
_FLOOD_RATE_HZ = 10_000
"""Messages per second of a flood."""
_SHARES = (0.08, 0.12, 0.5, 0.3)
"""Shares of `KINDS`: the last two cost least."""
