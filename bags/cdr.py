"""Messages of a bag by the definitions in the bag itself: no ROS, and no matter what is installed.

Limitations: little-endian plain CDR, which is what every RMW of Jazzy sends on the machines that
ROS supports; no `wstring`.
"""

import re
import struct
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from bags.errors import BagError
from bags.message_text import SEPARATOR

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


class _Cursor:
    """A place in the bytes of one message."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = _ENCAPSULATION

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
    """Turns recorded bytes into objects with the fields of their message.

    Arrays of numbers become NumPy arrays that share the bytes, all other arrays lists.

    Args:
        schemas: `ros2msg` text by type, as a bag has them.
    """

    def __init__(self, schemas: Mapping[str, str]) -> None:
        self._schemas = schemas
        self._readers: dict[str, _Read] = {}

    def decode(self, type_name: str, data: bytes) -> Any:
        """The message in CDR bytes, with its encapsulation header.

        Raises:
            BagError: the bag does not define the type, or the bytes are not such a message.
        """
        if type_name not in self._readers:
            self._readers[type_name] = self._compile(type_name)
        if data[:2] != _LITTLE_ENDIAN:
            raise BagError(
                f'a message of type {type_name} is not little-endian plain CDR: it starts with '
                f'{data[:4].hex()}'
            )
        try:
            return self._readers[type_name](_Cursor(data))
        except (struct.error, ValueError, UnicodeDecodeError) as error:
            raise BagError(f'a message of type {type_name} is damaged: {error}') from None

    def _compile(self, type_name: str) -> _Read:
        text = self._schemas.get(type_name)
        if text is None:
            raise BagError(f'the bag does not define the type {type_name}')
        package = type_name.split('/')[0]
        own, *others = text.split(f'{SEPARATOR}\nMSG: ')
        definitions = {'': _fields(own, package)}
        for other in others:
            name, _, body = other.partition('\n')
            definitions[name.strip()] = _fields(body, name.split('/')[0])
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


def _structure(
    name: str, definitions: Mapping[str, list[_Field]], known: dict[str, _Read]
) -> _Read:
    if name not in definitions:
        raise BagError(f'the bag uses the type {name} and does not define it')
    if name not in known:
        parts = [(f.name, _value(f, definitions, known)) for f in definitions[name]]

        def read(cursor: _Cursor) -> SimpleNamespace:
            if not parts:  # a structure without members has one byte on the wire
                cursor.at += 1
            return SimpleNamespace(**{field: part(cursor) for field, part in parts})

        known[name] = read
    return known[name]


def _value(
    field: _Field, definitions: Mapping[str, list[_Field]], known: dict[str, _Read]
) -> _Read:
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
    fixed = field.length
    return lambda cursor: [item(cursor) for _ in range(_count(cursor) if fixed < 0 else fixed)]


def _number(code: struct.Struct) -> _Read:
    def read(cursor: _Cursor) -> Any:
        at = cursor.align(code.size)
        cursor.at += code.size
        return code.unpack_from(cursor.data, at)[0]

    return read


def _numbers(dtype: 'np.dtype[Any]', fixed: int) -> _Read:
    def read(cursor: _Cursor) -> Any:
        count = _count(cursor) if fixed < 0 else fixed
        if count == 0:  # nothing is aligned for nothing
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
