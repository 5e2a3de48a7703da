"""Offered QoS of a topic, with its two written forms: channel metadata and metadata.yaml.

A reader that finds the two forms to differ in any field drops the channel's messages without a
word. Therefore both are written from one object.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.untrusted_yaml import load_yaml

NANOSECONDS = 1_000_000_000
INFINITE = 2**63 - 1
"""Duration [ns] that stands for "no limit" in ROS."""


@dataclass(frozen=True)
class OfferedQos:
    """QoS of one publisher, with the lowercase names of rosbag2's metadata version 9.

    Attributes:
        history: keep_last or keep_all.
        depth: samples kept under keep_last.
        reliability: reliable or best_effort.
        durability: volatile or transient_local.
        deadline: longest time between two messages [ns].
        lifespan: age after which a message expires [ns].
        liveliness: automatic or manual_by_topic.
        liveliness_lease_duration: silence after which a publisher counts as dead [ns].
    """

    history: str = 'keep_last'
    depth: int = 10
    reliability: str = 'reliable'
    durability: str = 'volatile'
    deadline: int = INFINITE
    lifespan: int = INFINITE
    liveliness: str = 'automatic'
    liveliness_lease_duration: int = INFINITE


_WORDS = ('history', 'depth', 'reliability', 'durability', 'liveliness')
_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')
Profiles = Sequence[OfferedQos]


def metadata_profiles(profiles: Profiles) -> list[dict[str, object]]:
    """Return the list `offered_qos_profiles` of a topic in metadata.yaml."""
    return [
        {
            'history': profile.history,
            'depth': profile.depth,
            'reliability': profile.reliability,
            'durability': profile.durability,
            'deadline': _seconds(profile.deadline),
            'lifespan': _seconds(profile.lifespan),
            'liveliness': profile.liveliness,
            'liveliness_lease_duration': _seconds(profile.liveliness_lease_duration),
            'avoid_ros_namespace_conventions': False,
        }
        for profile in profiles
    ]


def channel_profiles(profiles: Profiles) -> str:
    """Return the same list as YAML text, for the metadata of an MCAP channel.

    Its key there is `offered_qos_profiles`.
    """
    text: str = yaml.safe_dump(metadata_profiles(profiles), sort_keys=False)
    return text


def profiles_from(text: str) -> list[OfferedQos]:
    """Parse the text of `channel_profiles`; depths and names are taken as they are.

    Raises:
        BagError: the text is not valid.
    """
    where = 'offered_qos_profiles of a channel'
    found = []
    try:
        for profile in load_yaml(text, where) or []:
            values: dict[str, Any] = {name: profile[name] for name in _WORDS}
            values |= {name: _nanoseconds(profile[name]) for name in _DURATIONS}
            found.append(OfferedQos(**values))
    except (LookupError, TypeError) as error:
        raise BagError(f'{where}: no list of QoS profiles: {error}') from None
    return found


def _nanoseconds(duration: dict[str, int]) -> int:
    return duration['sec'] * NANOSECONDS + duration['nsec']


def _seconds(duration: int) -> dict[str, int]:
    return {'sec': duration // NANOSECONDS, 'nsec': duration % NANOSECONDS}
