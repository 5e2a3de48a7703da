"""The ROS side of a replay: publishes what `bags.player` gives, and watches for live input."""

import math
import threading
import time
from collections.abc import Callable, Collection
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Joy

from bags.message_class import message_class
from bags.player import Playhead, RecordedHand, RecordedStream
from bags.qos import OfferedQos
from bags.reader import Bag
from bags.topics import BUTTON, OF_DEVICE, OF_TISSUE, POSE, REPLAYED, SERVO_CF
from haptic_bridge.operating_state import State, crtk_types
from haptic_bridge.wire import PoseStampedCodec, WrenchStampedCodec
from tissue_sim.ros import EVENTS, LATCHED, STREAM
from tissue_sim.timing import PeriodicLoop

_RATE = 1000.0
_DISCOVERY = 1.5
"""[s] in which publishers that are there are seen."""
_WATCH = 0.5
_ENABLING = {False: 30.0, True: 5.0}
"""[s] that the haptic bridge has to be enabled; in a FAULT, that it has to get out of it."""


def publisher_qos(profiles: list[OfferedQos]) -> QoSProfile:
    """The QoS to play a topic with: one that every subscriber of its publishers could take."""
    reliable = all(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.durability == 'transient_local' for profile in profiles) and profiles
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max((profile.depth for profile in profiles), default=10),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class Player(Node):
    """Plays in a thread of its own once `start` is called; use `stop` in the end.

    Args:
        context: of the domain to play into.
        playhead: where the replay is; others may pause and step it.

    Attributes:
        refusal: why the replay was stopped, '' while it may go on.
        faulted: where in the session [s] the haptic bridge came to a FAULT; None: it did not.
    """

    def __init__(self, context: Context, playhead: Playhead) -> None:
        super().__init__('player', context=context)
        self.playhead = playhead
        self.refusal = ''
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

    def refuse_live_input(self, topics: Collection[str]) -> None:
        """Looks whether somebody else publishes on some topics, and sets `refusal` if so."""
        time.sleep(_DISCOVERY)
        self._look(topics, 0)

    def start(self, before: Callable[[], object] = lambda: None) -> None:
        """Starts to play.

        Args:
            before: is called in the thread that plays, before it does.
        """
        self._before = before
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ends the replay."""
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(2.0)
        self.finish()
        self._executor.shutdown()
        self.destroy_node()

    def play(self, position: float) -> None:
        """Publishes what belongs to a position [s]."""
        raise NotImplementedError

    def finish(self) -> None:
        """Publishes what must not be left out at the end."""

    def watch(self, now: float) -> None:
        """Is called now and then, with the time [s] of `time.monotonic`."""

    def _look(self, topics: Collection[str], own: int) -> None:
        for topic in topics:
            publishers = self.get_publishers_info_by_topic(topic)
            others = [p for p in publishers if p.node_name != self.get_name()]
            if others or len(publishers) > max(own, 0):
                names = ', '.join(sorted({p.node_name for p in others})) or 'another replay'
                self.refusal = (
                    f'{names} publishes {topic}: a replay never mixes with live input; end the '
                    'other or replay in another domain (--domain free)'
                )
                return

    def _play(self) -> None:
        loop = PeriodicLoop(_RATE)
        self._before()
        loop.start()
        try:
            while not self._stop.is_set() and not self.refusal:
                loop.wait()
                self.play(self.playhead.move(time.monotonic()))
        except Exception as error:  # whatever a damaged bag makes a parser say
            self.refusal = f'the bag cannot be played further: {error}'

    def _serve(self) -> None:
        due = 0.0
        try:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=0.05)
                if (now := time.monotonic()) >= due:
                    due = now + _WATCH
                    self._look(self._watched, 1)
                    self.watch(now)
        except Exception as error:  # deaf, the replay would wait for ever
            if not self._stop.is_set():
                self.refusal = f'the replay cannot listen to the graph any more: {error}'


class SessionPlayer(Player):
    """Shows a session as it was recorded: mesh, forces, contact and device.

    Args:
        context: of the domain to play into.
        playhead: where the replay is.
        bag: to play.
        start: where each round begins [s].
        drive_device: play the recorded force to a live device, and leave its own topics to it.
    """

    def __init__(
        self, context: Context, playhead: Playhead, bag: Bag, start: float, *, drive_device: bool
    ) -> None:
        super().__init__(context, playhead)
        self._bag, self._start = bag, start
        wanted = (*OF_TISSUE, SERVO_CF) if drive_device else (*OF_TISSUE, *OF_DEVICE, BUTTON)
        self.topics = [topic for topic in wanted if topic in bag.topics()]
        self._wrench = WrenchStampedCodec('arm_base')
        self._stream = RecordedStream(bag, self.topics, start)
        self._rounds = 0

    def advertise(self) -> None:
        """Makes the publishers."""
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
            if message.topic == SERVO_CF:
                values = self._wrench.decode(data).values
                data = self._wrench.encode(time.time_ns(), values)
            self._publishers_by_topic[message.topic].publish(data)

    def finish(self) -> None:
        self._stream.close()
        if SERVO_CF in self.topics and hasattr(self, '_publishers_by_topic'):
            zero = self._wrench.encode(time.time_ns(), (0.0,) * 6)
            self._publishers_by_topic[SERVO_CF].publish(zero)


class HandPlayer(Player):
    """Is the device of a session: publishes its recorded poses anew, a thousand times a second.

    Its button does what it did, when it did. The hand waits at the first pose until the haptic
    bridge is enabled; a pause holds it still. When the bridge comes to a FAULT, or never gets out
    of one, the hand stays where it is.

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
        """Makes the publishers."""
        self._poses = self.create_publisher(PoseStamped, f'{REPLAYED}{POSE}', STREAM)
        self._button = self.create_publisher(Joy, f'{REPLAYED}{BUTTON}', EVENTS)
        self._watched = [f'{REPLAYED}{POSE}', f'{REPLAYED}{BUTTON}']
        self.create_subscription(
            crtk_types().operating_state, '/haptic_bridge/operating_state', self._heard, LATCHED
        )

    def play(self, position: float) -> None:
        values = self._hand.pose(position).values
        self._poses.publish(self._codec.encode(time.time_ns(), values))
        events, done = self._hand.events(self._events, position)
        # Before the bridge is enabled an event would be lost on a bridge that does not listen yet.
        if done != self._events and (self._begun or self._button.get_subscription_count()):
            self._events = done
            for data in events:
                self._button.publish(data)

    def watch(self, now: float) -> None:
        """Gives up a bridge that is not enabled: it may have been so, too shortly to be heard."""
        if self._since == math.inf:
            self._since = now
        if not self._begun and now - self._since > _ENABLING[self._state == State.FAULT]:
            if self._state == State.FAULT:
                self.faulted = self.playhead.position
            else:
                said = self._state or 'nothing about its state'
                self.refusal = f'the haptic bridge was not enabled within 30 s, it says {said}'

    def _heard(self, message: Any) -> None:
        if message.state != self._state:
            self._state, self._since = message.state, time.monotonic()
        if not self._begun and message.state in (State.ENABLED, State.PAUSED):
            self._begun = True
            self.playhead.go()
        elif self._begun and self.faulted is None and message.state == State.FAULT:
            self.faulted = self.playhead.position
