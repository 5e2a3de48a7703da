"""A measured figure beside the bound that it must keep."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Literal


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes:
        line: number of its claim.
        name: name of the measured quantity.
        value: measured value.
        bound: bound that it must keep.
        side: whether the bound is the largest or the smallest value that passes.
        unit: of value and bound; '' for counts and shares. A time is a ratio to `reference`.
        samples: number of samples, fixed before the measurement.
        reference: denominator of a ratio; '' where the value is no ratio.
        absolute: the value before the division, with its unit; '' where the value is no ratio.
    """

    line: int
    name: str
    value: float
    bound: float
    side: Literal['at most', 'at least']
    unit: str
    samples: int
    reference: str = ''
    absolute: str = ''

    @property
    def passes(self) -> bool:
        """Return whether the value keeps the bound; NaN keeps none."""
        if self.side == 'at most':
            return bool(self.value <= self.bound)
        return bool(self.value >= self.bound)


def figures_of(name: str) -> list[Figure]:
    """Return the figures that a module of this folder measures."""
    measure: Callable[[], list[Figure]] = import_module(f'bench.figures.{name}').measure
    return measure()


def print_figures(figures: Sequence[Figure]) -> int:
    """Print figures with the load of the machine; return 1 where one falls short."""
    for figure in figures:
        verdict = 'ok   ' if figure.passes else 'SHORT'
        print(f'{verdict} {figure.name}: {figure.value:.5g}, {figure.side} {figure.bound:.5g}')
    print(f'load of the machine, 1 and 5 minutes: {os.getloadavg()[:2]}')
    return 0 if all(figure.passes for figure in figures) else 1
