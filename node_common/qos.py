"""QoS profiles of all nodes: kinds of streams and the depth of their queues."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _reliable(depth: int, *, latched: bool = False) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


STREAM = _reliable(500)
"""Publishers of streams. The queue is deep: a recorder loses nothing in a short pause."""
NEWEST_BEST_EFFORT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
"""Subscribers that use only the newest sample; a late one is worthless."""
LATCHED = _reliable(1, latched=True)
UPDATES = _reliable(150)
"""Five seconds of deltas: a link may fail for so long without loss."""
EVENTS = _reliable(10)
HISTORY = _reliable(1000, latched=True)
"""Rare messages that every later subscriber must get, all of them."""
