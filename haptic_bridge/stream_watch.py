"""What a stream of stamped messages gives away about its sender: two of them, a clock that jumps,
or a frame that changes.
"""

CLOCK_JUMP = 0.5
"""[s] by which stamps may move against the receiver's clock between two messages."""
MEMORY = 1.0
"""[s] in which numbers that go back twice are those of two senders; once is a restart."""
QUEUED = 3.0
"""[s] for which messages of a network may come late before it is the clock that was set back."""
FORGETTING = 0.3
"""[1/s] at which later messages than before move what counts as in time."""
LONGEST = 0.02
"""[s] since the message before that count for that: a burst out of a queue hardly moves it."""
_NANOSECONDS = 1_000_000_000


class StreamWatch:
    """Looks at one topic, message by message.

    Every publisher numbers its messages from 1 on. A receiver of two of them sees the numbers go
    back again and again; of one that has started again, once.

    Limitations: two publishers whose messages come so close together that only ever one of them is
    the newest are one to this; and an RMW that gives no numbers (0) hides them.

    Args:
        topic: for the sentences.
        queues: its messages may come over a network, and wait in queues there: stamps that fall
            back are late messages at first (`late`), and a clock that was set after `QUEUED` only.

    Attributes:
        late: the last message came more than `CLOCK_JUMP` later than is usual; use it for nothing.
        delay: by which the last message came later than is usual [ns]: it is older by that.
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
        """Takes note of a message.

        Args:
            number: that its publisher gave it; 0 where unknown.
            stamp_ns: in its header [ns]; 0 means invalid, and is not looked at.
            now_ns: monotonic clock of the receiver [ns].
            frame: `header.frame_id`.

        Returns:
            What is wrong, as a sentence; '' if nothing is.
        """
        changed = self._change(frame)
        return self._count(number, now_ns) or self._compare(stamp_ns, now_ns) or changed

    def cause(self, now_ns: int) -> str:
        """Why the stream cannot be trusted at this time [ns], '' if it can."""
        if self._two_seen is None or now_ns - self._two_seen > MEMORY * _NANOSECONDS:
            return ''
        return f'{self._topic} has more than one publisher: end all but one'

    def _count(self, number: int, now_ns: int) -> str:
        back = 0 < number <= self._number
        self._number = number
        if not back:
            return ''
        before, self._went_back = self._went_back, now_ns
        if before is None or now_ns - before > MEMORY * _NANOSECONDS:
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
        if self._queues and -CLOCK_JUMP <= jump < 0:
            share = FORGETTING * min((now_ns - self._seen) / _NANOSECONDS, LONGEST)
            self._offset = usual + round(share * (offset - usual))
        else:
            self._offset = offset
        self._seen = now_ns
        if abs(jump) <= CLOCK_JUMP:
            return ''
        return (
            f'the stamps of {self._topic} jumped by {jump:+.3g} s: its clock was set, '
            'or its messages wait in a queue'
        )

    def _falls_behind(self, jump: float, now_ns: int) -> bool:
        """Whether a message is late, and not yet for so long that the clock must have been set."""
        if jump >= -CLOCK_JUMP:
            self.late, self._late_since = False, None
            return False
        self.late = True
        if self._late_since is None:
            self._late_since = now_ns
        if now_ns - self._late_since <= QUEUED * _NANOSECONDS:
            return True
        self.late, self._late_since = False, None
        return False
