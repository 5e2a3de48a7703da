"""Attempts of emulated people as rows, and how well the score tells them apart."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bench.training.people import MUST_FAIL, SKILLED, Kind, person
from bench.training.player import play
from cutting_trainer.exercises.score import score

EXERCISES = ('circle', 'pad', 'excision', 'lumps', 'vessel')
FIRST_SEED = 2000


def attempt(scene: str, kind: Kind, seed: int) -> dict[str, Any]:
    """Return one attempt as a row: points, verdict, reasons, measures."""
    row: dict[str, Any] = {'exercise': scene, 'kind': kind, 'seed': seed}
    try:
        made = play(scene, person(scene, kind, seed))
    except RuntimeError as error:  # the force loop ended in a FAULT: it counts as zero points
        return row | {'points': 0.0, 'passed': False, 'reasons': [str(error)], 'measures': {}}
    measures = made.measures()
    got = score(made.exercise, measures)
    plain = {name: None if np.isnan(value) else value for name, value in measures.items()}
    return row | {
        'points': got.points,
        'passed': got.passed,
        'reasons': got.reasons,
        'measures': plain,
    }


def auc(experts: Sequence[float], novices: Sequence[float]) -> float:
    """Return the area under the ROC curve: the chance that an expert has more points.

    Equal points count half (Mann and Whitney 1947: U over the number of pairs).
    """
    more = np.subtract.outer(np.asarray(experts, float), np.asarray(novices, float))
    return float((np.sign(more) / 2 + 0.5).mean())


def wanted(exercises: Sequence[str], count: int) -> Iterator[tuple[str, Kind, int]]:
    """Yield exercise, kind and seed of each attempt, so that any part of them is balanced."""
    for exercise in exercises:
        for kind in MUST_FAIL:
            yield exercise, kind, FIRST_SEED
    for number in range(count):
        for exercise in exercises:
            for kind in SKILLED:
                yield exercise, kind, FIRST_SEED + number


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the results by exercise, as lines of a Markdown table."""
    lines = [
        '| exercise | experts: n, passed, median | novices: n, passed, median | AUC | must fail |',
        '|---|---|---|---|---|',
    ]
    for exercise in dict.fromkeys(row['exercise'] for row in rows):
        own = [row for row in rows if row['exercise'] == exercise]
        by = {kind: [row for row in own if row['kind'] == kind] for kind in (*SKILLED, *MUST_FAIL)}
        if not (by['expert'] and by['novice']):
            continue
        points = {kind: [row['points'] for row in by[kind]] for kind in SKILLED}
        cells = [
            f'{len(by[kind])}, {sum(row["passed"] for row in by[kind])}, '
            f'{np.median(points[kind]):.0f}'
            for kind in SKILLED
        ]
        bad = ', '.join(
            f'{kind}: {row["points"]:.0f}{" PASSED" if row["passed"] else ""}'
            for kind in MUST_FAIL
            for row in by[kind]
        )
        area = auc(points['expert'], points['novice'])
        lines.append(f'| {exercise} | {cells[0]} | {cells[1]} | {area:.3f} | {bad} |')
    return lines
