"""Generator of invalid messages, from the structure of their type."""

import math
import random
import re
import struct
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_class import message_class

Kind = Literal['made', 'changed', 'overwritten', 'garbled']
KINDS: tuple[Kind, ...] = ('made', 'changed', 'overwritten', 'garbled')
ODD = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e9, 5e-324, 2.2e-308, -0.0, 0.0, 1.0, 1e-3)
"""Impossible, improbable and valid numbers."""
EDGES = (0, 1, 2, 3, 7, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
WORDS = (
    *('tissue', 'arm_base', 'ENABLED', 'DISABLED', 'FAULT', 'PAUSED', 'enable', 'disable', 'pause'),
    *('resume', 'home', 'unhome', 'e_stop', 'rate', 'nan', '-inf', '1e999', '', 'x' * 300, '%s%n'),
    *('\x1b[31m\n\r', 'na\u00efve \U0001f52a', '../../etc', 'haptic_bridge', '{}', 'x' * 20_000),
)
LENGTHS = (0, 0, 1, 1, 2, 3, 7, 12, 100, 5000)
_SIZES = {'int8': 8, 'uint8': 8, 'int16': 16, 'uint16': 16, 'int32': 32, 'uint32': 32}
_SIZES |= {'int64': 64, 'uint64': 64}
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, (\d+))?>')
_ARRAY = re.compile(r'(.+)\[(\d+)\]')
_HEAD = b'\0\1\0\0'
_MAX_DEPTH = 4


class Maker:
    """Generator of messages of any type.

    Args:
        seed: seed of all random numbers.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)  # faster than numpy's for one number at a time
        self._arrays = np.random.default_rng(seed)

    def message(self, kind: Kind, message_type: Any, heard: list[bytes]) -> bytes:
        """Return a message of a kind, in CDR.

        Args:
            kind: `made` anew field by field; or of one that was heard: some fields `changed`, some
                aligned numbers `overwritten`, or bytes cut off, added, flipped (`garbled`).
            message_type: class of the message.
            heard: valid messages, if there are any.
        """
        if kind == 'made' or not heard:
            data = serialize_message(self.made(message_type))
            return self._garbled(data) if kind == 'garbled' else data
        data = heard[self._below(len(heard))]
        if kind == 'changed':
            message = deserialize_message(data, message_type)
            for _ in range(1 + self._below(3)):
                self._change(message, 0)
            return serialize_message(message)
        return self._overwritten(data) if kind == 'overwritten' else self._garbled(data)

    def made(self, message_type: Any, depth: int = 0) -> Any:
        """Return a message with random fields."""
        message = message_type()
        for name, kind in message_type.get_fields_and_field_types().items():
            setattr(message, name, self._value(kind, getattr(message, name), depth))
        return message

    def _below(self, end: int) -> int:
        return self._random.randrange(end)

    def _one(self, values: tuple[Any, ...]) -> Any:
        return values[self._below(len(values))]

    def _change(self, message: Any, depth: int) -> None:
        """Replace one random field of a message."""
        fields = list(message.get_fields_and_field_types().items())
        if not fields:
            return
        name, kind = fields[self._below(len(fields))]
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types') and depth < _MAX_DEPTH:
            self._change(value, depth + 1)
        elif isinstance(value, np.ndarray) or (hasattr(value, 'typecode') and len(value)):
            value[self._below(len(value))] = self._number(kind)
        else:
            setattr(message, name, self._value(kind, value, depth))

    def _number(self, kind: str) -> Any:
        element = _element(kind)
        return self._integer(element) if element in _SIZES else self._one(ODD)

    def _integer(self, kind: str) -> int:
        bits = _SIZES[kind]
        value = self._one(EDGES) if self._below(2) else self._below(2**31)
        value %= 2**bits
        return value if kind[0] == 'u' or value < 2 ** (bits - 1) else value - 2**bits

    def _value(self, kind: str, now: Any, depth: int) -> Any:
        if kind in _SIZES:
            return self._integer(kind)
        drawn: dict[str, Callable[[], Any]] = {
            'double': lambda: self._one(ODD),
            'float': lambda: self._one(ODD),
            'boolean': lambda: bool(self._below(2)),
            'octet': lambda: bytes([self._below(256)]),
            'string': lambda: self._one(WORDS),
        }
        if kind in drawn:
            return drawn[kind]()
        if match := _ARRAY.fullmatch(kind):
            return self._many(match[1], int(match[2]), depth)
        if match := _SEQUENCE.fullmatch(kind):
            most = int(match[2] or sys.maxsize)
            return self._many(match[1], min(self._one(LENGTHS), most), depth)
        return self.made(type(now), depth + 1)

    def _many(self, kind: str, count: int, depth: int) -> Any:
        """Return random values of one type; most numbers are valid."""
        if kind in ('double', 'float'):
            values = self._arrays.normal(scale=0.01, size=count)
            if count and self._below(4):
                values[self._below(count)] = self._one(ODD)
            return values if count else []
        if kind in _SIZES:
            small = self._arrays.integers(100, size=count)
            return [*small[1:].tolist(), self._integer(kind)] if count else []
        count = min(count, 12 if depth < _MAX_DEPTH else 0)
        if '/' in kind:
            return [self.made(nested_class(kind), depth + 1) for _ in range(count)]
        return [self._value(kind, None, depth) for _ in range(count)]

    def _overwritten(self, data: bytes) -> bytes:
        """Return a copy with some aligned numbers replaced."""
        out = bytearray(data)
        for _ in range(1 + self._below(3)):
            wide = bool(self._below(2))
            size = 8 if wide else 4
            slots = (len(out) - len(_HEAD)) // size
            if slots < 1:
                return self._garbled(data)
            number = self._one(ODD) if wide and self._below(4) else self._one(EDGES)
            code = '<d' if isinstance(number, float) else '<Q' if wide else '<I'
            value = number if isinstance(number, float) else number % 2 ** (8 * size)
            struct.pack_into(code, out, len(_HEAD) + size * self._below(slots), value)
        return bytes(out)

    def _garbled(self, data: bytes) -> bytes:
        way = self._below(6)
        at = self._below(len(data) + 1)
        if way == 0:
            return data[:at]
        if way == 1:
            return data + self._random.randbytes(1 + self._below(64))
        if way == 2:
            return _HEAD + self._random.randbytes(self._below(400))
        if way == 3:
            return self._random.randbytes(1 + self._below(400))
        if way == 4:
            return self._random.randbytes(4) + data[4:]
        return data[:at] + self._random.randbytes(8) + data[at + 8 :]


def huge(message_type: Any, size: int) -> bytes | None:
    """Return a message of a size [bytes], by its first text or sequence; None: it has none.

    Args:
        message_type: its class.
        size: [bytes].
    """
    message = message_type()
    return serialize_message(message) if _stretch(message, size, 0) else None


def _stretch(message: Any, size: int, depth: int) -> bool:
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if kind == 'string':
            setattr(message, name, 'x' * size)
            return True
        if hasattr(value, 'typecode'):
            value.frombytes(bytes(size // value.itemsize * value.itemsize))
            return True
        if hasattr(value, 'get_fields_and_field_types') and _stretch(value, size, depth + 1):
            return True
        match = _SEQUENCE.fullmatch(kind)
        if match and '/' in match[1] and depth < _MAX_DEPTH:
            inner = nested_class(match[1])()
            if _stretch(inner, size, depth + 1):
                setattr(message, name, [inner])
                return True
    return False


def _element(kind: str) -> str:
    match = _ARRAY.fullmatch(kind) or _SEQUENCE.fullmatch(kind)
    return match[1] if match else kind


@lru_cache
def nested_class(name: str) -> Any:
    """Return the class of a field's type, `package/Type`, including types of services."""
    package, _, type_name = name.partition('/')
    try:
        return message_class(f'{package}/msg/{type_name}')
    except BagError:
        return message_class(f'{package}/srv/{type_name}')
