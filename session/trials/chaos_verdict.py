"""Was a session under faults safe, and did everything come back? Every "no" is a sentence."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from haptic_bridge.settings import DeviceProfile

FaultKind = Literal['kill', 'freeze', 'end']
WATCHDOG = 0.03
"""[s] in which an arm lets go that hears nothing from its bridge."""
STALE = 0.15
"""[s] in which a bridge lets go that hears nothing of the simulation."""
LONGEST_COUNTED = 5e-3
"""[s] between two commands that allow for a slew at most."""
BACK = 30.0
"""[s] in which a node that died has to be there again."""
LONGEST_END = 2.0
"""[s] in which a node that was asked to end does."""
NO_FORCE = 1e-3
"""[N]"""


@dataclass(frozen=True)
class Fault:
    """What was done to a node.

    Attributes:
        kind: of fault.
        node: its name.
        began, ended: [s] from and until when; a killed node's fault ends when it is ready again.
    """

    kind: FaultKind
    node: str
    began: float
    ended: float


@dataclass
class Witnessed:
    """What somebody who only listens has seen. Times are [s] of one clock, of the arrival.

    Attributes:
        commanded: time, stamp [s] and force [N] of each `servo_cf`, rows of 5.
        felt: time, stamp [s] and force [N] of each `measured_cf`, rows of 5.
        samples: times of `tissue/force`.
        enabled: times of the commands that enable the bridge.
        states: time and name of each operating state of the bridge.
        topologies: time and number of changes by cuts of each mesh message.
    """

    commanded: list[tuple[float, ...]] = field(default_factory=list)
    felt: list[tuple[float, ...]] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)
    enabled: list[float] = field(default_factory=list)
    states: list[tuple[float, str]] = field(default_factory=list)
    topologies: list[tuple[float, int]] = field(default_factory=list)


def unsafe(
    seen: Witnessed,
    faults: Sequence[Fault],
    profile: DeviceProfile,
    most_felt: float | None = None,
) -> list[str]:
    """What was not safe for the hand.

    Args:
        seen: of the session.
        faults: in the order of their beginning.
        profile: of the device: its limits.
        most_felt: what its motors have [N], where others than the bridge may command them; None: it
            is commanded by the bridge alone, and its limit holds.
    """
    commanded, felt = _rows(seen.commanded), _rows(seen.felt)
    return [
        *_limits('servo_cf', commanded, profile.max_force),
        *_limits('measured_cf', felt, most_felt or profile.max_force),
        *_slew(commanded, profile),
        *(s for fault in faults for s in _let_go(fault, seen, commanded, felt)),
        *_unasked(seen, faults, commanded),
    ]


def lost_cuts(seen: Witnessed) -> list[str]:
    """Where the tissue had fewer cuts than it had had."""
    return [
        f'after {time:.1f} s the tissue had {after} changes by cuts, where it had had {before}'
        for (_, before), (time, after) in zip(seen.topologies, seen.topologies[1:], strict=False)
        if after < before
    ]


def not_back(faults: Iterable[Fault]) -> list[str]:
    """Which nodes did not come back in time."""
    return [
        f'{f.node} was not there again {BACK:g} s after its {f.kind} at {f.began:.1f} s'
        for f in faults
        if f.ended - f.began > BACK
    ]


def _rows(rows: Sequence[tuple[float, ...]]) -> np.ndarray:
    return np.array(rows, float).reshape(-1, 5)


def _norms(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(rows[:, 2:], axis=1))


def _limits(topic: str, rows: np.ndarray, most: float) -> list[str]:
    found = []
    if not np.isfinite(rows[:, 2:]).all():
        found.append(f'{topic} had a force that is not finite')
    worst = float(_norms(rows).max(initial=0.0))
    if worst > most * (1 + 1e-9):
        found.append(f'{topic} had {worst:.3g} N, above the {most:g} N of the device')
    return found


def _slew(rows: np.ndarray, profile: DeviceProfile) -> list[str]:
    """Commands that differ too much from the one before, by their own stamps; zero is allowed."""
    order = rows[np.argsort(rows[:, 1], kind='stable')]
    steps = np.linalg.norm(np.diff(order[:, 2:], axis=0), axis=1)
    allowed = profile.max_slew * np.clip(np.diff(order[:, 1]), 1e-4, LONGEST_COUNTED) + 1e-3
    bad = (steps > allowed) & (_norms(order)[1:] > 0)
    if not bad.any():
        return []
    first = int(np.argmax(bad))
    return [
        f'servo_cf went {steps[first]:.3g} N further in {np.diff(order[:, 1])[first] * 1e3:.3g} ms '
        f'at {order[first + 1, 0]:.3f} s; {bad.sum()} times in all'
    ]


def _let_go(
    fault: Fault, seen: Witnessed, commanded: np.ndarray, felt: np.ndarray
) -> Iterable[str]:
    """Whether the force ended in time with what it came from."""
    if fault.node == 'haptic_bridge':
        rows, deadline, source, what = felt, WATCHDOG, commanded[:, 0], 'the arm'
    elif fault.node == 'tissue_sim':
        rows, deadline, what = commanded, STALE, 'the bridge'
        source = np.array(seen.samples)
    else:
        return
    last = max(source[source <= fault.began], default=fault.began)
    # From the last word that was still heard: it may have been on its way. Who is asked to end
    # goes on until it has heard of it.
    most = fault.began + (LONGEST_END if fault.kind == 'end' else 0.02)
    for word in source[(source > last) & (source < most)]:
        if word > max(last, fault.began) + deadline:
            break  # of the process that took its place
        last = word
    again = min(source[source > last + deadline], default=np.inf)
    late = _standstill(rows, fault.began, again)
    # Whoever commands by the first word after it may be heard before that word.
    early = _standstill(rows, again - 0.1, again)
    window = (rows[:, 0] > last + deadline + late) & (rows[:, 0] < again - early)
    if (_norms(rows[window]) > NO_FORCE).any():
        worst = _norms(rows[window]).max()
        yield (
            f'{what} held {worst:.2g} N more than {deadline * 1e3:g} ms after the {fault.kind} of '
            f'{fault.node} at {fault.began:.2f} s'
        )


def _standstill(rows: np.ndarray, start: float, end: float) -> float:
    """The longest that the listener waited for a sample of a 1 kHz stream [s]: the scheduler's."""
    times = rows[(rows[:, 0] > start - 0.05) & (rows[:, 0] < min(end, start + 1.0)), 0]
    return 0.01 + float(np.diff(times).max(initial=0.0))


def _unasked(seen: Witnessed, faults: Sequence[Fault], commanded: np.ndarray) -> Iterable[str]:
    """Forces of a new bridge that nobody has enabled."""
    norms = _norms(commanded)
    for fault in faults:
        if fault.node != 'haptic_bridge' or fault.kind == 'freeze':
            continue
        gone = fault.began + 0.1
        enabled = min((t for t in seen.enabled if t > gone), default=np.inf)
        window = (commanded[:, 0] > gone) & (commanded[:, 0] < enabled)
        if (norms[window] > NO_FORCE).any():
            yield f'there was force unasked after the {fault.kind} of the bridge at {gone:.2f} s'
