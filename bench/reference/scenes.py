"""Writes the tables of docs/scenes.md from the models that check a scene.

Run as `python -m bench.reference.scenes` in the checkout after a change of the models.
"""

import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.node_common.scene_reader import SECTIONS
from cutting_trainer.node_common.share_folder import PACKAGES
from cutting_trainer.session.scene_loader import SessionSettings
from cutting_trainer.tissue_sim.material_presets import PresetName
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

MODELS: dict[str, type[BaseModel]] = {
    'tissue': TissueSettings,
    'tool': ToolSettings,
    'device': DeviceSettings,
    'haptics': HapticsSettings,
    'cutting': CuttingSettings,
    'arm': ArmSettings,
    'session': SessionSettings,
    'exercise': ExerciseSettings,
}
FILE = PACKAGES / 'docs' / 'scenes.md'
MARK = '<!-- Below: written by `python -m bench.reference.scenes` from the models. -->\n'
EXPLAINED = {
    'tissue.material.preset': '[material](materials.md) that fills in the values not given',
    'tissue.model': '[elastic model](method.md#choose-a-model)',
    'tissue.contact': '[load of the tool](method.md#contact)',
    'tissue.integrator': '[integrator](method.md#motion)',
    'haptics.extrapolation': '[force between two frames](haptics.md#from-pose-to-force)',
    'haptics.forces': "[tissue's reaction, or force of the spring](haptics.md#two-forces-or-one)",
    'cutting.method': '[method of cutting](cutting.md)',
}
"""Keys whose choices a page explains, and the link to it."""
_RANGE = re.compile(r', (each |above )?-?[\d.e]+ to (below )?-?[\d.e]*\d')


@dataclass(frozen=True)
class Key:
    """One key of a section.

    Attributes:
        name: dotted, from the section on; [] after lists.
        value: allowed values.
        default: value of a missing key.
        meaning: with the unit.
    """

    name: str
    value: str
    default: str
    meaning: str


def reference() -> str:
    """Return the tables of all sections; keys of the same name and meaning share a row."""
    parts = []
    for section in SECTIONS:
        parts.append(f'## `{section}`\n')
        parts.append('| key | value; default | meaning |\n|---|---|---|')
        alike: dict[tuple[str, str, str], list[Key]] = {}
        for key in keys(MODELS[section], ''):
            leaf = key.name.rpartition('.')[2]
            alike.setdefault((leaf, key.value, key.meaning), []).append(key)
        for same in alike.values():
            first = same[0]
            names = ', '.join(f'`{key.name}`' for key in same)
            meaning = EXPLAINED.get(f'{section}.{first.name}', first.meaning)
            value = f'{first.value}; {first.default}' if first.default else first.value
            parts.append(f'| {names} | {value} | {meaning} |')
        parts[-1] += '\n'
    return '\n'.join(parts)


def keys(model: type[BaseModel], prefix: str) -> Iterator[Key]:
    """Yield the keys of a model and, after each, those of the model within it."""
    for name, field in model.model_fields.items():
        inner, many = _inner(field.annotation)
        dotted = f'{prefix}{name}' + ('[]' if many else '')
        meaning = _meaning(field.description or (inner and inner.__doc__) or '')
        value = ('list' if many else 'mapping') if inner else _value(field, meaning)
        if not (isinstance(field.default, BaseModel) and field.description):  # its keys say it
            yield Key(dotted, value, _default(field), meaning)
        if inner:
            yield from keys(inner, f'{dotted}.')


def _inner(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """Return the model that an annotation holds, and whether it holds a list of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    many = get_origin(annotation) is tuple
    for argument in get_args(annotation):
        model, _ = _inner(argument)
        if model:
            return model, many
    return None, False


def _meaning(text: str) -> str:
    """Return the first paragraph, without the range, which has its column."""
    return ' '.join(_RANGE.sub('', text).replace(' [-]', '').split('\n\n')[0].split())


def _value(field: FieldInfo, meaning: str) -> str:
    if field.annotation == PresetName | None:
        return 'name'
    kinds = [kind for kind in _alternatives(field.annotation) if kind is not type(None)]
    (kind,) = kinds
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        return ', '.join(f'`{choice}`' for choice in choices)
    if get_origin(kind) is tuple:
        item = get_args(kind)[0]
        if str in (item, getattr(item, '__origin__', None)):
            return 'words'
        if get_origin(item) is tuple:
            return 'points'
        if get_origin(getattr(item, '__origin__', None)) is tuple:
            return 'pairs of numbers'
        limits = _limits(item.__metadata__[0].metadata) if hasattr(item, '__metadata__') else ''
        return f'{len(get_args(kind))} numbers' + (f' {limits}' if limits else '')
    names = {float: 'number', int: 'integer', str: 'word', bool: 'boolean'}
    limits = '' if kind is int and _any_int32(field.metadata) else _limits(field.metadata)
    return limits or names.get(kind, 'path')


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    united = get_origin(annotation) in (typing.Union, types.UnionType)
    return get_args(annotation) if united else (annotation,)


def _any_int32(metadata: list[Any]) -> bool:
    return any(getattr(limit, 'ge', None) == -(2**31) for limit in metadata)


def _limits(metadata: list[Any]) -> str:
    """Return the allowed numbers as an interval; a round bracket leaves its end out."""
    ends = {
        name: f'{getattr(limit, name):g}'
        for limit in metadata
        for name in ('gt', 'ge', 'lt', 'le')
        if hasattr(limit, name)
    }
    if not ends:
        return ''
    low = f'({ends["gt"]}' if 'gt' in ends else f'[{ends["ge"]}'
    high = f'{ends["lt"]})' if 'lt' in ends else f'{ends["le"]}]'
    return f'{low}, {high}'


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return 'required'
    if field.default in (None, '', ()) or isinstance(field.default, BaseModel):
        return ''
    if isinstance(field.default, tuple):
        return f'`[{", ".join(f"{number:g}" for number in field.default)}]`'
    if isinstance(field.default, bool):
        return f'`{field.default}`'.lower()
    number = isinstance(field.default, float)
    return f'`{field.default:g}`' if number else f'`{field.default}`'


def main() -> None:
    """Write the tables into the file."""
    head = FILE.read_text(encoding='utf-8').partition(MARK)[0]
    FILE.write_text(f'{head}{MARK}\n{reference()}', encoding='utf-8')


if __name__ == '__main__':
    main()
