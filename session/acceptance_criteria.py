"""Comparison of a session with the expectations of its scene; each failure is a sentence."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.summary import Summary

RELATIVE_RATE_TOLERANCE = 0.1
MAX_RESIDUAL_FORCE_N = 1e-3  # [N]
MIN_JUDGED_DURATION_S = 5.0
"""Shorter sessions [s] have no report of rates after their first second, and are not judged by
them."""
ERROR_LEVEL = 2
MAX_LOOP_PERIOD_S = 0.02
"""Period of a 1 kHz loop [s] above which a bridge takes its device for silent."""
_SLOW = (
    ': the machine is busy, or the scene too heavy for it; see ./trainer doctor and '
    './trainer plan SCENE'
)
_UNRECORDED = (
    'the recorder had too little processor time: the machine is busy; see ./trainer doctor. The '
    'rest of the session is recorded, and can be recomputed up to the first missing contact'
)


@dataclass(frozen=True)
class Expected:
    """Expectations of a scene.

    Attributes:
        rates: nominal rates by node [Hz].
        cut: the arm's script has a phase that cuts.
    """

    rates: Mapping[str, float]
    cut: bool


def judge(summary: Summary, outcome: Outcome, expected: Expected) -> list[str]:
    """Compare a session with its expectations.

    Args:
        summary: summary of its bag.
        outcome: outcome of its processes.
        expected: expectations of its scene.

    Returns:
        A sentence for each failure. An interrupted session need not have reached its goals.
    """
    return [
        *outcome.troubles,
        *_bag(summary),
        *_errors(summary),
        *_held_up(summary, expected),
        *([] if outcome.interrupted else _rates(summary, outcome, expected)),
        *([] if outcome.interrupted else _touch(summary, outcome, expected)),
    ]


def _bag(summary: Summary) -> list[str]:
    failures = []
    if not summary.complete:
        failures.append(f'{summary.bag} was not closed: it can be read up to its last message')
    if summary.lost:
        lost = ', '.join(f'{count} messages of {topic}' for topic, count in summary.lost.items())
        failures.append(f'{lost} were lost on the way to the bag: {_UNRECORDED}')
    return failures


def _rates(summary: Summary, outcome: Outcome, expected: Expected) -> list[str]:
    failures = []
    for name, nominal in expected.rates.items():
        node = summary.nodes.get(name)
        if node is None:
            failures.append(f'{name} never reported on /diagnostics')
        elif math.isnan(node.rate) and outcome.seconds < MIN_JUDGED_DURATION_S:
            continue
        elif math.isnan(node.rate):
            failures.append(f'{name} never reported its rate on /diagnostics')
        elif abs(node.rate - nominal) > RELATIVE_RATE_TOLERANCE * nominal:
            why = _SLOW if node.rate < nominal else ''
            failures.append(f'{name} ran at {node.rate:.4g} Hz instead of {nominal:g} Hz{why}')
    return failures


def _errors(summary: Summary) -> list[str]:
    return [
        f'{node.name} reported an error: {node.message}'
        for node in summary.nodes.values()
        if node.worst_level == ERROR_LEVEL
    ]


def _held_up(summary: Summary, expected: Expected) -> list[str]:
    """Return causes of an error: loops that had no processor time."""
    if not _errors(summary):
        return []
    return [
        f'{node.name} did not run for {1e3 * node.longest_period:.0f} ms: the machine is busy, or '
        'its host takes the processor away; see ./trainer doctor, then try again'
        for name, rate in expected.rates.items()
        if rate * MAX_LOOP_PERIOD_S > 1
        and (node := summary.nodes.get(name))
        and node.longest_period > MAX_LOOP_PERIOD_S
    ]


def _touch(summary: Summary, outcome: Outcome, expected: Expected) -> list[str]:
    failures = []
    if summary.force_before_contact > MAX_RESIDUAL_FORCE_N:
        failures.append(
            f'there was a force of {summary.force_before_contact:.3g} N before the first contact'
        )
    if not outcome.finished:
        failures.append(f'the arm did not finish its script within {outcome.seconds:.0f} s')
    if not summary.complete:
        return failures  # nothing is known of the time after the end of the bag
    if not summary.contact_time:
        failures.append('the tool never touched the tissue')
    elif not summary.largest_force:
        failures.append('the contact was never felt: the force on the arm was zero throughout')
    after = summary.force_after_contact
    if outcome.finished and after is not None and after > MAX_RESIDUAL_FORCE_N:
        failures.append(f'there was a force of {after:.3g} N still after the last contact')
    if expected.cut and not summary.elements_cut:
        failures.append('nothing was cut, although the script has a cut in it')
    return failures
