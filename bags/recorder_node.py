"""Node `recorder`: records every topic of the graph into a bag."""

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from operator import itemgetter
from pathlib import Path
from typing import Any

from cutting_trainer_msgs.msg import State
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy._rclpy_pybind11 import RMWError
from rclpy.serialization import deserialize_message

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_class import message_class
from cutting_trainer.bags.message_loss import SequenceCounter
from cutting_trainer.bags.message_text import schema_text
from cutting_trainer.bags.metadata import FORMAT_VERSION
from cutting_trainer.bags.parameter_collector import ParameterCollector
from cutting_trainer.bags.qos_adaptation import (
    CONFIGURED,
    is_compatible,
    offered_qos,
    strongest_request,
)
from cutting_trainer.bags.steady_clock import SteadyClock
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, run
from cutting_trainer.node_common.output import announce
from cutting_trainer.node_common.parameters import parameter, scene_parameter, seed_parameter
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.node_common.ros import (
    CONTACT,
    CUTTING_STATE,
    FRAME_INPUTS,
    MARKERS,
    TISSUE_STATE,
    Diagnostics,
    polled,
)
from cutting_trainer.node_common.timing import request_preference

_POLL_PERIOD_S = 0.02
"""[s] between two polls of all topics, whose queues hold a second of a 1 kHz stream."""
_NICENESS = -12
"""Before the tissue: a frame can come later, and a message that is not taken in time is lost."""
_DISCOVERY_PERIOD_S = 0.02
_REVIEW_PERIOD_S = 1.0
_FLUSH_PERIOD_S = 0.2
_INPUTS_TIMEOUT_S = 5.0
"""Time after which the recorder subscribes to states, with or without the inputs of frames."""
_STATE_TIMEOUT_S = 3.0
"""Time for which a recorder that is to end waits for the states that it has asked for."""
_DISCOVERY_TIMEOUT_S = 1.0
"""Time after which a topic that was not discovered has no publisher."""


@dataclass(frozen=True)
class Account:
    """Numbers of messages of one topic, by their fate.

    Attributes:
        received: by the recorder.
        written: to the disk.
        lost: in transport, by their sequence numbers, or not taken by the disk.
        missed: missed before subscription.
    """

    received: int
    written: int
    lost: int
    missed: int

    @property
    def sentence(self) -> str:
        """Return the numbers as a phrase for the user."""
        parts = [f'{self.received} received', f'{self.written} written', f'{self.lost} lost']
        if self.missed:
            parts.append(f'{self.missed} missed before subscription')
        return ', '.join(parts)


class _Stream:
    """One recorded topic: its polled subscription, and the counts of its messages."""

    def __init__(self, topic: str, subscription: Any, count_publishers: Callable[[], int]) -> None:
        self.topic = topic
        self.message_type = subscription.msg_type
        self.take = subscription.handle.take_message
        self.qos = subscription.qos_profile
        self.counter = SequenceCounter(count_publishers)


class Recorder(ManagedNode):
    """Subscribes to every topic of the graph and writes it to the bag of the parameter `bag`.

    It checks only the size of a message: malformed ones are recorded byte for byte, for later
    analysis. Its rejection statistics count messages larger than `max_message`.

    Parameters:
        bag: folder of the new bag.
        scene: scene file, whose text goes into the bag; none when empty.
        seed: of the session; goes into the bag.
        subject, attempt, notes: pseudonym, number of the attempt and remarks; go into the bag.
        account_as_json: report the counts of all messages at the end, as JSON for the launcher.
        max_message: largest number of bytes of a recorded message, meshes included.
    """

    largest_message = 1 << 26

    def __init__(self) -> None:
        super().__init__('recorder')
        self._configured = False
        self._polls = 0

    def configure(self) -> None:
        """Create the bag."""
        folder = str(parameter(self, 'bag', '', 'new folder for the bag'))
        if not folder:
            raise BagError('the parameter "bag" is missing: name the folder of the new bag')
        scene, seed = scene_parameter(self), seed_parameter(self)
        text = 'report the counts of all messages at the end in lines of JSON'
        self._as_json = bool(parameter(self, 'account_as_json', False, text))
        data = _custom_data(scene, seed) | self._attempt()
        self.writer = BagWriter(self._folder(Path(folder)), custom_data=data)
        self._steady = SteadyClock()
        self._streams: dict[str, _Stream] = {}
        self._unrecorded: dict[str, str] = {}
        self._needless: dict[str, str] = {}
        self._drawings = self.resolve_topic_name(MARKERS)
        self._states = {self.resolve_topic_name(name) for name in (TISSUE_STATE, CUTTING_STATE)}
        self._parts: dict[tuple[str, int], set[int]] = {}
        self._complete_states: set[str] = set()
        self._inputs = [self.resolve_topic_name(name) for name in (CONTACT, FRAME_INPUTS)]
        self._begun = time.monotonic()
        self._collector = ParameterCollector(self)
        self._depths = {
            self.resolve_topic_name(name): profile.depth for name, profile in CONFIGURED.items()
        }
        self._diagnostics = Diagnostics(self, self._collect)

    def _attempt(self) -> dict[str, str]:
        """Return who made the attempt, as far as it is said, for the bag."""
        texts = {
            'subject': 'pseudonym of the trainee',
            'attempt': 'number of the attempt, from 1',
            'notes': 'remarks on the session',
        }
        given = {name: str(parameter(self, name, '', text)) for name, text in texts.items()}
        return {name: value for name, value in given.items() if value}

    def _folder(self, asked: Path) -> Path:
        """Return the requested folder; or, where it exists, a new one named after it."""
        again, self._configured = self._configured, True
        text = 'the bag was begun by a recorder that died: begin one beside it'
        if not (parameter(self, 'resume', False, text) or again):
            return asked
        later = (asked.with_name(f'{asked.name}-{count}') for count in itertools.count(2))
        return next(folder for folder in itertools.chain([asked], later) if not folder.exists())

    @property
    def progress(self) -> int:
        """Return the number of loop iterations."""
        return self._polls

    def work(self, stop: Stop) -> None:
        """Record until `stop` is set."""
        self.get_logger().info(request_preference(_NICENESS))
        self._forget()
        self._begun = time.monotonic()
        self.discover()
        announce_ready(self)
        periods = {
            self.discover: _DISCOVERY_PERIOD_S,
            self.review: _REVIEW_PERIOD_S,
            self.flush: _FLUSH_PERIOD_S,
        }
        due = dict.fromkeys(periods, 0.0)
        while not stop.is_set():
            self._polls += 1
            time.sleep(_POLL_PERIOD_S)
            self.drain()
            now = time.monotonic()
            for act, period in periods.items():
                if now >= due[act]:
                    due[act] = now + period
                    act()
        self._await_states()

    def _await_states(self) -> None:
        """Record until the states are complete, or until it is clear that none will be.

        Without a state, nothing in a bag that begins within a session can be computed again.
        """
        deadline = time.monotonic() + _STATE_TIMEOUT_S
        while self._expects_states() and time.monotonic() < deadline:
            time.sleep(_DISCOVERY_PERIOD_S)
            self.discover()
            self.drain()

    def _expects_states(self) -> bool:
        """Return whether a node publishes a state of which parts are still to come."""
        inputs = all(self.count_publishers(topic) for topic in self._inputs)
        offered = [t for t in self._states - self._unrecorded.keys() if self.count_publishers(t)]
        if not (inputs and offered):
            return time.monotonic() - self._begun < _DISCOVERY_TIMEOUT_S
        return any(topic not in self._complete_states for topic in offered)

    def _note_state(self, topic: str, data: bytes) -> None:
        """Note a part of a state; a state is complete when all its parts have been received."""
        try:
            state = deserialize_message(data, State)
        except RMWError:
            return  # it is recorded as it is, and is part of no state
        parts = self._parts.setdefault((topic, state.step), set())
        parts.add(state.part)
        if len(parts) == state.parts:
            self._complete_states.add(topic)

    def rest(self) -> None:
        """Record the received messages, and ignore later ones."""
        self.drain()
        self.flush()

    def _forget(self) -> None:
        """Drop the messages that came while the node was inactive: neither recorded nor lost."""
        for stream in self._streams.values():
            while stream.take(stream.message_type, True) is not None:
                pass
            stream.counter.pause()

    def discover(self) -> None:
        """Subscribe to topics that have got their first publisher since the last call.

        A subscription to states asks for one. It comes last: the frames after a state can only be
        computed again from their inputs.
        """
        early = not self._hears_inputs()
        for topic, types in self.get_topic_names_and_types():
            if early and topic in self._states:
                continue
            known = (self._streams, self._unrecorded, self._needless)
            if not any(topic in topics for topics in known):
                if topic == self._drawings:
                    self._needless[topic] = 'it is drawn from recorded topics'
                    continue
                self._start(topic, types[0])

    def _hears_inputs(self) -> bool:
        """Return whether the inputs of frames arrive, or have had the time to."""
        if time.monotonic() - self._begun > _INPUTS_TIMEOUT_S:
            return True
        streams = [self._streams.get(topic) for topic in self._inputs]
        return all(stream is not None and stream.counter.received > 0 for stream in streams)

    def review(self) -> None:
        """Check the nodes, and the publishers of recorded topics, anew."""
        self._collector.look()
        self.writer.describe(parameters=self._collector.text)
        for stream in self._streams.values():
            publishers = self.get_publishers_info_by_topic(stream.topic)
            weaker = [
                p.node_name for p in publishers if not is_compatible(p.qos_profile, stream.qos)
            ]
            if weaker and stream.topic not in self._unrecorded:
                self._give_up(
                    stream.topic,
                    f'{", ".join(weaker)} came later and offers a weaker QoS than those before',
                )

    def flush(self) -> None:
        """Hand the received messages to the operating system; log an error of the disk at once."""
        well = not self.writer.failure
        self.writer.flush()
        if well and self.writer.failure:
            self.get_logger().error(f'{self.writer.failure}: nothing is recorded from now on')

    def drain(self) -> None:
        """Take all received messages and write them in the order of arrival."""
        batch = []
        if step := self._steady.look():
            text = f'the clock of this computer was set by {step * 1e-9:+.3g} s'
            self.get_logger().warning(f'{text}: times in the bag are corrected for it')
        for stream in list(self._streams.values()):
            while (taken := stream.take(stream.message_type, True)) is not None:
                data, info = taken
                if len(data) > self.max_message:
                    text = f'{len(data)} bytes: {self.max_message} at most (parameter max_message)'
                    self.rejections.add(stream.topic, MessageError('too large', text))
                    stream.counter.add(info['publication_sequence_number'])
                    continue
                number = info['publication_sequence_number']
                stream.counter.add(number)
                if stream.topic in self._states - self._complete_states:
                    self._note_state(stream.topic, data)
                received = self._steady.of(info['received_timestamp'] or time.time_ns())
                batch.append((received, stream.topic, info['source_timestamp'], data, number))
        batch.sort(key=itemgetter(0))
        for received, topic, published, data, number in batch:
            self.writer.write(topic, received, published, data, number or 0)

    def release(self) -> None:
        """Take the last messages, complete the bag and report the counts."""
        self.writer.describe(parameters=self._collector.text)
        self.writer.close()
        self._report_accounts(self.accounts())
        if self.writer.failure:
            lost = sum(self.writer.lost.values())
            text = f'{self.writer.failure}: {lost} messages are not in the bag'
            announce(f'failed: {self.get_name()}: {text}')

    def _report_accounts(self, accounts: dict[str, Account]) -> None:
        """Log the counts of all messages, for the user or for the launcher."""
        tally = self.writer.tally
        if self._as_json:
            report = {
                'bag': str(self.writer.folder),
                'bytes': self.writer.size,
                'failure': self.writer.failure,
                'not_recorded': self._unrecorded | self._needless,
            }
            announce(f'message: {json.dumps(report)}')
            for topic, account in accounts.items():  # one by one: the length of a line is limited
                announce(f'message: {json.dumps({topic: asdict(account)})}')
            return
        print(
            f'recorded: {tally.messages} messages, {len(tally.counts)} topics, '
            f'{sum(account.lost for account in accounts.values())} lost, {self.writer.folder}',
            flush=True,
        )
        for topic, account in accounts.items():
            print(f'  {topic}: {account.sentence}', flush=True)
        for topic, reason in (self._unrecorded | self._needless).items():
            print(f'  not recorded: {topic}: {reason}', flush=True)

    def accounts(self) -> dict[str, Account]:
        """Return the counts of the messages of each topic so far."""
        written, refused = self.writer.tally.counts, self.writer.lost
        return {
            topic: Account(
                received=stream.counter.received,
                written=written.get(topic, 0),
                lost=stream.counter.lost + refused.get(topic, 0),
                missed=stream.counter.before,
            )
            for topic, stream in self._streams.copy().items()  # the loop may add one meanwhile
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
        profiles = dict.fromkeys(offered_qos(info.qos_profile, depth) for info in publishers)
        # rosbags looks up hashes of messages only, and rejects a bag that has any other.
        type_hash = str(publishers[0].topic_type_hash) if '/msg/' in type_name else ''
        self.writer.add_topic(topic, type_name, schema, type_hash, tuple(profiles))
        subscription = polled(self, message_type, topic, strongest_request(publishers))
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
        unrecorded = (self._unrecorded | self._needless).items()
        values |= {f'not recorded {topic}': reason for topic, reason in unrecorded}
        if self.writer.failure:
            return DiagnosticStatus.ERROR, self.writer.failure, values
        if totals['lost'] or self._unrecorded:
            return DiagnosticStatus.WARN, 'the bag is not whole', values
        return DiagnosticStatus.OK, 'recording', values


def main() -> None:
    """Run the node; exit status 1 where the disk did not take all messages."""
    recorder = run(Recorder)
    raise SystemExit(1 if recorder.writer.failure else 0)


def _custom_data(scene: str, seed: int) -> dict[str, str]:
    data = {'format_version': str(FORMAT_VERSION), 'seed': str(seed), **identity_here().flat()}
    for package in ('ros-jazzy-rclpy', 'rclpy', 'mcap'):
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


if __name__ == '__main__':
    main()
