"""Offered QoS as bags carry it: one object, from which both of its written forms are made.

A reader that finds the channel's profiles and those of metadata.yaml to differ in any field drops
the channel's messages without a word, so there is no other way here to write either.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import yaml

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
        lifespan: age after which a message is void [ns].
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
    """The list `offered_qos_profiles` of a topic in metadata.yaml."""
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
    """The same list as YAML text, for `offered_qos_profiles` in the metadata of an MCAP channel."""
    text: str = yaml.safe_dump(metadata_profiles(profiles), sort_keys=False)
    return text


def profiles_from(text: str) -> list[OfferedQos]:
    """What `channel_profiles` made a text of; depths and names as they are."""
    found = []
    for profile in yaml.safe_load(text) or []:
        values: dict[str, Any] = {name: profile[name] for name in _WORDS}
        values |= {name: _nanoseconds(profile[name]) for name in _DURATIONS}
        found.append(OfferedQos(**values))
    return found


def _nanoseconds(duration: dict[str, int]) -> int:
    return duration['sec'] * NANOSECONDS + duration['nsec']


def _seconds(duration: int) -> dict[str, int]:
    return {'sec': duration // NANOSECONDS, 'nsec': duration % NANOSECONDS}
