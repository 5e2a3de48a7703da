"""How `bench` measures: a thread's processor time, by turns, beside what memory can stream."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

REPEATS = 9
_LEAST = 0.005
"""[s] that one sample lasts at least: the clock's grain is far below."""


@dataclass(frozen=True)
class Figure:
    """One measured quantity.

    Attributes:
        name: what it is.
        unit: of the numbers.
        median, low, high: of the samples, low and high the tenth and ninetieth percentile.
        ratio: to `against`, both medians of this run; None: there is nothing to hold it against.
        against: name of that.
    """

    name: str
    unit: str
    median: float
    low: float
    high: float
    ratio: float | None = None
    against: str = ''


def figure(
    name: str,
    unit: str,
    samples: Sequence[float] | np.ndarray,
    ratio: float | None = None,
    against: str = '',
) -> Figure:
    """What some samples come to."""
    low, median, high = (float(value) for value in np.percentile(samples, [10, 50, 90]))
    return Figure(name, unit, median, low, high, ratio, against)


def by_turns(*tasks: Callable[[], object], repeats: int = REPEATS) -> np.ndarray:
    """Processor time [s] of some tasks, one after the other so that all meet the same machine.

    Returns:
        Shape (repeats, number of tasks).
    """
    counts = []
    for task in tasks:
        task()  # loads kernels and caches
        once = max(_spent(task, 1), 1e-7)
        counts.append(max(1, int(np.ceil(_LEAST / once))))
    pairs = list(zip(tasks, counts, strict=True))
    return np.array([[_spent(task, n) / n for task, n in pairs] for _ in range(repeats)])


def _spent(task: Callable[[], object], count: int) -> float:
    start = time.thread_time()
    for _ in range(count):
        task()
    return time.thread_time() - start


@njit(cache=True, fastmath=True)
def _read(values):
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i]
    return total


def stream(size: float) -> Callable[[], object]:
    """The yardstick: a task that reads so many bytes of memory in their order."""
    values = np.ones(max(int(size) // 8, 1))
    return lambda: _read(values)


def keep(report: dict[str, Any], of: str) -> Path:
    """Writes what was measured to bench/results, under its time and what it is of.

    Args:
        report: plain values, `when` among them (ISO 8601).
        of: what was measured.

    Returns:
        The file; without colons, which not every system takes in a name.
    """
    folder = Path(__file__).parents[2] / 'bench' / 'results'
    folder.mkdir(exist_ok=True)
    target = folder / f'{report["when"]}-{of}.json'.replace(':', '')
    target.write_text(json.dumps(report, indent=1) + '\n')
    return target
