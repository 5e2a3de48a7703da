"""Score of an attempt, with the reason for each deduction.

The measures themselves are computed in `metrics.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cutting_trainer.exercises.scene_schema import CriterionSettings, ExerciseSettings, MeasureName

UNITS: dict[MeasureName, tuple[float, str, str]] = {
    'time': (1.0, 's', 'time'),
    'path_length': (1e3, 'mm', 'path of the tip'),
    'economy': (100.0, '%', 'economy of motion'),
    'mean_speed': (1e3, 'mm/s', 'mean speed'),
    'jerk': (1.0, '', 'log dimensionless jerk'),
    'idle': (100.0, '%', 'time at rest'),
    'tremor': (1e3, 'mm', 'tremor, 8 to 12 Hz'),
    'coverage': (100.0, '%', 'target that is opened'),
    'excess': (100.0, '%', 'opened outside of the target'),
    'depth_error': (1e3, 'mm', 'depth outside of its band'),
    'mean_force': (1.0, 'N', 'mean force in contact'),
    'peak_force': (1.0, 'N', 'peak force'),
    'force_over': (1.0, 's', 'time beyond the force limit'),
    'blade_angle': (1.0, 'deg', 'angle of the blade from the vertical'),
    'damage': (1e6, 'mm^2', 'area opened without need'),
    'pieces': (1.0, '', 'pieces that came off'),
    'zones_touched': (1.0, '', 'forbidden zones cut'),
    'lesion_margin': (1e3, 'mm', 'tissue around the lesion'),
    'marks_found': (100.0, '%', 'lumps marked'),
    'marks_false': (1.0, '', 'marks where there is no lump'),
    'order': (100.0, '%', 'steps in order'),
}
"""Factor from SI, unit and name of each measure, for people."""
_WITHOUT: dict[MeasureName, str] = {'lesion_margin': 'the lesion is still held'}
"""Words for a measure without a value, where there is more to say."""


@dataclass(frozen=True)
class Deduction:
    """Points of one criterion.

    Attributes:
        measure: its name.
        value: in SI units; NaN where there is none.
        possible, given: points.
        failed: whether a required value was missed.
        reason: sentence for people; empty: no points were lost.
    """

    measure: MeasureName
    value: float
    possible: float
    given: float
    failed: bool
    reason: str


@dataclass(frozen=True)
class Score:
    """Score of an attempt.

    Attributes:
        points: of 100.
        passed: whether it passes.
        deductions: by criterion, in the order of the scene; a time beyond the limit is the last.
    """

    points: float
    passed: bool
    deductions: tuple[Deduction, ...]

    @property
    def reasons(self) -> list[str]:
        """Sentences about lost points, the most costly first."""
        lost = [each for each in self.deductions if each.reason]
        lost.sort(key=lambda each: (not each.failed, each.given - each.possible))
        return [each.reason for each in lost]


def in_words(measure: MeasureName, value: float) -> str:
    """Return a value with its unit, for people."""
    factor, unit, _ = UNITS[measure]
    if math.isnan(value):
        return _WITHOUT.get(measure, 'nothing to measure')
    return f'{value * factor:.3g} {unit}'.strip()


def score(exercise: ExerciseSettings, measures: Mapping[MeasureName, float]) -> Score:
    """Return the score of an attempt.

    Args:
        exercise: its criteria.
        measures: of the attempt, in SI units.
    """
    total = sum(criterion.weight for criterion in exercise.criteria)
    deductions = [
        _judge(criterion, float(measures[criterion.measure]), 100.0 * criterion.weight / total)
        for criterion in exercise.criteria
    ]
    time = float(measures['time'])
    if time > exercise.time_limit:
        reason = f'time: {time:.1f} s; the limit is {exercise.time_limit:g} s: the attempt fails'
        deductions.append(Deduction('time', time, 0.0, 0.0, True, reason))
    points = math.fsum(each.given for each in deductions)
    passed = points >= exercise.pass_score and not any(each.failed for each in deductions)
    return Score(points, passed, tuple(deductions))


def _judge(criterion: CriterionSettings, value: float, possible: float) -> Deduction:
    name = criterion.measure
    share = (value - criterion.bad) / (criterion.good - criterion.bad)
    share = 0.0 if math.isnan(share) else min(max(share, 0.0), 1.0)
    given = possible * share
    failed = criterion.required and share <= 0.0
    reason = ''
    if share < 1.0:
        full, none = in_words(name, criterion.good), in_words(name, criterion.bad)
        reason = (
            f'{UNITS[name][2]}: {in_words(name, value)}; full marks at {full}, none at {none}: '
            f'{given - possible:.1f} points' + (', and the attempt fails' if failed else '')
        )
    return Deduction(name, value, possible, given, failed, reason)
