"""Messages to publish for a replay at each position; no ROS."""

import queue
import threading
from collections.abc import Collection, Iterator
from contextlib import suppress

import numpy as np

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import Bag, Recorded
from cutting_trainer.bags.topic_names import BUTTONS, MESH, POSE, UPDATES, of_session
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec, StampedMessage

_BATCH, _BATCHES = 500, 4
"""Messages that are read before they are due: 0.3 s of a session or more."""
_HALF_A_DIGIT_S = 0.0005
"""By which the duration of a bag is rounded where it is told [s]."""


class ReadAhead:
    """Reads messages in a thread of its own before they are due; call `close` at the end.

    A chunk of a bag takes some 20 ms to unpack: longer than a loop of 1 kHz can wait.

    Args:
        source: of the messages.
    """

    def __init__(self, source: Iterator[Recorded]) -> None:
        self._source = source
        self._batches: queue.Queue[list[Recorded]] = queue.Queue(_BATCHES)
        self._closed = threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Recorded]:
        while batch := self._batches.get():
            yield from batch
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Read no more."""
        self._closed.set()
        self._thread.join()

    def _read(self) -> None:
        batch: list[Recorded] = []
        try:
            for message in self._source:
                batch.append(message)
                if len(batch) == _BATCH:
                    self._put(batch)
                    batch = []
                if self._closed.is_set():
                    return
        except Exception as error:  # a damaged bag can raise any error of a parser
            self._failure = error
        if batch:
            self._put(batch)
        self._put([])

    def _put(self, batch: list[Recorded]) -> None:
        while not self._closed.is_set():
            with suppress(queue.Full):
                self._batches.put(batch, timeout=0.1)
                return


class RecordedStream:
    """Recorded messages in their order, for a playhead that moves forward; `close` it.

    Deltas of the mesh are left out until a keyframe has come: no subscriber could apply them.

    Args:
        bag: to read.
        topics: those to play.
        start: where to begin [s] from the first message of the bag.
    """

    def __init__(self, bag: Bag, topics: Collection[str], start: float) -> None:
        self._origin = first_time(bag)
        since = self._origin + round(start * 1e9)
        self._ahead = ReadAhead(bag.messages(topics, since=since if start else 0))
        self._messages = iter(self._ahead)
        self._next = next(self._messages, None)
        self._has_mesh = False

    def due(self, position: float) -> Iterator[Recorded]:
        """Yield the messages before a position [s] that have not been published yet."""
        until = self._origin + round(position * 1e9)
        while self._next is not None and self._next.log_time <= until:
            message, self._next = self._next, next(self._messages, None)
            self._has_mesh |= message.topic == MESH
            if self._has_mesh or message.topic != UPDATES:
                yield message

    def close(self) -> None:
        """Read no more."""
        self._ahead.close()


class RecordedHand:
    """The recorded path of the device, and its button events.

    Args:
        bag: to read.

    Raises:
        BagError: it has no poses.
    """

    def __init__(self, bag: Bag) -> None:
        codec, origin = PoseStampedCodec(), first_time(bag)
        recorded = list(bag.messages([of_session(POSE, bag.topics())]))
        if not recorded:
            raise BagError(f'{bag.path} has no message of {POSE}: there is no hand to follow')
        self._times = np.array([(m.log_time - origin) * 1e-9 for m in recorded])
        self._poses = [codec.decode(m.data) for m in recorded]
        names = {of_session(topic, bag.topics()): topic for topic in BUTTONS}
        events = list(bag.messages(names))
        self._event_times = np.array([(m.log_time - origin) * 1e-9 for m in events])
        self._events = [(names[m.topic], m.data) for m in events]

    def pose(self, position: float) -> StampedMessage:
        """Return the newest pose at a position [s], the first one before it."""
        at = int(np.searchsorted(self._times, position, 'right')) - 1
        return self._poses[max(at, 0)]

    def events(self, before: int, position: float) -> tuple[list[tuple[str, bytes]], int]:
        """Return the button events on the path to a position.

        Args:
            before: number of events that are done; after a step back only the last one counts.
            position: [s].

        Returns:
            The topics and messages as they were recorded, and the number of events done by then.
        """
        done = int(np.searchsorted(self._event_times, position, 'right'))
        return self._events[before if done >= before else max(done - 1, 0) : done], done

    @property
    def span(self) -> tuple[float, float]:
        """Return the positions of the first and the last pose [s]."""
        return float(self._times[0]), float(self._times[-1])


def first_time(bag: Bag) -> int:
    """Return the log time of the first message [ns since the epoch]."""
    if not bag.span[0]:
        raise BagError(f'{bag.path} has no message')
    return bag.span[0]


def duration(bag: Bag) -> float:
    """Return the time from the first message to the last [s]."""
    return (bag.span[1] - first_time(bag)) * 1e-9


def require_moment(bag: Bag, seconds: float) -> None:
    """Reject a moment [s] that a bag does not have.

    Raises:
        BagError: it is before the bag or after it.
    """
    end = duration(bag)
    if not 0.0 <= seconds <= end + _HALF_A_DIGIT_S:
        folder = bag.path if bag.path.is_dir() else bag.path.parent
        said = f'{folder} lasts from 0 to {end:.3f} s'
        raise BagError(f'{said}: there is no tissue at {seconds:g} s')
