"""Settings of a study: grids, cases, Latin hypercubes and Sobol sequences."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue
from scipy.stats import qmc

from cutting_trainer.studies.description import Designs, Range, Sampled, Sobol

_DIGITS = 6
"""Significant digits of a sampled value: it is read by people, too."""
_HASH_DIGITS = 16


@dataclass(frozen=True)
class Setting:
    """Changes of the scene.

    Attributes:
        number: place in the study, from 1; 0: the session as recorded.
        changes: values by dotted scene key.
    """

    number: int
    changes: dict[str, JsonValue]

    @property
    def identity(self) -> str:
        """Hash of the changes, whatever their order."""
        text = json.dumps(self.changes, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_HASH_DIGITS] if self.number else ''

    @property
    def in_yaml(self) -> dict[str, str]:
        """Values in YAML, as `restore_scene` takes them."""
        return {key: json.dumps(value) for key, value in self.changes.items()}

    @property
    def label(self) -> str:
        """The changes in a few words."""
        if not self.number:
            return 'as recorded'
        words = (f'{key.rpartition(".")[2]}={_short(value)}' for key, value in self.changes.items())
        return ', '.join(words) or 'unchanged'


RECORDED = Setting(0, {})
"""The session as recorded: the reference of all others."""


def settings_of(designs: Designs) -> list[Setting]:
    """Return the settings of all designs, each once, in the order of the study file."""
    found: dict[str, Setting] = {}
    for changes in _all_changes(designs):
        setting = Setting(len(found) + 1, changes)
        found.setdefault(setting.identity, setting)
    return list(found.values())


def _all_changes(designs: Designs) -> Iterator[dict[str, JsonValue]]:
    if designs.grid:
        for values in product(*designs.grid.values()):
            yield dict(zip(designs.grid, values, strict=True))
    yield from designs.cases
    for sampled in (designs.latin_hypercube, designs.sobol):
        if sampled is not None:
            yield from _samples(sampled)


def _samples(sampled: Sampled) -> Iterator[dict[str, JsonValue]]:
    unit = _unit_samples(sampled)
    for point in unit:
        yield {
            key: _value(within, float(share))
            for (key, within), share in zip(sampled.ranges.items(), point, strict=True)
        }


def _unit_samples(sampled: Sampled) -> NDArray[np.float64]:
    """Return points in the unit cube, shape (samples, ranges)."""
    dimensions = len(sampled.ranges)
    random = np.random.default_rng(sampled.seed)
    if isinstance(sampled, Sobol):
        return qmc.Sobol(dimensions, rng=random).random_base2(sampled.samples.bit_length() - 1)
    return qmc.LatinHypercube(dimensions, rng=random).random(sampled.samples)


def _value(within: Range, share: float) -> float:
    if within.scale == 'log':
        value = within.low * (within.high / within.low) ** share
    else:
        value = within.low + share * (within.high - within.low)
    return float(f'{value:.{_DIGITS}g}')


def _short(value: JsonValue) -> str:
    if isinstance(value, float):
        return f'{value:.4g}'
    return value if isinstance(value, str) else json.dumps(value)
