"""Node `recorder`: every topic of the graph, as it comes, into a bag."""

import itertools
import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from operator import itemgetter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bags.errors import BagError
from bags.message_class import message_class
from bags.message_text import schema_text
from bags.metadata import FORMAT_VERSION
from bags.parameters import ParameterCollector
from bags.qos import OfferedQos
from bags.sequences import SequenceCounter
from bags.writer import BagWriter
from tissue_sim.lifecycle import ManagedNode, Stop, announce_ready, run
from tissue_sim.parameters import parameter, scene_parameter, seed_parameter
from tissue_sim.refusals import MessageError
from tissue_sim.ros import (
    ARM,
    CONTACT,
    DIAGNOSTICS,
    EVENTS,
    FORCE,
    FRAME_INPUTS,
    LATCHED,
    MARKERS,
    MESH,
    MESH_UPDATES,
    STREAM,
    UPDATES,
    Diagnostics,
    polled,
)
from tissue_sim.share import share_folder
from tissue_sim.timing import request_preference

_POLL = 0.004
_NICENESS = -5
_DISCOVER = 0.02
_REVIEW = 1.0
_FLUSH = 0.2
_QUEUE = 1000
"""Messages that a topic may have waiting: a second of a 1 kHz stream."""

_CONFIGURED = {
    MESH: LATCHED,
    MESH_UPDATES: UPDATES,
    FORCE: STREAM,
    FRAME_INPUTS: STREAM,
    CONTACT: STREAM,
    DIAGNOSTICS: EVENTS,
    f'{ARM}/measured_cp': STREAM,
    f'{ARM}/measured_cv': STREAM,
    f'{ARM}/measured_cf': STREAM,
    f'{ARM}/servo_cf': STREAM,
    f'{ARM}/operating_state': LATCHED,
}
"""Depths of our publishers: the graph tells every other part of a QoS, but not its history."""


@dataclass(frozen=True)
class Account:
    """What became of the messages of one topic.

    Attributes:
        received: that came.
        written: that are on disk.
        lost: on the way, by their sequence numbers, or refused by the disk.
        unheard: sent before the recorder knew the topic.
    """

    received: int
    written: int
    lost: int
    unheard: int

    @property
    def sentence(self) -> str:
        """For the user."""
        parts = [f'{self.received} received', f'{self.written} written', f'{self.lost} lost']
        if self.unheard:
            parts.append(f'{self.unheard} sent before it was heard')
        return ', '.join(parts)


class _Stream:
    """One recorded topic: its subscription, taken from by polling, and what came of it."""

    def __init__(self, topic: str, subscription: Any, count_publishers: Callable[[], int]) -> None:
        self.topic = topic
        self.message_type = subscription.msg_type
        self.take = subscription.handle.take_message
        self.qos = subscription.qos_profile
        self.counter = SequenceCounter(count_publishers)


class Recorder(ManagedNode):
    """Subscribes to whatever the graph has and writes it to the bag named by the parameter `bag`.

    It judges no message but by its size: malformed ones are recorded as they came, byte for byte,
    since a bag is where one looks for them. Its refusals count what is larger than `max_message`.

    Parameters:
        bag: folder of the new bag.
        scene: scene file, of which the text goes into the bag; none when empty.
        seed: of the session; goes into the bag.
        account_as_json: say at the end in lines for the launcher what became of all messages.
        max_message: bytes of a message that is recorded, of meshes too.
    """

    largest_message = 1 << 26

    def __init__(self) -> None:
        super().__init__('recorder')
        self._configured = False

    def configure(self) -> None:
        """Begins the bag."""
        folder = str(parameter(self, 'bag', '', 'new folder for the bag'))
        if not folder:
            raise BagError('the parameter "bag" is missing: name the folder of the new bag')
        scene, seed = scene_parameter(self), seed_parameter(self)
        text = 'say at the end in lines of JSON what became of all messages'
        self._as_json = bool(parameter(self, 'account_as_json', False, text))
        self.writer = BagWriter(self._folder(Path(folder)), custom_data=_custom_data(scene, seed))
        self._streams: dict[str, _Stream] = {}
        self._unrecorded: dict[str, str] = {}
        self._drawings = self.resolve_topic_name(MARKERS)
        self._collector = ParameterCollector(self)
        self._depths = {
            self.resolve_topic_name(name): profile.depth for name, profile in _CONFIGURED.items()
        }
        self._diagnostics = Diagnostics(self, self._collect)

    def _folder(self, asked: Path) -> Path:
        """The folder that was asked for; or, where it is taken, one named after it."""
        again, self._configured = self._configured, True
        text = 'the bag was begun by a recorder that died: begin one beside it'
        if not (parameter(self, 'resume', False, text) or again):
            return asked
        later = (asked.with_name(f'{asked.name}-{count}') for count in itertools.count(2))
        return next(folder for folder in itertools.chain([asked], later) if not folder.exists())

    def work(self, stop: Stop) -> None:
        """Records until `stop` is set."""
        self.get_logger().info(request_preference(_NICENESS))
        self._forget()
        self.discover()
        announce_ready(self)
        periods = {self.discover: _DISCOVER, self.review: _REVIEW, self.flush: _FLUSH}
        due = dict.fromkeys(periods, 0.0)
        while not stop.is_set():
            time.sleep(_POLL)
            self.drain()
            now = time.monotonic()
            for act, period in periods.items():
                if now >= due[act]:
                    due[act] = now + period
                    act()

    def rest(self) -> None:
        """Records what has come, and lets pass what comes from now on."""
        self.drain()
        self.flush()

    def _forget(self) -> None:
        """Lets go of what came while the node was inactive: it is neither recorded nor lost."""
        for stream in self._streams.values():
            while stream.take(stream.message_type, True) is not None:
                pass
            stream.counter.pause()

    def discover(self) -> None:
        """Subscribes to topics that have got their first publisher since the last time."""
        for topic, types in self.get_topic_names_and_types():
            if topic not in self._streams and topic not in self._unrecorded:
                if topic == self._drawings:
                    self._unrecorded[topic] = 'it is drawn from what is recorded'
                    continue
                self._start(topic, types[0])

    def review(self) -> None:
        """Looks at the nodes, and at the publishers of recorded topics, anew."""
        self._collector.look()
        self.writer.describe(parameters=self._collector.text)
        for stream in self._streams.values():
            publishers = self.get_publishers_info_by_topic(stream.topic)
            weaker = [p.node_name for p in publishers if not _compatible(p.qos_profile, stream.qos)]
            if weaker and stream.topic not in self._unrecorded:
                self._give_up(
                    stream.topic,
                    f'{", ".join(weaker)} came later and offers a weaker QoS than those before',
                )

    def flush(self) -> None:
        """Hands what has come to the operating system; says at once when that refuses it."""
        well = not self.writer.failure
        self.writer.flush()
        if well and self.writer.failure:
            self.get_logger().error(f'{self.writer.failure}: nothing is recorded from now on')

    def drain(self) -> None:
        """Takes all that has come and gives it to the writer in the order of arrival."""
        batch = []
        for stream in list(self._streams.values()):
            while (taken := stream.take(stream.message_type, True)) is not None:
                data, info = taken
                if len(data) > self.max_message:
                    text = f'{len(data)} bytes: {self.max_message} at most (parameter max_message)'
                    self.refusals.add(stream.topic, MessageError('too large', text))
                    stream.counter.add(info['publication_sequence_number'])
                    continue
                number = info['publication_sequence_number']
                stream.counter.add(number)
                received = info['received_timestamp'] or time.time_ns()
                batch.append((received, stream.topic, info['source_timestamp'], data, number))
        batch.sort(key=itemgetter(0))
        for received, topic, published, data, number in batch:
            self.writer.write(topic, received, published, data, number or 0)

    def release(self) -> None:
        """Takes the last messages, completes the bag and says what became of all."""
        self.writer.describe(parameters=self._collector.text)
        self.writer.close()
        self._say(self.accounts())
        if self.writer.failure:
            lost = sum(self.writer.lost.values())
            text = f'{self.writer.failure}: {lost} messages are not in the bag'
            print(f'failed: {self.get_name()}: {text}', flush=True)

    def _say(self, accounts: dict[str, Account]) -> None:
        """What became of all messages, for the user or for the launcher."""
        tally = self.writer.tally
        if self._as_json:
            told = {
                'bag': str(self.writer.folder),
                'bytes': self.writer.size,
                'failure': self.writer.failure,
                'not_recorded': self._unrecorded,
            }
            print(f'message: {json.dumps(told)}', flush=True)
            for topic, account in accounts.items():  # one by one: lines have a greatest length
                print(f'message: {json.dumps({topic: asdict(account)})}', flush=True)
            return
        print(
            f'recorded: {tally.messages} messages, {len(tally.counts)} topics, '
            f'{sum(account.lost for account in accounts.values())} lost, {self.writer.folder}',
            flush=True,
        )
        for topic, account in accounts.items():
            print(f'  {topic}: {account.sentence}', flush=True)
        for topic, reason in self._unrecorded.items():
            print(f'  not recorded: {topic}: {reason}', flush=True)

    def accounts(self) -> dict[str, Account]:
        """What became of the messages of each topic so far."""
        written, refused = self.writer.tally.counts, self.writer.lost
        return {
            topic: Account(
                received=stream.counter.received,
                written=written.get(topic, 0),
                lost=stream.counter.lost + refused.get(topic, 0),
                unheard=stream.counter.before,
            )
            for topic, stream in self._streams.copy().items()  # the loop may find another one
        }

    def _start(self, topic: str, type_name: str) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        try:
            message_type, schema = message_class(type_name), schema_text(type_name)
        except BagError as error:
            self._give_up(topic, str(error))
            return
        depth = self._depths.get(topic, 10)
        profiles = dict.fromkeys(_offered(info.qos_profile, depth) for info in publishers)
        # rosbags looks up hashes of messages only, and refuses a bag that has any other.
        type_hash = str(publishers[0].topic_type_hash) if '/msg/' in type_name else ''
        self.writer.add_topic(topic, type_name, schema, type_hash, tuple(profiles))
        subscription = polled(self, message_type, topic, _request(publishers))
        self._streams[topic] = _Stream(
            topic, subscription, lambda: len(self.get_publishers_info_by_topic(topic))
        )

    def _give_up(self, topic: str, reason: str) -> None:
        self._unrecorded[topic] = reason
        self.get_logger().warning(f'not recorded: {topic}: {reason}')

    def _collect(self) -> tuple[bytes, str, dict[str, object]]:
        accounts = self.accounts()
        totals = {
            word: sum(getattr(account, word) for account in accounts.values())
            for word in ('received', 'written', 'lost')
        }
        values: dict[str, object] = {**totals, 'bytes': self.writer.size}
        for topic, account in accounts.items():
            values |= {f'{word} {topic}': count for word, count in asdict(account).items()}
        unrecorded = self._unrecorded.copy().items()
        values |= {f'not recorded {topic}': reason for topic, reason in unrecorded}
        if self.writer.failure:
            return DiagnosticStatus.ERROR, self.writer.failure, values
        if totals['lost'] or self._unrecorded:
            return DiagnosticStatus.WARN, 'the bag is not whole', values
        return DiagnosticStatus.OK, 'recording', values


def main() -> None:
    """Runs the node; exit status 1 where the disk has refused messages."""
    recorder = run(Recorder)
    raise SystemExit(1 if recorder.writer.failure else 0)


def _custom_data(scene: str, seed: int) -> dict[str, str]:
    data = {
        'format_version': str(FORMAT_VERSION),
        'seed': str(seed),
        'python_version': platform.python_version(),
    }
    manifest = share_folder() / 'package.xml'
    if manifest.is_file():
        data['trainer_version'] = ElementTree.parse(manifest).findtext('version', '')
    for package in ('ros-jazzy-rclpy', 'rclpy', 'numpy', 'numba', 'mcap'):
        try:
            data[f'{package}_version'] = version(package)
        except PackageNotFoundError:
            continue
    if scene:
        try:
            data['scene'] = Path(scene).read_text(encoding='utf-8')
        except OSError as error:
            raise BagError(f'cannot read the scene {scene}: {error.strerror}') from None
        data['scene_file'] = Path(scene).name
    return data


def _offered(profile: QoSProfile, depth: int) -> OfferedQos:
    return OfferedQos(
        depth=depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline=profile.deadline.nanoseconds,
        lifespan=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.name.lower(),
        liveliness_lease_duration=profile.liveliness_lease_duration.nanoseconds,
    )


def _request(publishers: list[Any]) -> QoSProfile:
    """The strongest QoS that all of the publishers offer."""
    profiles = [info.qos_profile for info in publishers]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_QUEUE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _compatible(offered: QoSProfile, requested: QoSProfile) -> bool:
    reliable = offered.reliability == ReliabilityPolicy.RELIABLE
    latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return (reliable or requested.reliability == ReliabilityPolicy.BEST_EFFORT) and (
        latched or requested.durability == DurabilityPolicy.VOLATILE
    )


if __name__ == '__main__':
    main()
