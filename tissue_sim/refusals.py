"""What a node refuses: counted by topic and reason, said once a second, bounded whatever comes."""

from collections import Counter

MOST_REASONS = 64
"""Pairs of topic and reason that a node tells apart; what comes beyond is one more, `OTHERS`."""
MOST_SAID = 4
"""Reasons in one line of the log."""
LONGEST_SAID = 160
"""Characters of the newest sentence in it: it may quote the message."""
LONGEST_DETAIL, LONGEST_QUOTED = 300, 60
"""Characters of what is said of one message, and of what is quoted out of it: a frame_id may have
a hundred megabytes, and a reason goes to the log, /diagnostics and operating states."""
OTHERS = 'others'
TISSUE_FRAME = 'tissue'


class MessageError(ValueError):
    """A message that cannot be used.

    Args:
        reason: a short fixed phrase, without numbers: it is what is counted by.
        detail: which value is wrong, and what would be right; cut off at `LONGEST_DETAIL`.
    """

    def __init__(self, reason: str, detail: str = '') -> None:
        super().__init__(f'{reason}: {detail[:LONGEST_DETAIL]}' if detail else reason)
        self.reason = reason


class Refusals:
    """The one place where a node notes what it refused. Threads may share it."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._said: Counter[str] = Counter()
        self._newest = ''

    @property
    def total(self) -> int:
        """Messages refused in all."""
        return sum(self._counts.copy().values())

    def add(self, topic: str, why: Exception) -> None:
        """Notes a message.

        Args:
            topic: or service, by a name that does not come from the message.
            why: of anything but `MessageError`, its class is the reason.
        """
        reason = why.reason if isinstance(why, MessageError) else type(why).__name__
        key = f'{topic}: {reason}'
        if key not in self._counts and len(self._counts) >= MOST_REASONS:
            key = OTHERS
        self._counts[key] += 1
        self._newest = str(why)[:LONGEST_SAID]

    def values(self) -> dict[str, object]:
        """For /diagnostics: `refused TOPIC: REASON` and how often."""
        return {f'refused {key}': count for key, count in self._counts.copy().items()}

    def news(self) -> str:
        """What was refused since the last call, as one line for the log; '' if nothing was."""
        counts = self._counts.copy()
        since, self._said = counts - self._said, counts
        if not since:
            return ''
        told = [f'{key} ({count} times)' for key, count in since.most_common(MOST_SAID)]
        if len(since) > MOST_SAID:
            told.append(f'{len(since) - MOST_SAID} other reasons')
        newest = self._newest.encode('unicode_escape').decode()
        return f'refused {"; ".join(told)}; the last one: {newest}'


def quoted(text: str) -> str:
    """A string of a message in quotes, no more of it than a sentence needs."""
    if len(text) <= LONGEST_QUOTED:
        return repr(text)
    return f'{text[:LONGEST_QUOTED]!r}... ({len(text)} characters)'


def require_frame(topic: str, frame: str) -> None:
    """Refuses what is not in the tissue's frame.

    Raises:
        MessageError: it is in another.
    """
    if frame != TISSUE_FRAME:
        text = f'{topic} has the frame_id {quoted(frame)}, but forces are felt in {TISSUE_FRAME!r}'
        raise MessageError('wrong frame', text)
