"""Counter of lost messages on one topic, from the publishers' sequence numbers."""

from collections.abc import Callable


class SequenceCounter:
    """Counts the messages of one topic that were published and not received.

    Messages carry only their number in a publisher's sequence, not the publisher. The sequences are
    distinguished by continuity; a number that continues none of them is a gap in the sequence
    closest below it, or the first message of a new publisher.

    Limitations: messages after the last received one of a publisher are not counted. With several
    publishers, a gap in one sequence that another one happens to fill is found only when that other
    one goes on; the count of losses is never too high.

    Args:
        count_publishers: returns the present number; called when a number continues no sequence.

    Attributes:
        publishers: largest known number of simultaneous publishers.
        received: number of received messages.
        lost: number of messages missing between two received ones.
        before: messages that publishers had sent before the first received one of theirs, or while
            the subscription was paused.
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
        """Exclude the messages up to the next received one from the count of losses."""
        self._excused = set(self._next)

    def add(self, number: int | None) -> None:
        """Count a message by its number.

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
