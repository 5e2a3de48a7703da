"""Writes the tables of docs/scenes.md from the models that check a scene.

Run as `python -m session.scene_reference` in the checkout after a change of the models.
"""

import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cutting.settings import CuttingSettings
from haptic_bridge.arm_settings import ArmSettings
from haptic_bridge.settings import DeviceSettings, HapticsSettings, ToolSettings
from session.scene import SessionSettings
from tissue_sim.scene_file import SECTIONS
from tissue_sim.settings import TissueSettings
from tissue_sim.share import PACKAGES

MODELS: dict[str, type[BaseModel]] = {
    'tissue': TissueSettings,
    'tool': ToolSettings,
    'device': DeviceSettings,
    'haptics': HapticsSettings,
    'cutting': CuttingSettings,
    'arm': ArmSettings,
    'session': SessionSettings,
}
FILE = PACKAGES / 'docs' / 'scenes.md'
MARK = '<!-- Below: written by `python -m session.scene_reference` from the models. -->\n'
_RANGE = re.compile(r', (each |above )?-?[\d.e]+ to (below )?-?[\d.e]*\d')


@dataclass(frozen=True)
class Key:
    """One key of a section.

    Attributes:
        name: dotted, from the section on; [] after what is a list.
        value: what it takes.
        default: what it is when left out.
        meaning: with the unit.
    """

    name: str
    value: str
    default: str
    meaning: str


def reference() -> str:
    """The tables of all sections."""
    parts = []
    for section in SECTIONS:
        parts.append(f'## `{section}`\n')
        parts.append('| key | value | default | meaning |\n|---|---|---|---|')
        for key in keys(MODELS[section], ''):
            parts.append(f'| `{key.name}` | {key.value} | {key.default} | {key.meaning} |')
        parts[-1] += '\n'
    return '\n'.join(parts)


def keys(model: type[BaseModel], prefix: str) -> Iterator[Key]:
    """The keys of a model and, after each, those of the model within it."""
    for name, field in model.model_fields.items():
        inner, many = _inner(field.annotation)
        dotted = f'{prefix}{name}' + ('[]' if many else '')
        meaning = _RANGE.sub('', field.description or (inner and inner.__doc__) or '')
        value = ('list of mappings' if many else 'mapping') if inner else _value(field)
        yield Key(dotted, value, _default(field), ' '.join(meaning.split('\n\n')[0].split()))
        if inner:
            yield from keys(inner, f'{dotted}.')


def _inner(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The model that an annotation holds, and whether it holds a list of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    many = get_origin(annotation) is tuple
    for argument in get_args(annotation):
        model, _ = _inner(argument)
        if model:
            return model, many
    return None, False


def _value(field: FieldInfo) -> str:
    kinds = [kind for kind in _alternatives(field.annotation) if kind is not type(None)]
    (kind,) = kinds
    if get_origin(kind) is Literal:
        return ', '.join(f'`{choice}`' for choice in get_args(kind))
    if get_origin(kind) is tuple:
        item = get_args(kind)[0]
        limits = _limits(item.__metadata__[0].metadata) if hasattr(item, '__metadata__') else ''
        return f'{len(get_args(kind))} numbers' + (f', each {limits}' if limits else '')
    names = {float: 'number', int: 'whole number', str: 'word', bool: '`true`, `false`'}
    return _limits(field.metadata) or names.get(kind, 'path')


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    united = get_origin(annotation) in (typing.Union, types.UnionType)
    return get_args(annotation) if united else (annotation,)


def _limits(metadata: list[Any]) -> str:
    words = {'gt': 'above ', 'ge': '', 'lt': 'below ', 'le': ''}
    ends = {
        name: f'{word}{getattr(limit, name):g}'
        for limit in metadata
        for name, word in words.items()
        if hasattr(limit, name)
    }
    return ' to '.join(ends[name] for name in words if name in ends)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return 'required'
    if field.default in (None, '', ()) or isinstance(field.default, BaseModel):
        return ''
    if isinstance(field.default, tuple):
        return f'`[{", ".join(f"{number:g}" for number in field.default)}]`'
    number = isinstance(field.default, float)
    return f'`{field.default:g}`' if number else f'`{field.default}`'


def main() -> None:
    """Writes the tables into the file."""
    head = FILE.read_text(encoding='utf-8').partition(MARK)[0]
    FILE.write_text(f'{head}{MARK}\n{reference()}', encoding='utf-8')


if __name__ == '__main__':
    main()
