"""How the hand moved the tool in a session, by clutch and scale."""

from bisect import bisect_left
from collections.abc import Sequence

from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.topic_names import INDEXING
from cutting_trainer.haptic_bridge.indexing import Indexing


def recorded_indexings(bag: Bag, tool: str = '') -> list[Indexing]:
    """Return the indexings of a tool, in the order in which they held.

    Args:
        bag: to read; one recorded before there was a clutch has none.
        tool: its namespace with a slash before it; '': the first.
    """
    topic = f'{tool}{INDEXING}'
    if topic not in bag.topics():
        return []
    found = [Indexing.read(bag.read(recorded)) for recorded in bag.messages([topic])]
    return sorted(found, key=lambda indexing: indexing.after_ns)


def indexing_at(indexings: Sequence[Indexing], stamp_ns: int) -> Indexing | None:
    """Return the indexing that held for a device pose, by its stamp [ns].

    None: that of the scene.
    """
    at = bisect_left(indexings, stamp_ns, key=lambda indexing: indexing.after_ns)
    return indexings[at - 1] if at else None
