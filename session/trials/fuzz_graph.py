"""Whom the fuzzer sends to: every topic that is heard, every service, of a graph that runs."""

import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bags.message_class import message_class
from session.graph import RECORDER_NODE
from session.trials.fuzz_messages import KINDS, Kind, Maker, huge
from tissue_sim import ros

BURST = 100
"""Messages between two pauses."""
ROUND = 2000
"""Messages to one topic before the next has its turn."""
CALLS = 20
"""Requests to one service in its turn, half of them at once."""
ANSWER = 2.0
"""[s] that an answer is waited for."""
LEFT_OUT = ('change_state', 'set_parameters', 'set_parameters_atomically')
"""Services of every node that do what they are asked, an end or a standstill among it."""
HUGE_PAUSE = 0.1
"""[s] after each huge message."""
ENOUGH = 0.5
"""Share of their usual rate that the force commands keep while messages come faster and faster."""
LOOK = 0.25
"""[s] over which that rate is taken."""
SHORTEST_PAUSE, MOST_PAUSE = 1e-3, 0.04
"""[s] between two bursts at least and at most."""
_DEPTH = 200


class Sent:
    """What the fuzzer has sent, so that whoever listens can tell it from what the nodes say."""

    def __init__(self) -> None:
        self._hashes: set[int] = set()

    def add(self, topic: str, data: bytes) -> None:
        """Notes a message before it goes out."""
        self._hashes.add(hash((topic, data)))

    def has(self, topic: str, data: bytes) -> bool:
        """Whether the fuzzer has sent it."""
        return hash((topic, data)) in self._hashes


@dataclass
class Target:
    """A topic to send to.

    Attributes:
        topic: its name.
        message_type: its class.
        latched: somebody asks for what was sent before, too.
        weight: how often it has its turn.
        heard: valid messages.
        publisher: of the fuzzer.
    """

    topic: str
    message_type: Any
    latched: bool
    weight: float
    heard: list[bytes] = field(default_factory=list)
    publisher: Any = None


class Fuzzer:
    """Sends in a thread of its own, topic by topic, as fast as the nodes bear: while the force
    commands come as they should it goes faster, else slower.

    Args:
        node: to send with; no executor has it.
        seed: of all that is random.
        own: nodes that are not aimed at.
        sent: takes note of what goes out, for whoever listens.
        commands: gives how many force commands have come so far.

    Attributes:
        messages: by topic or service.
        kinds: by kind of message.
        targets, clients: topics and services that it sends to.
        answers: of services.
        problem: why it broke off, '' if it did not.
        done: it has sent what it was asked to.
    """

    def __init__(
        self,
        node: Node,
        seed: int,
        own: tuple[str, ...],
        sent: Sent,
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
        """Takes valid messages; call it for a while before `start`."""
        for target, subscription in zip(self.targets, self._subscriptions, strict=True):
            if (data := ros.take_raw(subscription)) is not None and len(target.heard) < most:
                target.heard.append(data)

    def start(self, messages: int, flood: float, largest: int) -> None:
        """Begins to send.

        Args:
            messages: how many.
            flood: [s] for which each fast topic is flooded afterwards.
            largest: bytes of one message to each topic that can have so many.
        """
        count, elapsed = self._commands() - self._counted, time.monotonic() - self._looked
        self._enough = ENOUGH * count / elapsed
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
        """Stops sending and takes the publishers away."""
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
            for _ in range(0, min(ROUND, left), BURST):
                self._burst(target, min(BURST, left))
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
        """Waits, longer and longer while the nodes' force loop does not keep up."""
        now = time.monotonic()
        if now - self._looked >= LOOK:
            count = self._commands()
            keeps_up = (count - self._counted) / (now - self._looked) >= self._enough
            self._looked, self._counted = now, count
            self._pause = self._pause * 0.8 if keeps_up else min(2 * self._pause, MOST_PAUSE)
        time.sleep(max(self._pause, SHORTEST_PAUSE))

    def _publish(self, target: Target, data: bytes) -> None:
        self.sent.add(target.topic, data)
        target.publisher.publish(data)
        self.messages[target.topic] += 1

    def _call(self, client: Any) -> None:
        for _ in range(2):
            asked = CALLS // 2
            for _ in range(asked):
                request = self._maker.made(client.srv_type.Request)
                client.handle.send_request(request)
                self.messages[client.srv_name] += 1
                self.kinds['requests'] += 1
            self._take_answers(client, asked)

    def _take_answers(self, client: Any, asked: int) -> None:
        deadline, got = time.monotonic() + ANSWER, 0
        while got < asked and time.monotonic() < deadline:
            if client.handle.take_response(client.srv_type.Response)[1] is None:
                time.sleep(0.001)
            else:
                got += 1
        self.answers += got

    def _flood(self, target: Target, seconds: float) -> None:
        """Ten messages each millisecond, of which half are as they should be."""
        began, count = time.monotonic(), 0
        while (elapsed := time.monotonic() - began) < seconds and not self._stop.is_set():
            for _ in range(min(round(_FLOOD * elapsed) - count, BURST)):
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
            time.sleep(HUGE_PAUSE)

    def _find_topics(self) -> list[Target]:
        found = []
        for topic, types in sorted(self._node.get_topic_names_and_types()):
            hearers = [
                info
                for info in self._node.get_subscriptions_info_by_topic(topic)
                if info.node_name not in self._own
            ]
            if not hearers:
                continue
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
            if name.rsplit('/', 1)[-1] not in LEFT_OUT and name.split('/')[1] not in self._own
        ]

    def _ear(self, target: Target) -> Any:
        qos = ros.LATCHED if target.latched else ros.NEWEST_BEST_EFFORT
        return ros.polled(self._node, target.message_type, target.topic, qos)


_FAST = ('measured_cp', 'measured_cv', 'measured_cf', 'servo_cf', 'contact')
"""Last names of the topics of 1 kHz."""
_FLOOD = 10_000
"""Messages a second of a flood."""
_SHARES = (0.08, 0.12, 0.5, 0.3)
"""Of `KINDS`: the last two cost least."""
