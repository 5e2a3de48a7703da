"""Place of an error in a YAML file: its line, its key, and a sentence that states the remedy."""

import difflib
import json
import types
import typing
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode


@dataclass(frozen=True)
class SectionPlace:
    """One section of one file; turns the errors of its model into sentences."""

    path: Path
    section: str
    node: Node
    model: type[BaseModel]

    def locate(self, loc: tuple[int | str, ...]) -> tuple[int, tuple[str, ...]]:
        """Return line and key path of an error.

        Parts of `loc` that name a model are skipped.
        """
        node, line, keys = self.node, line_of(self.node), [self.section] if self.section else []
        for part in loc:
            found = _key_and_value(node, part)
            if found is not None:
                line, node = line_of(found[0]), found[1]
                keys.append(str(part))
        return line, tuple(keys)

    def sentence(self, error: ErrorDetails) -> str:
        """Return file, line, key, value and remedy of an error."""
        line, keys = self.locate(error['loc'])
        models, field = _described(self.model, error['loc'])
        about = f' ({field.description})' if field is not None and field.description else ''
        head = f'{self.path}:{line}: {dotted(keys) or "the file"}'
        if error['type'] == 'missing':
            return f'{head} is {shortened(error["input"])}: {error["loc"][-1]} is missing{about}'
        if error['type'] == 'extra_forbidden':
            known = list(dict.fromkeys(name for m in models for name in m.model_fields))
            near = nearest(keys[-1], known)
            hint = f'did you mean {near}?' if near else f'known are {", ".join(known)}'
            return f'{head} is not a key here: {hint}'
        if error['type'] in ('value_error', 'assertion_error'):
            return f'{head}: {error["ctx"]["error"]}'
        reason = error['msg'][:1].lower() + error['msg'][1:]
        return f'{head} is {shortened(error["input"])}: {reason}{about}'


def most_helpful(place: SectionPlace, errors: list[ErrorDetails]) -> str:
    """Return the first error; unknown keys come before other errors, parts before their whole.

    An unknown key often explains a missing one, and a bad item a list that is too short.
    """

    def rank(error: ErrorDetails) -> tuple[bool, bool, int]:
        loc = error['loc']
        whole = any(other['loc'][: len(loc)] == loc != other['loc'] for other in errors)
        return error['type'] != 'extra_forbidden', whole, place.locate(loc)[0]

    return place.sentence(min(errors, key=rank))


def _described(
    model: type[BaseModel], loc: tuple[int | str, ...]
) -> tuple[list[type[BaseModel]], FieldInfo | None]:
    """Return the models that have the last part of `loc` as a key, and its field or the last
    known.
    """
    models, field = [model], None
    for i, part in enumerate(loc):
        fields = [m.model_fields[part] for m in models if part in m.model_fields]
        if not fields:
            narrowed = [m for m in models if m.__name__ == part]
            models = narrowed or models
            continue
        field = fields[0]
        inner = [m for f in fields for m in models_in(f.annotation)]
        if i + 1 < len(loc):
            models = inner or models
    return models, field


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models within the type of a field."""
    if isinstance(annotation, types.GenericAlias) or typing.get_origin(annotation) is not None:
        for argument in typing.get_args(annotation):
            yield from models_in(argument)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation


def _key_and_value(node: Node, part: int | str) -> tuple[Node, Node] | None:
    if isinstance(node, MappingNode):
        return next(((k, v) for k, v in node.value if str(k.value) == str(part)), None)
    if isinstance(node, SequenceNode) and isinstance(part, int) and part < len(node.value):
        return node.value[part], node.value[part]
    return None


def child_of(node: Node, key: str) -> Node | None:
    """Return the value of a key of a mapping, None where there is none."""
    found = _key_and_value(node, key)
    return found[1] if found else None


def line_of(node: Node) -> int:
    """Return the line of a value in its file, from 1."""
    return int(node.start_mark.line) + 1


def kind_of(node: Node) -> str:
    """Return the kind of a value in words."""
    if isinstance(node, MappingNode):
        return 'mapping'
    return 'list' if isinstance(node, SequenceNode) else 'single value'


def dotted(keys: Iterable[int | str]) -> str:
    """Return a path of keys with dots between them."""
    return '.'.join(str(key) for key in keys)


def shortened(value: Any) -> str:
    """Return a value as in YAML, of 60 characters at most."""
    text = json.dumps(value, default=str) if not isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else text[:57] + '...'


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word most similar to a misspelt one, or None."""
    matches = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return matches[0] if matches else None
