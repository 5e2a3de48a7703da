"""Figures of exercises: scores of emulated people, the same bits again, and the index at size."""

import hashlib
import sqlite3
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from bench.figures.figure import Figure
from bench.training.people import SKILLED, Kind
from bench.training.runner import FIRST_SEED, attempt, auc
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.exercises.attempt_store import AttemptRow, AttemptStore, learning_curves
from cutting_trainer.exercises.bag_feed import read_attempt
from cutting_trainer.exercises.scene_schema import (
    MEASURES,
    CriterionSettings,
    ExerciseSettings,
    TargetSettings,
)

SAMPLE = Path(__file__).parents[2] / 'bags' / 'samples' / 'format_7' / 'straight_cut'
EXERCISES = ('vessel',)
"""The one with a cut that is cheap to play."""
COUNT = 2
PROCESSES = 2
ATTEMPTS, SUBJECTS = 10_000, 50
MAX_RATIO = 10.0


def measure() -> list[Figure]:
    """Return the figures of lines 2 and 6."""
    return [*_people(), _same_bits(), *_index()]


def _people() -> list[Figure]:
    made = [(exercise, kind, FIRST_SEED + k) for exercise in EXERCISES for kind in SKILLED
            for k in range(COUNT)]  # fmt: skip
    bad = [(exercise, kind, FIRST_SEED) for exercise in EXERCISES for kind in ('nothing', 'wild')]
    with ProcessPoolExecutor(PROCESSES, get_context('spawn')) as pool:
        rows = list(pool.map(_played, [*made, *bad]))
    passed = sum(row['passed'] for row in rows[len(made) :])
    figures = [
        Figure(2, 'attempts that do nothing, or are fast and wild, and pass', passed, 0, 'at most',
               '', len(bad)),
    ]  # fmt: skip
    for exercise in EXERCISES:
        own = [row for row in rows[: len(made)] if row['exercise'] == exercise]
        points = [[row['points'] for row in own if row['kind'] == kind] for kind in SKILLED]
        name = f'area under the ROC curve, experts and novices at {exercise}'
        figures.append(Figure(2, name, auc(*points), 0.9, 'at least', '', len(own)))
    return figures


def _played(which: tuple[str, Kind, int]) -> dict[str, Any]:
    return attempt(*which)


def _same_bits() -> Figure:
    target = TargetSettings(
        name='line', points=((-0.02, 0, 0.01), (0.02, 0, 0.01)), depth=(0.001, 0.02)
    )
    criteria = (CriterionSettings(measure='time', good=1, bad=2),)
    task = ExerciseSettings(title='figure', targets=(target,), criteria=criteria)
    runs = 3
    digests = set()
    for _ in range(runs):
        measures = read_attempt(open_bag(SAMPLE), task).measures()
        values = np.array([measures[name] for name in MEASURES])
        digests.add(hashlib.sha256(values.tobytes()).hexdigest())
    name = 'different measures of one bag read again'
    return Figure(2, name, len(digests) - 1, 0, 'at most', '', runs)


def _index() -> list[Figure]:
    random = np.random.default_rng(6)
    rows = [
        AttemptRow(
            f'/bags/{k}', f'subject-{k % SUBJECTS}', 'circle', k // SUBJECTS + 1, float(k),
            'scored', float(random.uniform(0, 100)), False, '', ('a reason',),
            dict.fromkeys(MEASURES, 1.0),
        )
        for k in range(ATTEMPTS)
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        store = AttemptStore(Path(folder) / 'index.sqlite')
        store.put(rows)
        gone = len(store.mark_missing())
        listed, curves = _median(lambda: _read(store))
        plain, _ = _median(lambda: _plain(Path(folder) / 'index.sqlite'))
    return [
        Figure(6, 'list and curves of 10,000 attempts', listed / plain, MAX_RATIO, 'at most', '',
               ATTEMPTS, 'reading the same table by sqlite3', f'{listed:.2f} s of processor time'),
        Figure(6, 'learning curves', curves, SUBJECTS, 'at least', '', ATTEMPTS),
        Figure(6, 'deleted bags that are noticed', gone, ATTEMPTS, 'at least', '', ATTEMPTS),
    ]  # fmt: skip


def _read(store: AttemptStore) -> int:
    return len(learning_curves(store.rows(), 70.0))


def _plain(file: Path) -> int:
    connection = sqlite3.connect(file)
    count = len(connection.execute('SELECT * FROM attempts ORDER BY begun').fetchall())
    connection.close()
    return count


def _median(work: Callable[[], int], runs: int = 5) -> tuple[float, int]:
    """Return the median processor time [s] of some work, and its result."""
    times, result = [], 0
    for _ in range(runs):
        began = time.process_time()
        result = work()
        times.append(time.process_time() - began)
    return float(np.median(times)), result
