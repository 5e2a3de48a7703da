"""Rejected messages of a node: counted by topic and reason, logged once a second, and bounded."""

from collections import Counter

MAX_REASONS = 64
"""Pairs of topic and reason that are counted separately; further pairs count as `OTHER_REASONS`."""
MAX_LOGGED_REASONS = 4
"""Reasons in one line of the log."""
MAX_REASON_LENGTH = 160
"""Characters of the newest sentence in a log line: it may quote the message."""
MAX_DETAIL_LENGTH, MAX_QUOTED_LENGTH = 300, 60
"""Characters of a sentence about a message, and of a quotation from it. A frame_id may have a
hundred megabytes, and reasons go to the log, /diagnostics and operating states."""
OTHER_REASONS = 'others'
TISSUE_FRAME = 'tissue'
MAX_TOOLS = 4
"""Largest number of tools in a scene. Messages name theirs by its place in the list, from 0."""


class MessageError(ValueError):
    """A message that cannot be used.

    Args:
        reason: a short fixed phrase without numbers: the key of the statistics.
        detail: the wrong value and the right one; cut off at `MAX_DETAIL_LENGTH`.
    """

    def __init__(self, reason: str, detail: str = '') -> None:
        super().__init__(f'{reason}: {detail[:MAX_DETAIL_LENGTH]}' if detail else reason)
        self.reason = reason


class RejectionStatistics:
    """Statistics of the messages that a node rejected; thread-safe."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._said: Counter[str] = Counter()
        self._newest = ''

    @property
    def total(self) -> int:
        """Number of rejected messages."""
        return sum(self._counts.copy().values())

    def add(self, topic: str, why: Exception) -> None:
        """Count a rejected message.

        Args:
            topic: topic or service, by a name that does not come from the message.
            why: its error; for other classes than `MessageError`, the class name is the reason.
        """
        reason = why.reason if isinstance(why, MessageError) else type(why).__name__
        key = f'{topic}: {reason}'
        if key not in self._counts and len(self._counts) >= MAX_REASONS:
            key = OTHER_REASONS
        self._counts[key] += 1
        self._newest = str(why)[:MAX_REASON_LENGTH]

    def values(self) -> dict[str, object]:
        """Return `refused TOPIC: REASON` and its count, for /diagnostics."""
        return {f'refused {key}': count for key, count in self._counts.copy().items()}

    def news(self) -> str:
        """Return one log line about the messages rejected since the last call, or ''."""
        counts = self._counts.copy()
        since, self._said = counts - self._said, counts
        if not since:
            return ''
        told = [f'{key} ({count} times)' for key, count in since.most_common(MAX_LOGGED_REASONS)]
        if len(since) > MAX_LOGGED_REASONS:
            told.append(f'{len(since) - MAX_LOGGED_REASONS} other reasons')
        newest = self._newest.encode('unicode_escape').decode()
        return f'refused {"; ".join(told)}; the last one: {newest}'


def quoted(text: str) -> str:
    """Return a string of a message in quotes, shortened for a sentence."""
    if len(text) <= MAX_QUOTED_LENGTH:
        return repr(text)
    return f'{text[:MAX_QUOTED_LENGTH]!r}... ({len(text)} characters)'


def require_frame(topic: str, frame: str) -> None:
    """Refuse a message that is not in the tissue's frame.

    Raises:
        MessageError: it is in another.
    """
    if frame != TISSUE_FRAME:
        text = f'{topic} has the frame_id {quoted(frame)}, but forces are felt in {TISSUE_FRAME!r}'
        raise MessageError('wrong frame', text)


def require_tool(name: str, tool: float, own: int | None = None, count: int = MAX_TOOLS) -> None:
    """Raise if a message is about a tool that the scene lacks, or about another than its topic's.

    Args:
        name: of the message.
        tool: number in it.
        own: number of the tool that the topic belongs to; None: any.
        count: number of tools of the scene, where it is known.

    Raises:
        MessageError: the reason and the number.
    """
    if tool >= count:
        has = f'a scene has {count} at most' if count == MAX_TOOLS else f'the scene has {count}'
        text = f'tool {tool:g} of {name}: {has}, from 0'
        raise MessageError('no such tool', text)
    if own is not None and tool != own:
        raise MessageError('no such tool', f'tool {tool:g} of {name}: its topic is of tool {own}')
