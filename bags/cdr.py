"""Decoder of CDR messages by the definitions in the bag itself; no ROS, no installed packages.

Limitations: little-endian plain CDR, the only kind that an RMW of Jazzy sends on the machines that
ROS supports; no `wstring`.
"""

import re
import struct
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_text import SEPARATOR

_LITTLE_ENDIAN = b'\x00\x01'
_ENCAPSULATION = 4
_SIZES = {
    **{'bool': '?', 'byte': 'u1', 'char': 'u1', 'float32': '<f4', 'float64': '<f8'},
    **{f'int{8 * n}': f'<i{n}' for n in (1, 2, 4, 8)},
    **{f'uint{8 * n}': f'<u{n}' for n in (1, 2, 4, 8)},
}
_CODES = {
    **{'bool': '?', 'byte': 'B', 'char': 'B', 'float32': 'f', 'float64': 'd'},
    **{'int8': 'b', 'int16': 'h', 'int32': 'i', 'int64': 'q'},
    **{'uint8': 'B', 'uint16': 'H', 'uint32': 'I', 'uint64': 'Q'},
}
_FIELD = re.compile(
    r'^\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<count>(?:<=)?\d*)\])?'
    r'\s+(?P<name>[A-Za-z]\w*)(?P<constant>\s*=)?'
)


MAX_DEFINITION = 1 << 20
"""Characters of a type's definition, contained types included; our longest has 9,000."""
MAX_NESTING = 32
"""Levels of nested structures."""
MAX_VALUES = 1 << 20
"""Python objects of one message; an array of numbers counts as one."""


class MissingFieldError(BagError, AttributeError):
    """A field is read that the bag's definition of the message does not have."""


class Decoded(SimpleNamespace):
    """A message with the fields of its definition."""

    def __getattr__(self, name: str) -> Any:
        raise MissingFieldError(
            f'a message of the bag has no field {name}: its definition is another'
        )


class _Cursor:
    """A read position in the bytes of one message, with a count of the objects made so far."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = _ENCAPSULATION
        self.values = 0

    def make(self, values: int, min_size: int = 0) -> None:
        """Count objects to be created from at least `min_size` bytes each."""
        self.values += values
        if values * min_size > len(self.data) - self.at:
            raise ValueError(f'{values} values go beyond its end')
        if self.values > MAX_VALUES:
            raise ValueError(f'it has more than {MAX_VALUES} values')

    def align(self, size: int) -> int:
        self.at += (_ENCAPSULATION - self.at) % size
        return self.at


_Read = Callable[[_Cursor], Any]


class _Field(NamedTuple):
    """One line of a definition; `length` is None for a single value and -1 for a sequence."""

    name: str
    type: str
    length: int | None


class Decoder:
    """Decodes recorded bytes to objects with the fields of their message.

    Arrays of numbers become NumPy arrays that share the bytes, all other arrays lists.

    Args:
        schemas: `ros2msg` text by type, from the bag.
    """

    def __init__(self, schemas: Mapping[str, str]) -> None:
        self._schemas = schemas
        self._readers: dict[str, _Read] = {}

    def decode(self, type_name: str, data: bytes) -> Any:
        """Return the message in CDR bytes, with its encapsulation header.

        Raises:
            BagError: the bag does not define the type, or the bytes do not fit it.
        """
        if data[:2] != _LITTLE_ENDIAN:
            raise BagError(
                f'a message of type {type_name[:80]} is not little-endian plain CDR: it starts '
                f'with {data[:4].hex()}'
            )
        try:
            if type_name not in self._readers:
                self._readers[type_name] = self._compile(type_name)
            return self._readers[type_name](_Cursor(data))
        except BagError:
            raise
        except (struct.error, ValueError, OverflowError) as error:
            raise BagError(f'a message of type {type_name[:80]} is damaged: {error}') from None

    def _compile(self, type_name: str) -> _Read:
        text = self._schemas.get(type_name)
        if text is None:
            raise BagError(f'the bag does not define the type {type_name[:80]}')
        if len(text) > MAX_DEFINITION:
            raise BagError(f'the definition of {type_name[:80]} has {len(text)} characters')
        package = type_name.split('/')[0]
        own, *others = text.split(f'{SEPARATOR}\nMSG: ')
        definitions = {'': _fields(own, package)}
        for other in others:
            name, _, body = other.partition('\n')
            definitions[name.strip()] = _fields(body, name.split('/')[0])
        _check_nesting('', definitions, (), {})
        return _structure('', definitions, {})


def _fields(text: str, package: str) -> list[_Field]:
    found = []
    for line in text.splitlines():
        match = _FIELD.match(line.partition('#')[0])
        if not match or match['constant']:
            continue
        count = None if match['array'] is None else -1
        if match['count'] and match['count'].isdigit():
            count = int(match['count'])
        found.append(_Field(match['name'], _full_name(match['type'], package), count))
    return found


def _full_name(name: str, package: str) -> str:
    if name in _CODES or name == 'string':
        return name
    parts = name.split('/')
    return f'{parts[0] if len(parts) > 1 else package}/{parts[-1]}'


def _check_nesting(
    name: str,
    definitions: Mapping[str, list[_Field]],
    above: tuple[str, ...],
    known: dict[str, int],
) -> int:
    """Return the depth of nested structures of a type, itself included."""
    if name in above:
        raise BagError(f'the definition of {name[:80] or above[-1][:80]} contains itself')
    if name not in known:
        above = (*above, name)
        inner = {f.type for f in definitions.get(name, ()) if f.type in definitions}
        depths = [MAX_NESTING]
        if len(above) <= MAX_NESTING:
            depths = [_check_nesting(each, definitions, above, known) for each in inner]
        known[name] = 1 + max(depths, default=0)
    if known[name] > MAX_NESTING:
        raise BagError(
            f'the definition of {name[:80]} has more than {MAX_NESTING} types within one another'
        )
    return known[name]


def _structure(
    name: str, definitions: Mapping[str, list[_Field]], known: dict[str, _Read]
) -> _Read:
    if name not in definitions:
        raise BagError(f'the bag uses the type {name[:80]} and does not define it')
    if name not in known:
        fields = definitions[name]
        parts = [(f.name, _value(f, definitions, known)) for f in fields]

        def read(cursor: _Cursor) -> Decoded:
            cursor.make(len(parts))
            if not parts:  # a structure without members has one byte on the wire
                cursor.make(1, min_size=1)
                cursor.at += 1
            return Decoded(**{field: part(cursor) for field, part in parts})

        known[name] = read
    return known[name]


def _value(
    field: _Field, definitions: Mapping[str, list[_Field]], known: dict[str, _Read]
) -> _Read:
    if field.length == 0:
        raise BagError(f'the field {field.name[:80]} is an array without elements')
    if field.length is not None and field.type in _CODES:
        return _numbers(np.dtype(_SIZES[field.type]), field.length)
    if field.type in _CODES:
        item = _number(struct.Struct(f'<{_CODES[field.type]}'))
    elif field.type == 'string':
        item = _string
    else:
        item = _structure(field.type, definitions, known)
    if field.length is None:
        return item
    return _list(item, field.length)


def _list(item: _Read, fixed: int) -> _Read:
    def read(cursor: _Cursor) -> list[Any]:
        count = _count(cursor) if fixed < 0 else fixed
        cursor.make(count, min_size=1)  # every element takes at least a byte
        return [item(cursor) for _ in range(count)]

    return read


def _number(code: struct.Struct) -> _Read:
    def read(cursor: _Cursor) -> Any:
        at = cursor.align(code.size)
        cursor.at += code.size
        return code.unpack_from(cursor.data, at)[0]

    return read


def _numbers(dtype: 'np.dtype[Any]', fixed: int) -> _Read:
    def read(cursor: _Cursor) -> Any:
        count = _count(cursor) if fixed < 0 else fixed
        if count == 0:  # an empty array has no alignment
            return np.empty(0, dtype)
        at = cursor.align(dtype.itemsize)
        cursor.at += count * dtype.itemsize
        return np.frombuffer(cursor.data, dtype, count, at)

    return read


_count = _number(struct.Struct('<I'))


def _string(cursor: _Cursor) -> str:
    length = _count(cursor)
    begin = cursor.at
    cursor.at += length
    if cursor.at > len(cursor.data):
        raise ValueError(f'a string of {length} bytes goes beyond its end')
    return cursor.data[begin : max(begin, cursor.at - 1)].decode()
