"""QoS between the graph and a bag: what publishers offer, what the recorder asks for, and what a
replay offers again.
"""

from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from cutting_trainer.bags.recorded_qos import OfferedQos
from cutting_trainer.bags.topic_names import FORCES
from cutting_trainer.node_common.qos import EVENTS, LATCHED, STREAM, UPDATES
from cutting_trainer.node_common.ros import (
    ARM,
    CONTACT,
    DIAGNOSTICS,
    FORCE,
    FRAME_INPUTS,
    MESH,
    MESH_UPDATES,
)

QUEUE_DEPTH = 1000
"""Messages in the queue of a topic: a second of a 1 kHz stream, whatever depth a bag states."""
CONFIGURED = {
    MESH: LATCHED,
    MESH_UPDATES: UPDATES,
    FORCE: STREAM,
    FRAME_INPUTS: STREAM,
    CONTACT: STREAM,
    DIAGNOSTICS: EVENTS,
    f'{ARM}/measured_cp': STREAM,
    f'{ARM}/measured_cv': STREAM,
    f'{ARM}/measured_cf': STREAM,
    **{name[1:]: STREAM for name in FORCES},
    f'{ARM}/operating_state': LATCHED,
}
"""Depths of our publishers: the graph shows every other part of a QoS, but not its history."""


def offered_qos(profile: QoSProfile, depth: int) -> OfferedQos:
    """Return the QoS of a publisher as a bag has it; the graph does not show its depth."""
    return OfferedQos(
        depth=depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline=profile.deadline.nanoseconds,
        lifespan=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.name.lower(),
        liveliness_lease_duration=profile.liveliness_lease_duration.nanoseconds,
    )


def strongest_request(publishers: list[Any]) -> QoSProfile:
    """Return the strongest QoS that all of the publishers offer."""
    profiles = [info.qos_profile for info in publishers]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return _profile(QUEUE_DEPTH, reliable, latched)


def is_compatible(offered: QoSProfile, requested: QoSProfile) -> bool:
    """Return whether a publisher offers what a subscription requests."""
    reliable = offered.reliability == ReliabilityPolicy.RELIABLE
    latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return (reliable or requested.reliability == ReliabilityPolicy.BEST_EFFORT) and (
        latched or requested.durability == DurabilityPolicy.VOLATILE
    )


def publisher_qos(profiles: list[OfferedQos]) -> QoSProfile:
    """Return the QoS to play a topic with.

    It is compatible with every subscriber of the recorded publishers.
    """
    reliable = all(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.durability == 'transient_local' for profile in profiles) and profiles
    depth = min(max((profile.depth for profile in profiles), default=10), QUEUE_DEPTH)
    return _profile(depth, reliable, bool(latched))


def _profile(depth: int, reliable: bool, latched: bool) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
