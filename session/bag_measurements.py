"""Measurements of a session, read from its bag."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.bags.message_loss import SequenceCounter
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.topic_names import (
    CONTACT,
    DIAGNOSTICS,
    SERVO_CF,
    further_tools,
    of_session,
)
from cutting_trainer.node_common.cdr_codec import ContactCodec, WrenchStampedCodec
from cutting_trainer.session.node_commands import MODULES

SHARED_TOPICS = (DIAGNOSTICS, '/parameter_events', '/rosout', '/haptic_bridge/e_stop')
"""Topics with one publisher per node, and so with several sequences of messages."""
NANOSECOND_S = 1e-9


@dataclass(frozen=True)
class Status:
    """One status of one node on /diagnostics.

    Attributes:
        time: time of recording [s].
        node: name of the node.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        message: sentence of the status.
        values: values as text, by key.
    """

    time: float
    node: str
    level: int
    message: str
    values: dict[str, str]

    def number(self, key: str) -> float:
        """Return a value as a number; NaN where there is none."""
        try:
            return float(self.values[key])
        except (KeyError, ValueError):
            return float('nan')


@dataclass
class Evidence:
    """Measurements of a bag. Times are times of recording, [s] since its first message.

    Attributes:
        bag: folder of the bag.
        complete: whether the bag was closed in order.
        duration: [s].
        contacts: time and contact flag of `tool/contact`, shape (n, 2).
        forces: time and norm [N] of `arm/servo_cf`, shape (m, 2).
        statuses: all statuses of /diagnostics.
        messages: number of messages, by topic.
        lost: number of messages missing after the first received one, by topic.
        missed: number of messages published before the first received one, by topic.
    """

    bag: Path
    complete: bool = True
    duration: float = 0.0
    contacts: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    forces: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    statuses: list[Status] = field(default_factory=list)
    messages: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    missed: dict[str, int] = field(default_factory=dict)


def read_evidence(folder: Path) -> Evidence:
    """Read the measurements of a bag in one pass.

    Raises:
        BagError: it is not a bag.
    """
    bag = open_bag(folder)
    evidence = Evidence(folder, complete=bag.complete)
    counters = _counters(bag)
    state, force = ContactCodec.fields['state'], WrenchStampedCodec.fields['force']
    contact_codec, wrench_codec = ContactCodec(), WrenchStampedCodec()
    contacts, forces = [], []
    servo_cf = of_session(SERVO_CF, bag.topics())
    start = end = 0
    for message in bag.messages():
        start = start or message.log_time
        end = max(end, message.log_time)
        time = (message.log_time - start) * NANOSECOND_S
        if message.sequence:
            counters[message.topic].add(message.sequence)
        evidence.messages[message.topic] = evidence.messages.get(message.topic, 0) + 1
        if message.topic == CONTACT:
            contacts.append((time, contact_codec.decode(message.data).values[state][0] != 0))
        elif message.topic == servo_cf:
            forces.append((time, np.linalg.norm(wrench_codec.decode(message.data).values[force])))
        elif message.topic == DIAGNOSTICS:
            evidence.statuses += _statuses(bag.read(message), time)
    evidence.duration = (end - start) * NANOSECOND_S
    evidence.contacts = np.array(contacts, float).reshape(-1, 2)
    evidence.forces = np.array(forces, float).reshape(-1, 2)
    evidence.lost = {topic: c.lost for topic, c in counters.items() if c.lost}
    evidence.missed = {topic: c.before for topic, c in counters.items() if c.before}
    return evidence


def lost_messages(bag: Bag) -> dict[str, int]:
    """Return the number of messages missing after the first received one, by topic, where any is.

    The memory for it does not grow with the session, unlike that of `read_evidence`.
    """
    counters = _counters(bag)
    for message in bag.messages():
        if message.sequence:
            counters[message.topic].add(message.sequence)
    return {topic: counter.lost for topic, counter in counters.items() if counter.lost}


def _counters(bag: Bag) -> dict[str, SequenceCounter]:
    nodes = len(MODULES) + 2 * len(further_tools(bag.topics()))
    return {t: SequenceCounter(partial(_count_publishers, t, nodes)) for t in bag.topics()}


def _count_publishers(topic: str, nodes: int) -> int:
    return nodes if topic in SHARED_TOPICS else 1


def _statuses(array: Any, time: float) -> list[Status]:
    return [
        Status(
            time,
            status.name,
            status.level,
            status.message,
            {value.key: value.value for value in status.values},
        )
        for status in array.status
    ]
