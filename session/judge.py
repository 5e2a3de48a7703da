"""Did a session do what it should have? Every "no" is a sentence."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from session.processes import Outcome
from session.summary import Summary

RATE_TOLERANCE = 0.1
NO_FORCE = 1e-3  # [N]
REPORTED = 5.0
"""Length [s] from which a session has reports of the rates after its first second; of a shorter one
they are not judged."""
ERROR_LEVEL = 2
STOOD_STILL = 0.02
"""[s] between two turns of a loop of 1 kHz after which a bridge takes its device for silent."""
_SLOW = (
    ': the machine is busy, or the scene too heavy for it; see ./trainer doctor and '
    './trainer plan SCENE'
)
_UNRECORDED = (
    'the recorder got too few turns: the machine is busy; see ./trainer doctor. The session is '
    'there but for these messages, and can be computed again up to the first contact that it lacks'
)


@dataclass(frozen=True)
class Expected:
    """What a scene asks of a session.

    Attributes:
        rates: [Hz] of the nodes that have one.
        cut: the arm's script has a phase that cuts.
    """

    rates: Mapping[str, float]
    cut: bool


def judge(summary: Summary, outcome: Outcome, expected: Expected) -> list[str]:
    """What the session should have done and did not.

    Args:
        summary: of its bag.
        outcome: of its processes.
        expected: by its scene.

    Returns:
        Sentences; none if all is well. An interrupted session need not have got anywhere.
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
        failures.append(f'{summary.bag} was not closed: what is there up to then can be read')
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
        elif math.isnan(node.rate) and outcome.seconds < REPORTED:
            continue
        elif math.isnan(node.rate):
            failures.append(f'{name} never reported its rate on /diagnostics')
        elif abs(node.rate - nominal) > RATE_TOLERANCE * nominal:
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
    """What explains an error: loops that got no turn."""
    if not _errors(summary):
        return []
    return [
        f'{node.name} got no turn for {1e3 * node.longest_period:.0f} ms: the machine is busy, or '
        'its host takes the processor away; see ./trainer doctor, then try again'
        for name, rate in expected.rates.items()
        if rate * STOOD_STILL > 1
        and (node := summary.nodes.get(name))
        and node.longest_period > STOOD_STILL
    ]


def _touch(summary: Summary, outcome: Outcome, expected: Expected) -> list[str]:
    failures = []
    if summary.force_before_contact > NO_FORCE:
        failures.append(
            f'there was a force of {summary.force_before_contact:.3g} N before the first contact'
        )
    if not outcome.finished:
        failures.append(f'the arm did not finish its script within {outcome.seconds:.0f} s')
    if not summary.complete:
        return failures  # what came after the end of the bag is not known
    if not summary.contact_time:
        failures.append('the tool never touched the tissue')
    elif not summary.largest_force:
        failures.append('the contact was never felt: the force on the arm was zero throughout')
    after = summary.force_after_contact
    if outcome.finished and after is not None and after > NO_FORCE:
        failures.append(f'there was a force of {after:.3g} N still after the last contact')
    if expected.cut and not summary.elements_cut:
        failures.append('nothing was cut, although the script has a cut in it')
    return failures
