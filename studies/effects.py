"""Effects of settings and keys on outputs, with bootstrap confidence intervals over bags.

The bag is the unit: hands differ, and rows of one bag are not independent. Each bag gives one
difference or one slope; intervals are percentiles of the mean over bags drawn with replacement
(Efron, Tibshirani, *An Introduction to the Bootstrap*, 1993, chapter 13).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue
from scipy.stats import bootstrap

from cutting_trainer.studies.designs import RECORDED, Setting, short_names
from cutting_trainer.studies.table import Row, as_text

Floats = NDArray[np.float64]

RESAMPLES = 4999
SEED = 0
MIN_BAGS = 8
"""Bags below which a percentile interval is clearly too narrow."""
_ROUNDING = 1e-12
"""Slope, as a share of the largest value, below which it is an error of rounding."""
_LOG_RATIO = 10.0
"""Ratio of largest to smallest value from which a key counts on a logarithmic scale."""


@dataclass(frozen=True)
class Effect:
    """Change of an output.

    Attributes:
        output: name of the output.
        cause: the setting, or the key with the values between which it changes.
        mean: over bags, in the output's unit.
        low, high: confidence interval; NaN with fewer than two bags.
        bags: number of bags.
        reference: mean of the output over the same bags as recorded; NaN for a key.
    """

    output: str
    cause: str
    mean: float
    low: float
    high: float
    bags: int
    reference: float

    @property
    def is_zero(self) -> bool:
        """Whether no bag shows a change."""
        return self.mean == 0.0 and not (self.low < 0.0 or self.high > 0.0)


def effects_of_settings(
    rows: Sequence[Row], outputs: Sequence[str], confidence: float
) -> list[Effect]:
    """Return the mean difference between each setting and the sessions as recorded.

    Args:
        rows: of the study; failures are left out with their bags.
        outputs: names.
        confidence: level of the intervals.
    """
    values = _by_setting(rows)
    recorded = values.get(RECORDED.identity, {})
    found = []
    settings = _settings(rows)
    names = short_names(_keys(settings))
    for setting in settings:
        here = values[setting.identity]
        for output in outputs:
            bags = [b for b in here if output in here[b] and output in recorded.get(b, ())]
            if not bags:
                continue
            now = np.array([here[bag][output] for bag in bags])
            then = np.array([recorded[bag][output] for bag in bags])
            mean, low, high = interval(now - then, confidence)
            reference = float(then.mean())
            found.append(
                Effect(output, setting.label(names), mean, low, high, len(bags), reference)
            )
    return found


def effects_of_keys(
    rows: Sequence[Row], outputs: Sequence[str], confidence: float
) -> tuple[list[Effect], str]:
    """Return the main effect of each key over its range, by least squares within each bag.

    A number changes from its smallest to its largest value; a word from the first one.

    Returns:
        The effects, and the reason why there are none; ''.
    """
    settings = _settings(rows)
    keys = _keys(settings)
    if any(len(setting.changes) < len(keys) for setting in settings):
        return [], 'settings change different keys, so the keys have no effects of their own'
    columns = dict[str, Floats]()
    for key, name in short_names(keys).items():
        columns |= _columns(name, [setting.changes[key] for setting in settings])
    if not columns:
        return [], ''
    design = np.column_stack([np.ones(len(settings)), *columns.values()])
    values = _by_setting(rows)
    known = {output for of in values.values() for done in of.values() for output in done}
    if not known.intersection(outputs):
        return [], ''
    found: dict[tuple[str, str], list[float]] = {}
    for output in outputs:
        for bag in values.get(RECORDED.identity, {}):
            there = [i for i, s in enumerate(settings) if output in values[s.identity].get(bag, ())]
            if np.linalg.matrix_rank(design[there]) < design.shape[1]:
                continue
            given = np.array([values[settings[i].identity][bag][output] for i in there])
            slopes = np.linalg.lstsq(design[there], given, rcond=None)[0][1:]
            slopes[np.abs(slopes) < _ROUNDING * np.abs(given).max()] = 0.0
            for name, slope in zip(columns, slopes, strict=True):
                found.setdefault((name, output), []).append(float(slope))
    if not found:
        return [], 'the settings cannot tell the effects of their keys apart: add settings'
    return [
        Effect(output, name, *interval(np.array(slopes), confidence), len(slopes), float('nan'))
        for (name, output), slopes in found.items()
    ], ''


def interval(differences: Floats, confidence: float) -> tuple[float, float, float]:
    """Return the mean over bags, and its bootstrap confidence interval.

    Args:
        differences: one for each bag, shape (bags,).
        confidence: level.
    """
    mean = float(differences.mean())
    if len(differences) < 2:
        return mean, float('nan'), float('nan')
    if np.ptp(differences) == 0.0:
        return mean, mean, mean
    found = bootstrap(
        (differences,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=confidence,
        method='percentile',
        rng=np.random.default_rng(SEED),
    ).confidence_interval
    return mean, float(found.low), float(found.high)


def _settings(rows: Sequence[Row]) -> list[Setting]:
    found = {row.setting.number: row.setting for row in rows if row.setting.number}
    return [found[number] for number in sorted(found)]


def _keys(settings: Sequence[Setting]) -> list[str]:
    return list(dict.fromkeys(key for setting in settings for key in setting.changes))


def _by_setting(rows: Sequence[Row]) -> dict[str, dict[str, Mapping[str, float]]]:
    """Return the outputs by setting and bag; failures are left out."""
    found: dict[str, dict[str, Mapping[str, float]]] = {}
    for row in rows:
        of_setting = found.setdefault(row.setting.identity, {})
        if not row.result.failure:
            of_setting[row.bag.hash] = row.result.outputs
    return found


def _columns(name: str, values: Sequence[JsonValue]) -> dict[str, Floats]:
    """Return regressors from 0 to 1 of one key, by a name that says the change."""
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) == len(values):
        given = np.array(numbers, float)
        low, high = float(given.min()), float(given.max())
        if low == high:
            return {}
        if low > 0 and high / low >= _LOG_RATIO:
            shares = np.log(given / low) / np.log(high / low)
        else:
            shares = (given - low) / (high - low)
        return {f'{name} {low:.4g} -> {high:.4g}': shares}
    words = [as_text(value) for value in values]
    first, *others = dict.fromkeys(words)
    return {
        f'{name} {first} -> {word}': np.array([float(w == word) for w in words]) for word in others
    }
