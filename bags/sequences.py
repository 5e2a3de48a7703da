"""Losses on one topic, from the sequence numbers that its publishers give their messages."""

from collections.abc import Callable


class SequenceCounter:
    """Counts the messages of one topic that were published and never came.

    Messages do not say which publisher they are from, only their number in its sequence. The
    publishers' sequences are told apart by continuity; when a number continues none of them, it is
    a gap in the sequence closest below it, or the first one heard of a new publisher.

    Limitations: what a publisher sent after the last message that came is not seen. With several
    publishers, a gap in one sequence that another happens to fill is seen only when that other one
    goes on; the count of losses is never too high.

    Args:
        count_publishers: how many the topic has now; asked when a number continues no sequence.

    Attributes:
        publishers: how many the topic is known to have had at once.
        received: messages that came.
        lost: messages missing between two that came.
        before: messages that publishers had sent before the first that came of theirs, or while
            nobody listened.
    """

    def __init__(self, count_publishers: Callable[[], int] = lambda: 1) -> None:
        self._count_publishers = count_publishers
        self.publishers = 1
        self.received = 0
        self.lost = 0
        self.before = 0
        self._next: list[int] = []
        self._excused: set[int] = set()

    def pause(self) -> None:
        """What is sent from now on to the next message that comes was not to be heard."""
        self._excused = set(self._next)

    def add(self, number: int | None) -> None:
        """Takes a message by its number.

        Args:
            number: 1 for the first of its publisher; None where the middleware has no numbers.
        """
        self.received += 1
        if number is None:
            return
        try:
            self._next[self._next.index(number)] = number + 1
        except ValueError:
            self._add_discontinuous(number)

    def _add_discontinuous(self, number: int) -> None:
        self.publishers = max(self.publishers, self._count_publishers())
        below = [expected for expected in self._next if expected < number]
        if number == 1 or not below or len(self._next) < self.publishers:
            self.before += number - 1
            self._next.append(number + 1)
        else:
            nearest = max(below)
            if nearest in self._excused:
                self.before += number - nearest
                self._excused.discard(nearest)
            else:
                self.lost += number - nearest
            self._next[self._next.index(nearest)] = number + 1
