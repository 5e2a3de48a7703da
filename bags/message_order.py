"""Messages of one topic in the order of sending, without duplicates.

A bag is ordered by the clock of its recorder, which may have been set back; sequence numbers of
publishers are not affected. A bag merged from others may have messages twice.
"""

from collections.abc import Iterator
from itertools import pairwise

from cutting_trainer.bags.reader import Bag, Recorded

_Key = tuple[int, int, int]


class Sequence:
    """The messages of one topic, in the order of sending.

    Args:
        bag: to read.
        topic: of `tissue_sim` or `cutting`: each has one publisher at a time.

    Attributes:
        doubled: number of messages that the bag has once more, byte for byte.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag, self._topic = bag, topic
        keys: set[_Key] = set()
        numbers = []
        self.doubled = 0
        for recorded in bag.messages([topic]):
            if (key := _key(recorded)) in keys:
                self.doubled += 1
            else:
                keys.add(key)
                numbers.append(recorded.sequence)
        rising = all(before < after for before, after in pairwise(numbers))
        # Numbers that come twice are from two processes: only the clock orders these.
        self._by_number = not rising and 0 not in numbers and len(set(numbers)) == len(numbers)

    def __iter__(self) -> Iterator[Recorded]:
        messages = self._once()
        return iter(sorted(messages, key=lambda m: m.sequence)) if self._by_number else messages

    def _once(self) -> Iterator[Recorded]:
        keys: set[_Key] = set()
        for recorded in self._bag.messages([self._topic]):
            if (key := _key(recorded)) not in keys:
                keys.add(key)
                yield recorded


def _key(recorded: Recorded) -> _Key:
    """Return a key that a message shares with its copies only."""
    return recorded.sequence, recorded.publish_time, hash(recorded.data)
