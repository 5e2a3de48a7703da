"""Key figures of a session, from its bag alone."""

import math
import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cutting_trainer.session.bag_measurements import Evidence, Status

SETTLING_TIME_S = 1.0
"""Rates count from so long [s] after the first report of the last node."""
MAX_CONTACT_GAP_S = 0.1
"""Longest time [s] that a contact counts past its last message."""
FORCE_MARGIN_S = 0.02
"""Contact and force of one tick are recorded within this time [s]."""
RELEASE_TIME_S = 0.5
"""The force must be zero this long [s] after the last contact."""


@dataclass(frozen=True)
class NodeSummary:
    """Key figures of a node over the settled part of the session; NaN where it reports none.

    Attributes:
        name: name of the node.
        rate, lowest_rate: median and minimum of its reports [Hz].
        within, lowest_within: share of periods within half a period of the nominal one.
        period_p99, worst_period_p99: [s].
        lateness_p999: maximum of its reports [s].
        longest_period: longest period of its loop, from the beginning on [s].
        missed: number of missed deadlines.
        real_time: its sentence about real-time scheduling, empty if none.
        worst_level: worst level of its statuses, 0 OK to 3 STALE.
        message: sentence of its worst status.
    """

    name: str
    rate: float
    lowest_rate: float
    within: float
    lowest_within: float
    period_p99: float
    worst_period_p99: float
    lateness_p999: float
    longest_period: float
    missed: float
    real_time: str
    worst_level: int
    message: str

    @property
    def has_real_time(self) -> bool:
        """Whether it was granted real-time scheduling."""
        return 'granted' in self.real_time


@dataclass(frozen=True)
class Summary:
    """Key figures of a session.

    Attributes:
        bag: folder of the bag.
        complete: whether the bag was closed in order.
        duration: [s].
        nodes: nodes that reported, by name.
        contact_time: time in which the tool touched the tissue [s].
        largest_force: largest force commanded to the arm [N].
        force_before_contact: largest force before the first contact [N].
        force_after_contact: largest force [N] from `RELEASE_TIME_S` after the last contact on;
            None if the bag ends earlier.
        elements_cut: number of elements that the tissue reports as cut.
        messages: number of recorded messages.
        lost, missed: counts by topic, see `Evidence`.
    """

    bag: str
    complete: bool
    duration: float
    nodes: dict[str, NodeSummary]
    contact_time: float
    largest_force: float
    force_before_contact: float
    force_after_contact: float | None
    elements_cut: int
    messages: int
    lost: dict[str, int]
    missed: dict[str, int]

    def plain(self) -> dict[str, Any]:
        """Return the figures for JSON: NaN becomes None."""
        plain: dict[str, Any] = _without_nan(asdict(self))
        return plain


def summarise(evidence: Evidence) -> Summary:
    """Compute the summary of a session."""
    settled = _settled(evidence.statuses)
    names = sorted({status.node for status in evidence.statuses})
    contact = evidence.contacts[:, 1] > 0
    touched = evidence.contacts[contact, 0]
    steps = np.minimum(np.diff(evidence.contacts[:, 0]), MAX_CONTACT_GAP_S)
    return Summary(
        bag=str(evidence.bag),
        complete=evidence.complete,
        duration=evidence.duration,
        nodes={name: _node(name, evidence.statuses, settled) for name in names},
        contact_time=float(np.sum(steps, where=contact[:-1])),
        largest_force=_largest(evidence, -math.inf, math.inf) or 0.0,
        force_before_contact=_largest(
            evidence, -math.inf, (touched[0] if len(touched) else math.inf) - FORCE_MARGIN_S
        )
        or 0.0,
        force_after_contact=_largest(evidence, touched[-1] + RELEASE_TIME_S, math.inf)
        if len(touched)
        else None,
        elements_cut=_elements_cut(evidence.statuses),
        messages=sum(evidence.messages.values()),
        lost=evidence.lost,
        missed=evidence.missed,
    )


def _settled(statuses: Iterable[Status]) -> float:
    """Return the time `SETTLING_TIME_S` after the first report of the last node [s]."""
    first: dict[str, float] = {}
    for status in statuses:
        first.setdefault(status.node, status.time)
    return max(first.values(), default=0.0) + SETTLING_TIME_S


def _node(name: str, statuses: Iterable[Status], settled: float) -> NodeSummary:
    own = [status for status in statuses if status.node == name]
    late = [status for status in own if status.time > settled]
    worst = max(own, key=lambda status: status.level)

    def values(key: str) -> list[float]:
        return [v for s in late if not math.isnan(v := s.number(key))] or [math.nan]

    periods = [v for s in own if not math.isnan(v := s.number('period_max'))]
    before = [status.number('missed') for status in own if status.time <= settled]
    return NodeSummary(
        name=name,
        rate=statistics.median(values('rate')),
        lowest_rate=min(values('rate')),
        within=statistics.median(values('within')),
        lowest_within=min(values('within')),
        period_p99=statistics.median(values('period_p99')),
        worst_period_p99=max(values('period_p99')),
        lateness_p999=max(values('lateness_p999')),
        longest_period=max(periods, default=math.nan),
        missed=values('missed')[-1] - (before[-1] if before else 0.0),
        real_time=own[-1].values.get('real_time', ''),
        worst_level=worst.level,
        message=worst.message,
    )


def _largest(evidence: Evidence, start: float, end: float) -> float | None:
    """Return the largest force [N] in an interval of time [s], None where there is no sample."""
    times, norms = evidence.forces.T
    chosen = norms[(times >= start) & (times <= end)]
    return float(chosen.max()) if len(chosen) else None


def _elements_cut(statuses: Iterable[Status]) -> int:
    counts = [status.number('elements_cut') for status in statuses]
    return int(max((count for count in counts if not math.isnan(count)), default=0))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value
