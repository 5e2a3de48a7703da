"""Settings of a study: grids, cases, Latin hypercubes and Sobol sequences."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue
from scipy.stats import qmc

from cutting_trainer.studies.description import Designs, Range, Sampled, Sobol, Study

_DIGITS = 6
"""Significant digits of a sampled value: it is read by people, too."""
_HASH_DIGITS = 16
MESH_KEY = 'tissue.mesh'
Key = tuple[str, str]
"""Of a row: hash of its bag and identity of its setting."""


@dataclass(frozen=True)
class Setting:
    """Changes of the scene.

    Attributes:
        number: place in the study, from 1; 0: the session as recorded.
        changes: values by dotted scene key.
    """

    number: int
    changes: dict[str, JsonValue]

    @cached_property
    def identity(self) -> str:
        """Hash of the changes, whatever their order; a mesh counts by its content."""
        if not self.number:
            return ''
        changes = dict(self.changes)
        if self.mesh is not None and self.mesh.is_file():
            changes[MESH_KEY] = hashlib.sha256(self.mesh.read_bytes()).hexdigest()
        text = json.dumps(_plain(changes), sort_keys=True).encode()
        return hashlib.sha256(text).hexdigest()[:_HASH_DIGITS]

    @property
    def mesh(self) -> Path | None:
        """File of another mesh."""
        mesh = self.changes.get(MESH_KEY)
        return Path(mesh) if isinstance(mesh, str) else None

    @property
    def in_yaml(self) -> dict[str, str]:
        """Values in YAML, as `restore_scene` takes them."""
        return {key: json.dumps(value) for key, value in self.changes.items()}

    def label(self, names: Mapping[str, str]) -> str:
        """Return the changes in a few words, with names of the keys as from `short_names`."""
        words = (f'{names[key]}={_short(value)}' for key, value in self.changes.items())
        return ', '.join(words) or 'unchanged'


RECORDED = Setting(0, {})
"""The session as recorded: setting 0."""


def settings_of(study: Study, folder: Path = Path()) -> list[Setting]:
    """Return the settings of a study, each once: its reference, if there is one, then its designs.

    Args:
        study: as read.
        folder: of the study file, to which a mesh is relative.
    """
    found, folder = dict[str, Setting](), folder.resolve()
    reference = [] if study.reference is None else [study.reference]
    for changes in chain(reference, _all_changes(study.settings)):
        mesh = changes.get(MESH_KEY)
        if isinstance(mesh, str):
            changes = {**changes, MESH_KEY: str(folder / mesh)}
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


def short_names(keys: Iterable[str]) -> dict[str, str]:
    """Return the last word of each dotted key, or the whole of those that share it."""
    last = {key: key.rpartition('.')[2] for key in keys}
    counts = Counter(last.values())
    return {key: word if counts[word] == 1 else key for key, word in last.items()}


def _plain(value: JsonValue) -> JsonValue:
    """Return a value with whole numbers as integers: 3 and 3.0 are one setting."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _short(value: JsonValue) -> str:
    if isinstance(value, float):
        return f'{value:.4g}'
    return value if isinstance(value, str) else json.dumps(value)
