"""Figures of the force in the hand at two random cuts, against a tissue that runs at 1 kHz."""

import numpy as np

from bench.figures.figure import Figure
from bench.haptics.random_cuts import errors_of

_SEEDS = (900, 901)
"""Strokes of no other bench."""


def measure() -> list[Figure]:
    """Return the figures of line 4."""
    found = [errors_of(seed) for seed in _SEEDS]

    def largest(name: str) -> float:
        return max(float(getattr(errors, name)) for errors in found)

    count = len(found)
    p95 = float(np.mean([errors.p95 for errors in found]))
    return [
        Figure(4, 'force of a cut off 1 kHz, over its peak, p95', p95, 0.08, 'at most', '', count),
        Figure(4, 'the same, over 3 ms long, worst', largest('worst'), 0.2, 'at most', '', count),
        Figure(4, 'the same, missing at the entry', largest('hole'), 0.2, 'at most', '', count),
        Figure(4, 'way on which it is felt on', 1e3 * largest('tail'), 5.0, 'at most', 'mm', count),
    ]
