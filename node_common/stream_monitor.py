"""Monitor of a stream of stamped messages: detects a second sender, a clock jump, a changed
frame.
"""

MAX_CLOCK_JUMP_S = 0.5
"""Largest movement of stamps against the receiver's clock between two messages."""
SENDER_MEMORY_S = 1.0
"""Window in which two backward steps of the numbers mean two senders; one is a restart."""
MAX_QUEUE_DELAY_S = 3.0
"""Time for which network messages may come late before the clock counts as set back."""
DELAY_DECAY_RATE = 0.3
"""[1/s] Rate at which later messages raise the reference for messages in time."""
MAX_INTERVAL_S = 0.02
"""Longest interval that counts for the reference: a burst out of a queue hardly moves it."""
_NANOSECONDS = 1_000_000_000


class StreamMonitor:
    """Monitors one topic, message by message.

    Every publisher numbers its messages from 1. With two publishers the numbers go back again and
    again; after a restart, once.

    Limitations: two publishers count as one if only one of them ever has the newest message. An
    RMW without sequence numbers (0) hides a second publisher.

    Args:
        topic: name in messages.
        queues: its messages may wait in queues of a network. Stamps that fall back then are late
            messages at first (`late`), and a clock that was set only after `MAX_QUEUE_DELAY_S`.

    Attributes:
        late: the last message was more than `MAX_CLOCK_JUMP_S` later than usual and must not be
            used.
        delay: lateness of the last message over the usual delay [ns]: its age is larger by that.
    """

    def __init__(self, topic: str, *, queues: bool = False) -> None:
        self.late = False
        self.delay = 0
        self._topic = topic
        self._queues = queues
        self._late_since: int | None = None
        self._number = 0
        self._went_back: int | None = None
        self._two_seen: int | None = None
        self._offset: int | None = None
        self._seen = 0
        self._frame: str | None = None

    def see(self, number: int, stamp_ns: int, now_ns: int, frame: str = '') -> str:
        """Record a message and return a sentence about an error, or ''.

        Args:
            number: sequence number of its publisher; 0 if unknown.
            stamp_ns: in its header [ns]; 0 is invalid and ignored.
            now_ns: monotonic clock of the receiver [ns].
            frame: `header.frame_id`.

        Returns:
            The error as a sentence, or ''.
        """
        changed = self._change(frame)
        return self._count(number, now_ns) or self._compare(stamp_ns, now_ns) or changed

    def cause(self, now_ns: int) -> str:
        """Return why the stream cannot be trusted at this time [ns], or ''."""
        if self._two_seen is None or now_ns - self._two_seen > SENDER_MEMORY_S * _NANOSECONDS:
            return ''
        return f'{self._topic} has more than one publisher: end all but one'

    def _count(self, number: int, now_ns: int) -> str:
        back = 0 < number <= self._number
        self._number = number
        if not back:
            return ''
        before, self._went_back = self._went_back, now_ns
        if before is None or now_ns - before > SENDER_MEMORY_S * _NANOSECONDS:
            return ''
        self._two_seen = now_ns
        return self.cause(now_ns)

    def _change(self, frame: str) -> str:
        before, self._frame = self._frame, frame
        if before is None or before == frame:
            return ''
        return f'the frame_id of {self._topic} changed from {before!r} to {frame!r}'

    def _compare(self, stamp_ns: int, now_ns: int) -> str:
        if stamp_ns == 0:
            return ''
        offset = stamp_ns - now_ns
        usual = offset if self._offset is None else self._offset
        self.delay = max(0, usual - offset)
        jump = (offset - usual) / _NANOSECONDS
        if self._queues and self._falls_behind(jump, now_ns):
            return ''
        if self._queues and -MAX_CLOCK_JUMP_S <= jump < 0:
            share = DELAY_DECAY_RATE * min((now_ns - self._seen) / _NANOSECONDS, MAX_INTERVAL_S)
            self._offset = usual + round(share * (offset - usual))
        else:
            self._offset = offset
        self._seen = now_ns
        if abs(jump) <= MAX_CLOCK_JUMP_S:
            return ''
        return (
            f'the stamps of {self._topic} jumped by {jump:+.3g} s: its clock was set, '
            'or its messages wait in a queue'
        )

    def _falls_behind(self, jump: float, now_ns: int) -> bool:
        """Return whether a message is late, but not so long that the clock must have been set."""
        if jump >= -MAX_CLOCK_JUMP_S:
            self.late, self._late_since = False, None
            return False
        self.late = True
        if self._late_since is None:
            self._late_since = now_ns
        if now_ns - self._late_since <= MAX_QUEUE_DELAY_S * _NANOSECONDS:
            return True
        self.late, self._late_since = False, None
        return False
