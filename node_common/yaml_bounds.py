"""Bounds on untrusted YAML, checked before any value is built.

Aliases can turn a few lines into billions of values, and nesting can exceed Python's stack. Both
are found from the parser's events, one by one, at no cost.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MAX_BYTES = 1 << 18
"""Size of a scene or device file; the largest one shipped has 7 kB."""
MAX_VALUES = 10_000
"""Keys, values and lists of a file; those repeated by an alias count each time."""
MAX_DEPTH = 32
"""Nesting of mappings and lists."""

MAX_KEY_LENGTH = 200
"""Characters of a key."""


class YamlBoundError(ValueError):
    """A file that exceeds a bound.

    Args:
        line: line number from 1; 0 for the whole file.
        reason: the exceeded bound and the remedy.
    """

    def __init__(self, line: int, reason: str) -> None:
        super().__init__(reason)
        self.line = line
        self.reason = reason

    def of(self, path: Path | str) -> str:
        """Return the sentence for a file."""
        return f'{path}:{self.line}: {self.reason}' if self.line else f'{path}: {self.reason}'


@dataclass
class _Collection:
    """An open mapping or list.

    Attributes:
        anchor: its name for aliases, or None.
        mapping: whether it has keys.
        values: values so far, itself included.
        children: children so far.
        keys: of a mapping, with their lines.
    """

    anchor: str | None
    mapping: bool
    values: int = 1
    children: int = 0
    keys: dict[str, int] = field(default_factory=dict)


def read_bounded(path: Path, most: int = MAX_BYTES) -> str:
    """Read a text file of limited size.

    Raises:
        YamlBoundError: it is larger, or no file.
        OSError, UnicodeDecodeError: it cannot be read.
    """
    with path.open('rb') as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise YamlBoundError(0, f'the file is larger than {most} bytes: that is no settings file')
    return data.decode('utf-8')


def check_events(events: Iterable[Any], most: int = MAX_VALUES, *, complete: bool = False) -> None:
    """Check the events of a parser, up to the first that exceeds a bound.

    Args:
        events: of PyYAML or ruamel.yaml, as an iterator.
        most: largest number of values, with those repeated by aliases.
        complete: refuse duplicate keys and values that contain themselves; unset where the reader
            of the values reports them better.

    Raises:
        YamlBoundError: there is too much, or a value contains itself.
    """
    total, sizes = 0, dict[str, int]()
    inside: list[_Collection] = []
    for event in events:
        kind, line = type(event).__name__, event.start_mark.line + 1
        if kind in ('MappingStartEvent', 'SequenceStartEvent'):
            _place(inside, None, line, complete)
            inside.append(_Collection(event.anchor, kind[0] == 'M'))
            if len(inside) > MAX_DEPTH:
                text = f'values are nested more than {MAX_DEPTH} deep: write them flatter'
                raise YamlBoundError(line, text)
            size = 0
        elif kind in ('MappingEndEvent', 'SequenceEndEvent'):
            ended = inside.pop()
            if ended.anchor is not None:
                sizes[ended.anchor] = ended.values
            if inside:
                inside[-1].values += ended.values
            continue
        elif kind == 'AliasEvent':
            if complete and any(parent.anchor == event.anchor for parent in inside):
                text = f'*{event.anchor} contains itself by an alias: write the values out'
                raise YamlBoundError(line, text)
            _place(inside, None, line, complete)
            size = sizes.get(event.anchor, 1)
        elif kind == 'ScalarEvent':
            _place(inside, event.value, line, complete)
            size = 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        else:
            continue
        total += size or 1
        if inside:
            inside[-1].values += size
        if total > most:
            text = f'more than {most} values, those that aliases repeat counted: write fewer'
            raise YamlBoundError(line, text)


def _place(inside: list[_Collection], word: str | None, line: int, complete: bool) -> None:
    """Add a key or value to its collection; refuse a duplicate key."""
    if not inside:
        return
    within = inside[-1]
    is_key = within.mapping and within.children % 2 == 0
    within.children += 1
    if is_key and word is not None and len(word) > MAX_KEY_LENGTH:
        text = f'a key of {len(word)} characters: {MAX_KEY_LENGTH} at most'
        raise YamlBoundError(line, text)
    if complete and is_key and word is not None:
        if word in within.keys:
            first = within.keys[word]
            text = f'{word[:60]} is given twice, first in line {first}: delete one of them'
            raise YamlBoundError(line, text)
        within.keys[word] = line
