"""Study files: bags, settings and outputs, checked as scenes are."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    JsonValue,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.node_common.error_place import models_in, nearest
from cutting_trainer.node_common.scene_reader import (
    SECTIONS,
    SceneModel,
    read_document,
)
from cutting_trainer.studies.outputs import FIGURES, OUTPUTS, FileName
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

MAX_SETTINGS = 100_000
"""Settings of a grid, and samples of a design; each is computed for each bag."""
MODELS: dict[str, type[BaseModel]] = {
    'tissue': TissueSettings,
    'tool': ToolSettings,
    'device': DeviceSettings,
    'haptics': HapticsSettings,
    'cutting': CuttingSettings,
}
"""Sections of a scene that a recorded hand meets. The arm and its script are not among them."""


def _scene_key(key: str) -> str:
    """Return a dotted key of a scene, unchanged; refuse one that no scene has."""
    section, *path = key.split('.')
    if section not in MODELS:
        if section in SECTIONS:
            raise ValueError(
                f'section {section} moves an emulated arm, and a study has recorded hands: '
                f'change {", ".join(MODELS)}'
            )
        near = nearest(section, MODELS)
        hint = f'did you mean {near}?' if near else f'known are {", ".join(MODELS)}'
        raise ValueError(f'{section} is not a section of a scene: {hint}')
    if not path:
        raise ValueError('give section and key, as in tissue.material.toughness')
    _fields(key)
    return key


def _fields(key: str) -> list[FieldInfo]:
    """Return the fields that a dotted key of a scene may mean.

    Raises:
        ValueError: there is none.
    """
    section, *path = key.split('.')
    models: list[type[BaseModel]] = [MODELS[section]]
    fields: list[FieldInfo] = []
    for part in path:
        if any(get_origin(field.annotation) in (list, tuple) for field in fields):
            raise ValueError(f'{part} is in a list: give the whole list before it')
        fields = [m.model_fields[part] for m in models if part in m.model_fields]
        if not fields:
            known = list(dict.fromkeys(name for m in models for name in m.model_fields))
            if not known:
                raise ValueError(f'{part} is not a key of a scene: the key before it has a value')
            near = nearest(part, known)
            hint = f'did you mean {near}?' if near else f'known are {", ".join(known)}'
            raise ValueError(f'{part} is not a key of a scene there: {hint}')
        models = [inner for field in fields for inner in models_in(field.annotation)]
    return fields


def _output(name: str) -> str:
    if name not in OUTPUTS:
        near = nearest(name, OUTPUTS)
        hint = f'did you mean {near}?' if near else f'known are {", ".join(OUTPUTS)}'
        raise ValueError(f'{name} is not an output: {hint}')
    return name


SceneKey = Annotated[str, AfterValidator(_scene_key)]
OutputName = Annotated[str, AfterValidator(_output)]


class Range(SceneModel):
    """Range of a value."""

    low: float = Field(description='smallest value')
    high: float = Field(description='largest value, above low')
    scale: Literal['linear', 'log'] = Field(
        default='linear', description='linear, or log for a range over orders of magnitude'
    )

    @model_validator(mode='after')
    def _ordered(self) -> Self:
        if self.high <= self.low:
            raise ValueError(f'high is {self.high:g}: it must be above low, {self.low:g}')
        if self.scale == 'log' and self.low <= 0:
            raise ValueError(f'low is {self.low:g}: on the scale log it must be above 0')
        return self


class Sampled(SceneModel):
    """Random settings that fill ranges evenly."""

    samples: int = Field(ge=2, le=MAX_SETTINGS, description='number of settings, from 2')
    seed: int = Field(default=0, ge=0, lt=2**63, description='seed of the random numbers')
    ranges: dict[SceneKey, Range] = Field(min_length=1, description='range by dotted scene key')


class Sobol(Sampled):
    """Scrambled Sobol sequence; it is balanced for powers of two only."""

    @model_validator(mode='after')
    def _balanced(self) -> Self:
        if self.samples & (self.samples - 1):
            power = 1 << self.samples.bit_length()
            above = f' or {power}' if power <= MAX_SETTINGS else ''
            raise ValueError(
                f'samples is {self.samples}: a Sobol sequence is balanced for powers of two, '
                f'as {power // 2}{above}'
            )
        return self


class Designs(SceneModel):
    """Settings of a study; those of all designs are computed."""

    grid: dict[SceneKey, Annotated[list[JsonValue], Field(min_length=1)]] = Field(
        default={}, description='values by dotted scene key; each is combined with each'
    )
    cases: list[dict[SceneKey, JsonValue]] = Field(
        default=[], description='settings one by one, each with its values by dotted scene key'
    )
    latin_hypercube: Sampled | None = Field(default=None, description='samples, seed, ranges')
    sobol: Sobol | None = Field(default=None, description='samples, seed, ranges')

    @model_validator(mode='after')
    def _some(self) -> Self:
        if not (self.grid or self.cases or self.latin_hypercube or self.sobol):
            raise ValueError(f'there is no design: give {", ".join(type(self).model_fields)}')
        size = 1
        for values in self.grid.values():
            size *= len(values)
        if size > MAX_SETTINGS:
            raise ValueError(
                f'the grid has {size} settings, and at most {MAX_SETTINGS} are possible: '
                'take latin_hypercube or sobol'
            )
        return self


class Attempts(SceneModel):
    """Bags of scored attempts, from their index."""

    folder: str = Field(
        default='', description='folder of the bags, relative to the study file; "": bags/sessions'
    )
    exercise: str = Field(default='', description='name of its scene; "": every exercise')
    subject: str = Field(default='', description='pseudonym; "": every subject')


class Study(SceneModel):
    """A study file."""

    bags: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None,
        description='bags, folders with bags anywhere below, or globs, relative to the study file; '
        'or URLs of these',
    )
    attempts: Attempts | None = Field(
        default=None, description='bags of scored attempts: exercise, subject, folder'
    )
    settings: Designs = Field(description='designs: grid, cases, latin_hypercube, sobol')
    reference: dict[SceneKey, JsonValue] | None = Field(
        default=None,
        description='setting whose force all others are compared with, values by dotted scene key; '
        'absent: the recorded force',
    )
    outputs: list[OutputName] = Field(
        default=list(FIGURES), min_length=1, description='columns of the table'
    )
    keep: list[FileName] = Field(
        default=[], description='files kept of each session: force over time, tissue at the end'
    )
    confidence: float = Field(
        default=0.95, ge=0.5, le=0.999, description='level of the intervals, 0.5 to 0.999'
    )

    @model_validator(mode='after')
    def _some_bags(self) -> Self:
        if not self.bags and self.attempts is None:
            raise ValueError('bags is missing: name bags, or attempts by exercise and subject')
        return self


def read_study(path: Path) -> Study:
    """Read and check a study file.

    Raises:
        SceneError: one sentence with file, line, key, value and remedy.
    """
    return read_document(path, Study, 'study', _wrong_values)


def _wrong_values(study: Study) -> list[ErrorDetails]:
    """Return an error for each value of a setting that its scene key cannot have."""
    return [
        ErrorDetails(type='value_error', loc=place, msg=said, input=value, ctx={'error': said})
        for place, key, value in _values(study)
        if (said := _refusal(key, value, sampled='ranges' in place))
    ]


def _values(study: Study) -> Iterator[tuple[tuple[int | str, ...], str, JsonValue]]:
    """Yield the place in the file, the scene key and the value of all that is set."""
    yield from ((('reference', key), key, value) for key, value in (study.reference or {}).items())
    designs, section = study.settings, 'settings'
    for key, values in designs.grid.items():
        yield from (((section, 'grid', key, i), key, value) for i, value in enumerate(values))
    for i, case in enumerate(designs.cases):
        yield from (((section, 'cases', i, key), key, value) for key, value in case.items())
    for name in ('latin_hypercube', 'sobol'):
        sampled: Sampled | None = getattr(designs, name)
        for key, within in sampled.ranges.items() if sampled else ():
            for end in ('low', 'high'):
                yield (section, name, 'ranges', key, end), key, getattr(within, end)


def _refusal(key: str, value: JsonValue, *, sampled: bool) -> str:
    """Return why a scene key cannot have a value, or values around it; '': it can."""
    said = ''
    for field in _fields(key):
        if field.annotation is Path:  # relative to the study file
            return '' if isinstance(value, str) else f'{json.dumps(value)[:60]} is no path'
        kind: Any = Annotated[(field.annotation, field)]
        adapter: TypeAdapter[Any] = TypeAdapter(kind)
        try:
            adapter.validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            if sampled and first['type'].startswith('int'):
                return 'a range gives real values, and this key takes whole ones: use a grid'
            reason = first['msg'][:1].lower() + first['msg'][1:]
            about = f' ({field.description})' if field.description else ''
            said = f'{json.dumps(value)[:60]} is refused: {reason}{about}'
        else:
            return ''
    return said
