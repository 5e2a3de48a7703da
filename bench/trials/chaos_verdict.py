"""Checks of the safety and the recovery of a session under faults; a failure is a sentence."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from cutting_trainer.haptic_bridge.scene_schema import DeviceProfile

FaultKind = Literal['kill', 'freeze', 'end']
ARM_WATCHDOG_TIMEOUT_S = 0.03
"""The force of an arm ends within this time after the last command of its bridge."""
STALE_SIMULATION_TIMEOUT_S = 0.15
"""The force of a bridge ends within this time after the last message of the simulation."""
MAX_SLEW_INTERVAL_S = 5e-3
"""Longest time between two commands that counts for the slew limit."""
RESTART_TIMEOUT_S = 30.0
"""A dead node must be ready again within this time."""
END_TIMEOUT_S = 2.0
"""A node ends within this time after the request."""
MAX_RESIDUAL_FORCE_N = 1e-3


@dataclass(frozen=True)
class Fault:
    """Fault of a node.

    Attributes:
        kind: kind of the fault.
        node: name of the node.
        began, ended: [s] from and until when; a killed node's fault ends when it is ready again.
    """

    kind: FaultKind
    node: str
    began: float
    ended: float


@dataclass
class Observations:
    """Observations of a subscriber. Times are arrival times on one clock [s].

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


def force_failures(
    seen: Observations,
    faults: Sequence[Fault],
    profile: DeviceProfile,
    most_felt: float | None = None,
) -> list[str]:
    """Return failures of the safety of the hand.

    Args:
        seen: observations of the session.
        faults: in the order of their beginning.
        profile: limits of the device.
        most_felt: force limit of its motors [N], if others command them too; None: it
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


def lost_cuts(seen: Observations) -> list[str]:
    """Return the times when the number of cuts of the tissue decreased."""
    return [
        f'after {time:.1f} s the tissue had {after} changes by cuts, where it had had {before}'
        for (_, before), (time, after) in zip(seen.topologies, seen.topologies[1:], strict=False)
        if after < before
    ]


def not_recovered(faults: Iterable[Fault]) -> list[str]:
    """Return the nodes that did not recover in time."""
    return [
        f'{f.node} was not ready {RESTART_TIMEOUT_S:g} s after its {f.kind} at {f.began:.1f} s'
        for f in faults
        if f.ended - f.began > RESTART_TIMEOUT_S
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
    """Return commands beyond the slew limit, by their stamps; a step to zero is allowed."""
    order = rows[np.argsort(rows[:, 1], kind='stable')]
    steps = np.linalg.norm(np.diff(order[:, 2:], axis=0), axis=1)
    allowed = profile.max_slew * np.clip(np.diff(order[:, 1]), 1e-4, MAX_SLEW_INTERVAL_S) + 1e-3
    bad = (steps > allowed) & (_norms(order)[1:] > 0)
    if not bad.any():
        return []
    first = int(np.argmax(bad))
    return [
        f'servo_cf went {steps[first]:.3g} N further in {np.diff(order[:, 1])[first] * 1e3:.3g} ms '
        f'at {order[first + 1, 0]:.3f} s; {bad.sum()} times in all'
    ]


def _let_go(
    fault: Fault, seen: Observations, commanded: np.ndarray, felt: np.ndarray
) -> Iterable[str]:
    """Return failures of the force to end in time after its source."""
    if fault.node == 'haptic_bridge':
        rows, deadline, source, holder = felt, ARM_WATCHDOG_TIMEOUT_S, commanded[:, 0], 'the arm'
    elif fault.node == 'tissue_sim':
        rows, deadline, holder = commanded, STALE_SIMULATION_TIMEOUT_S, 'the bridge'
        source = np.array(seen.samples)
    else:
        return
    last = max(source[source <= fault.began], default=fault.began)
    # Start at the last message, which may have been in transit. A node that is asked to end goes
    # on until it receives the request.
    most = fault.began + (END_TIMEOUT_S if fault.kind == 'end' else 0.02)
    for word in source[(source > last) & (source < most)]:
        if word > max(last, fault.began) + deadline:
            break  # of the process that took its place
        last = word
    again = min(source[source > last + deadline], default=np.inf)
    late = _standstill(rows, fault.began, again)
    # The command that answers the first message after it may arrive before that message.
    early = _standstill(rows, again - 0.1, again)
    window = (rows[:, 0] > last + deadline + late) & (rows[:, 0] < again - early)
    if (_norms(rows[window]) > MAX_RESIDUAL_FORCE_N).any():
        worst = _norms(rows[window]).max()
        yield (
            f'{holder} held {worst:.2g} N more than {deadline * 1e3:g} ms '
            f'after the {fault.kind} of '
            f'{fault.node} at {fault.began:.2f} s'
        )


def _standstill(rows: np.ndarray, start: float, end: float) -> float:
    """Return the longest that the listener waited for a sample of a 1 kHz stream [s]: the
    scheduler's.
    """
    times = rows[(rows[:, 0] > start - 0.05) & (rows[:, 0] < min(end, start + 1.0)), 0]
    return 0.01 + float(np.diff(times).max(initial=0.0))


def _unasked(seen: Observations, faults: Sequence[Fault], commanded: np.ndarray) -> Iterable[str]:
    """Return forces of a restarted bridge that was not enabled."""
    norms = _norms(commanded)
    for fault in faults:
        if fault.node != 'haptic_bridge' or fault.kind == 'freeze':
            continue
        gone = fault.began + 0.1
        enabled = min((t for t in seen.enabled if t > gone), default=np.inf)
        window = (commanded[:, 0] > gone) & (commanded[:, 0] < enabled)
        if (norms[window] > MAX_RESIDUAL_FORCE_N).any():
            yield f'there was force unasked after the {fault.kind} of the bridge at {gone:.2f} s'
