"""ROS side of a replay: publishes messages as they are due, and watches for live input."""

import math
import threading
import time
from collections.abc import Callable, Collection
from typing import Any

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Joy

from cutting_trainer.bags.message_class import message_class
from cutting_trainer.bags.metadata import FORMAT_VERSION
from cutting_trainer.bags.playback_control import Playhead
from cutting_trainer.bags.playback_messages import RecordedHand, RecordedStream
from cutting_trainer.bags.qos_adaptation import publisher_qos
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.topic_names import (
    BUTTONS,
    CONTACT,
    FORCE,
    FORCES,
    INDEXING,
    MESH,
    OF_DEVICE,
    OF_TISSUE,
    POSE,
    REPLAYED,
    UPDATES,
)
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.operating_state import CrtkState, crtk_types
from cutting_trainer.node_common.qos import EVENTS, LATCHED, NEWEST_BEST_EFFORT, STREAM
from cutting_trainer.node_common.ros import FRAME, polled
from cutting_trainer.node_common.timing import PeriodicLoop

_RATE_HZ = 1000.0
_DISCOVERY_S = 1.5
"""[s] in which existing publishers are discovered."""
_WATCH_PERIOD_S = 0.5
_ENABLE_TIMEOUTS_S = {False: 30.0, True: 5.0}
"""[s] in which the haptic bridge must be enabled; after a FAULT, in which it must recover."""


class Player(Node):
    """Plays in a thread of its own once `start` is called; call `stop` at the end.

    Args:
        context: of the domain to play into.
        playhead: position of the replay; others may pause and step it.

    Attributes:
        stop_reason: why the replay was stopped, '' while it may go on.
        faulted: position [s] at which the haptic bridge entered FAULT; None: it did not.
    """

    def __init__(self, context: Context, playhead: Playhead) -> None:
        super().__init__('player', context=context)
        self.playhead = playhead
        self.stop_reason = ''
        self.faulted: float | None = None
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self)
        self._stop = threading.Event()
        self._before: Callable[[], object] = lambda: None
        self._threads = [
            threading.Thread(target=self._play, daemon=True),
            threading.Thread(target=self._serve, daemon=True),
        ]
        self._watched: list[str] = []

    def reject_live_input(self, topics: Collection[str]) -> None:
        """Set `stop_reason` if another node publishes on one of the topics."""
        time.sleep(_DISCOVERY_S)
        self._look(topics, 0)

    def start(self, before: Callable[[], object] = lambda: None) -> None:
        """Start to play.

        Args:
            before: called in the playing thread first.
        """
        self._before = before
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the replay."""
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(2.0)
        self.finish()
        self._executor.shutdown()
        self.destroy_node()

    def play(self, position: float) -> None:
        """Publish the messages up to a position [s]."""
        raise NotImplementedError

    def finish(self) -> None:
        """Publish the messages that must not be left out at the end."""

    def watch(self, now: float) -> None:
        """Check the graph; called now and then, with the time [s] of `time.monotonic`."""

    def _look(self, topics: Collection[str], own: int) -> None:
        for topic in topics:
            publishers = self.get_publishers_info_by_topic(topic)
            others = [p for p in publishers if p.node_name != self.get_name()]
            if others or len(publishers) > max(own, 0):
                names = ', '.join(sorted({p.node_name for p in others})) or 'another replay'
                self.stop_reason = (
                    f'{names} publishes {topic}: a replay never mixes with live input; end the '
                    'other or replay in another domain (--domain free)'
                )
                return

    def _play(self) -> None:
        loop = PeriodicLoop(_RATE_HZ)
        self._before()
        loop.start()
        try:
            while not self._stop.is_set() and not self.stop_reason:
                loop.wait()
                self.play(self.playhead.move(time.monotonic()))
        except Exception as error:  # a damaged bag can raise any error of a parser
            self.stop_reason = f'the bag cannot be played further: {error}'

    def _serve(self) -> None:
        due = 0.0
        try:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=0.05)
                if (now := time.monotonic()) >= due:
                    due = now + _WATCH_PERIOD_S
                    self._look(self._watched, 1)
                    self.watch(now)
        except Exception as error:  # without the graph, the replay would wait for ever
            if not self._stop.is_set():
                self.stop_reason = f'the replay cannot listen to the graph any more: {error}'


class SessionPlayer(Player):
    """Publishes a session as recorded: mesh, forces, contact and device.

    Args:
        context: of the domain to play into.
        playhead: position of the replay.
        bag: to play.
        start: beginning of each round [s].
        drive_device: play the recorded force to a live device, and leave its own topics to it.
    """

    def __init__(
        self, context: Context, playhead: Playhead, bag: Bag, start: float, *, drive_device: bool
    ) -> None:
        super().__init__(context, playhead)
        self._bag, self._start = bag, start
        wanted = (
            (*OF_TISSUE, *FORCES) if drive_device else (*OF_TISSUE, INDEXING, *OF_DEVICE, *BUTTONS)
        )
        self.topics = [topic for topic in wanted if topic in bag.topics()]
        self._wrench = WrenchStampedCodec('arm_base')
        self._grown: dict[str, StampedCodec] = {}
        self._listed: tuple[str, ...] = ()
        if int(bag.custom_data.get('format_version', FORMAT_VERSION)) < FORMAT_VERSION:
            # Their fields that an older bag lacks are added.
            self._grown = {CONTACT: ContactCodec(FRAME), FORCE: ForceSampleCodec(FRAME)}
            self._listed = (MESH, UPDATES)
        self._stream = RecordedStream(bag, self.topics, start)
        self._rounds = 0

    def advertise(self) -> None:
        """Create the publishers."""
        self._publishers_by_topic = {
            topic: self.create_publisher(
                message_class(self._bag.topics()[topic]),
                topic,
                publisher_qos(self._bag.profiles(topic)),
            )
            for topic in self.topics
        }
        self._watched = self.topics

    def play(self, position: float) -> None:
        if self.playhead.rounds != self._rounds:
            self._rounds = self.playhead.rounds
            self._stream.close()
            self._stream = RecordedStream(self._bag, self.topics, self._start)
        for message in self._stream.due(position):
            data = message.data
            if message.topic in FORCES:
                values = self._wrench.decode(data).values
                data = self._wrench.encode(time.time_ns(), values)
            elif codec := self._grown.get(message.topic):
                sample = codec.decode(data)
                data = codec.encode(sample.stamp_ns, sample.values)
            elif message.topic in self._listed:
                data = data + bytes(-len(data) % 4 + 4)  # an empty list of regions, aligned
            self._publishers_by_topic[message.topic].publish(data)

    def finish(self) -> None:
        self._stream.close()
        for topic, publisher in getattr(self, '_publishers_by_topic', {}).items():
            if topic in FORCES:
                publisher.publish(self._wrench.encode(time.time_ns(), (0.0,) * 6))


class HandPlayer(Player):
    """Acts as the device of a session: publishes its recorded poses anew at 1 kHz.

    Its button events are published at their times. The hand waits at the first pose until the
    haptic bridge is enabled; a pause holds it still. When the bridge enters FAULT, or does not
    leave it, the hand stays at its place.

    Args:
        context: of the domain to play into.
        playhead: where the replay is.
        hand: the recorded poses.
    """

    def __init__(self, context: Context, playhead: Playhead, hand: RecordedHand) -> None:
        super().__init__(context, playhead)
        self._hand = hand
        self._codec = PoseStampedCodec(hand.pose(0.0).frame_id)
        self._begun = False
        self._state, self._since = '', math.inf
        self._events = 0

    def advertise(self) -> None:
        """Create the publishers."""
        self._poses = self.create_publisher(PoseStamped, f'{REPLAYED}{POSE}', STREAM)
        self._buttons = {
            topic: self.create_publisher(Joy, f'{REPLAYED}{topic}', EVENTS) for topic in BUTTONS
        }
        self._watched = [f'{REPLAYED}{topic}' for topic in (POSE, *BUTTONS)]
        # The bridge commands no force without a device that takes it.
        self._forces = [
            polled(self, WrenchStamped, f'{REPLAYED}{force}', NEWEST_BEST_EFFORT)
            for force in FORCES
        ]
        self.create_subscription(
            crtk_types().operating_state, '/haptic_bridge/operating_state', self._heard, LATCHED
        )

    def play(self, position: float) -> None:
        values = self._hand.pose(position).values
        self._poses.publish(self._codec.encode(time.time_ns(), values))
        events, done = self._hand.events(self._events, position)
        # A bridge that is not enabled may not listen yet: an event would be lost.
        if done != self._events and (self._begun or self._is_heard(BUTTONS[0])):
            self._events = done
            for topic, data in events:
                self._buttons[topic].publish(data)

    def _is_heard(self, topic: str) -> bool:
        return bool(self._buttons[topic].get_subscription_count())

    def watch(self, now: float) -> None:
        """Stop for a bridge that is not enabled; it may have been so too briefly to be seen."""
        if self._since == math.inf:
            self._since = now
        if (
            not self._begun
            and now - self._since > _ENABLE_TIMEOUTS_S[self._state == CrtkState.FAULT]
        ):
            if self._state == CrtkState.FAULT:
                self.faulted = self.playhead.position
            else:
                said = self._state or 'nothing about its state'
                self.stop_reason = f'the haptic bridge was not enabled within 30 s, it says {said}'

    def _heard(self, message: Any) -> None:
        if message.state != self._state:
            self._state, self._since = message.state, time.monotonic()
        if not self._begun and message.state in (CrtkState.ENABLED, CrtkState.PAUSED):
            self._begun = True
            self.playhead.go()
        elif self._begun and self.faulted is None and message.state == CrtkState.FAULT:
            self.faulted = self.playhead.position
