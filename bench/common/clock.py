"""Measurement of processor time by turns, beside the memory bandwidth."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

REPEATS = 9
_MIN_SAMPLE_S = 0.005
"""Shortest duration of a sample [s]: the resolution of the clock is far below."""


@dataclass(frozen=True)
class Figure:
    """One measured quantity.

    Attributes:
        name: name of the quantity.
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
    """Return the figure of some samples."""
    low, median, high = (float(value) for value in np.percentile(samples, [10, 50, 90]))
    return Figure(name, unit, median, low, high, ratio, against)


def by_turns(*tasks: Callable[[], object], repeats: int = REPEATS) -> np.ndarray:
    """Return processor time [s] of some tasks, one after the other so that all meet the same
    machine.

    Returns:
        Shape (repeats, number of tasks).
    """
    counts = []
    for task in tasks:
        task()  # loads kernels and caches
        once = max(_spent(task, 1), 1e-7)
        counts.append(max(1, int(np.ceil(_MIN_SAMPLE_S / once))))
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
    """Return the reference task: it reads so many bytes of memory in order."""
    values = np.ones(max(int(size) // 8, 1))
    return lambda: _read(values)


def keep(report: dict[str, Any], of: str) -> Path:
    """Write figures to bench/results, named by their time and subject.

    Args:
        report: plain values, `when` among them (ISO 8601).
        of: subject of the measurement.

    Returns:
        The file; without colons, which not every system takes in a name.
    """
    folder = Path(__file__).parents[2] / 'bench' / 'results'
    folder.mkdir(exist_ok=True)
    target = folder / f'{report["when"]}-{of}.json'.replace(':', '')
    target.write_text(json.dumps(report, indent=1) + '\n')
    return target
