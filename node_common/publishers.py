"""Monitoring of a topic's publishers by the ROS graph: a second publisher is reported by name."""

from collections.abc import Collection, Iterable
from typing import NamedTuple

from rclpy.node import Node

LEASE_TIMEOUT_S = 25.0
"""Time that a dead node may remain in the graph beside its replacement. It is longer than the
leases in config/dds, and than the 20 s of a driver with the middleware's own settings."""
NAME_TIMEOUT_S = 1.0
"""Time until the graph knows the name of a node whose publisher it lists."""
NAME_QUERY_PERIOD_S = 0.2
"""Period at which the name of a single publisher is queried: another node may have replaced it."""
_UNKNOWN = '_UNKNOWN_'


class Publisher(NamedTuple):
    """One publisher of a topic.

    Attributes:
        gid: unique identifier.
        name: of its node, with the namespace; '' where the graph does not know it (yet).
    """

    gid: bytes
    name: str


class PublisherList:
    """Checks the publishers of one topic.

    Two publishers of the same name are a dead node and its replacement, for `LEASE_TIMEOUT_S`.

    Args:
        topic: name in messages.
        accepted: names of nodes that may publish it; empty: any one node, the first.
    """

    def __init__(self, topic: str, accepted: Collection[str] = ()) -> None:
        self._topic = topic
        self._accepted = accepted
        self._seen: dict[bytes, float] = {}

    def judge(self, publishers: Iterable[Publisher], now: float) -> str:
        """Return a sentence about unexpected publishers, or ''.

        Args:
            publishers: as the graph lists them.
            now: monotonic clock [s].
        """
        there = {p.gid: p.name for p in publishers}
        self._seen = {gid: self._seen.get(gid, now) for gid in there}
        names: dict[str, list[float]] = {}
        for gid in sorted(there, key=lambda gid: (self._seen[gid], gid)):
            if there[gid] or now - self._seen[gid] > NAME_TIMEOUT_S:
                names.setdefault(there[gid] or 'a node without a name', []).append(self._seen[gid])
        return self._strangers(names) or self._twins(names, now)

    def _strangers(self, names: dict[str, list[float]]) -> str:
        if self._accepted:
            strangers = [name for name in names if name not in self._accepted]
            if strangers:
                known = ', '.join(sorted(self._accepted))
                return f'{self._topic} is published by {_listed(strangers)}: accepted is {known}'
        elif len(names) > 1:
            first, *others = names
            return (
                f'{self._topic} has more than one publisher: beside {first} there is '
                f'{_listed(others)}: end all but one'
            )
        return ''

    def _twins(self, names: dict[str, list[float]], now: float) -> str:
        for name, seen in names.items():
            if len(seen) > 1 and now - sorted(seen)[1] > LEASE_TIMEOUT_S:
                return f'{self._topic} has more than one publisher: {name} twice: end all but one'
        return ''


class PublisherMonitor:
    """Monitors the publishers of some topics; `look` is cheap enough for every 20 ms.

    Args:
        node: whose graph is asked.
        topics: that must have one publisher each, without the namespace.
        accepted: see `PublisherList`.

    Attributes:
        cause: sentence about unexpected publishers, or ''.
    """

    def __init__(self, node: Node, topics: Iterable[str], accepted: Collection[str] = ()) -> None:
        self.cause = ''
        self._node = node
        self._lists = {
            node.resolve_topic_name(topic): PublisherList(topic, accepted) for topic in topics
        }
        self._counts = dict.fromkeys(self._lists, 0)
        self._asked = dict.fromkeys(self._lists, 0.0)
        self._there: dict[str, list[Publisher]] = {}

    def look(self, now: float) -> str:
        """Update and return the cause at a time of the monotonic clock [s]."""
        causes = [self._judge(topic, now) for topic in self._lists]
        self.cause = next(filter(None, causes), '')
        return self.cause

    def _judge(self, topic: str, now: float) -> str:
        count = self._node.handle.get_count_publishers(topic)  # its name is resolved already
        known = count == self._counts[topic] and now - self._asked[topic] < NAME_QUERY_PERIOD_S
        if not known:  # the query is expensive, and grows with each publisher
            self._counts[topic], self._asked[topic] = count, now
            infos = self._node.get_publishers_info_by_topic(topic)
            self._there[topic] = [Publisher(bytes(i.endpoint_gid), full_name(i)) for i in infos]
        return self._lists[topic].judge(self._there[topic], now)


def full_name(info: object) -> str:
    """Return the name of an endpoint's node with its namespace, or '' if unknown."""
    name, namespace = str(info.node_name), str(info.node_namespace)  # type: ignore[attr-defined]
    if not name or _UNKNOWN in name:
        return ''
    return f'{namespace.rstrip("/")}/{name}'


def _listed(names: Collection[str]) -> str:
    return ' and '.join(repr(name)[1:-1][:128] for name in names)
