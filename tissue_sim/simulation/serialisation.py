"""Serialisation of objects to JSON and bytes, safe against untrusted input.

A tree of objects is walked: plain values, containers, arrays with their shared memory, and objects
of listed classes. Reading creates nothing else, so the input may be untrusted.
"""

import enum
import json
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np

Classes = dict[str, type]
"""By their names with module."""
_KINDS = 'biuf'
"""Of arrays: truth values, integers, unsigned ones, real numbers."""
_MAX_DEPTH = 50
_MAX_EMPTY_AXIS = 64
"""Length of an axis that an array without bytes may have."""


class StateError(ValueError):
    """A serialised state that is not valid."""


@dataclass(frozen=True)
class ObjectState:
    """Serialised objects.

    Attributes:
        tree: JSON: the root, objects with their values, arrays with type, shape and position.
        data: the arrays, little endian, one after the other.
    """

    tree: str
    data: bytes


def classes_of(modules: Iterable[ModuleType]) -> Classes:
    """Return the classes defined in some modules."""
    return {
        _name(value): value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type) and value.__module__ == module.__name__
    }


def _name(kind: type) -> str:
    return f'{kind.__module__}.{kind.__qualname__}'


def capture(root: object, classes: Classes) -> ObjectState:
    """Return the serialised state of an object and of all objects that it refers to.

    Raises:
        StateError: an object has a class that is not listed.
    """
    return _Capture(classes).all(root)


def rebuild(state: ObjectState, classes: Classes, like: object) -> Any:
    """Return the objects of a serialised state.

    Args:
        state: as returned by `capture`.
        classes: allowed classes.
        like: an object of the root's class, created by this code.

    Raises:
        StateError: the state is not valid, or its objects have other fields than this code's.
    """
    own = _fields(json.loads(capture(like, classes).tree))
    try:
        tree = json.loads(state.tree)
        for name, fields in _fields(tree).items():
            if fields != own.get(name, fields):
                differ = ', '.join(sorted(fields ^ own[name]))
                raise StateError(f'it was written by another version: {name} differs in {differ}')
        root = _Rebuild(tree, state.data, classes).value(tree['root'])
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise StateError(f'the recorded state cannot be used: {error}') from None
    if type(root) is not type(like):
        raise StateError(f'the recorded state is that of a {type(root).__name__}')
    return root


def _fields(tree: dict[str, Any]) -> dict[str, set[str]]:
    """Return the field names of objects, by class."""
    return {name: set(values) for name, values in tree['objects']}


class _Capture:
    def __init__(self, classes: Classes) -> None:
        self._classes = classes
        self._objects: list[Any] = []
        self._arrays: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._owners: list[np.ndarray] = []
        self._data: list[bytes] = []
        self._size = 0

    def all(self, root: object) -> ObjectState:
        value = self._value(root)
        tree = {'root': value, 'objects': self._objects, 'arrays': self._arrays}
        return ObjectState(json.dumps(tree), b''.join(self._data))

    def _value(self, value: Any) -> Any:
        match value:
            case enum.Enum():
                return {'enum': [self._class(value), value.value]}
            case np.ndarray():
                return self._view(value)
            case np.generic():
                return {'scalar': self._view(np.array(value))}
            case None | bool() | int() | float() | str():
                return value
            case list():
                return {'list': [self._value(item) for item in value]}
            case tuple() if hasattr(value, '_fields'):
                return {'named': [self._class(value), [self._value(item) for item in value]]}
            case tuple():
                return {'tuple': [self._value(item) for item in value]}
            case deque():
                return {'deque': [[self._value(item) for item in value], value.maxlen]}
            case dict():
                return {'dict': [[self._value(k), self._value(v)] for k, v in value.items()]}
        return {'object': self._object(value)}

    def _class(self, value: object) -> str:
        name = _name(type(value))
        if name not in self._classes:
            raise StateError(f'a {name} is none of the classes that a state may hold')
        return name

    def _object(self, value: object) -> int:
        number = self._numbers.get(id(value))
        if number is None:
            number = self._numbers[id(value)] = len(self._objects)
            entry: list[Any] = [self._class(value), {}]
            self._objects.append(entry)
            entry[1] = {name: self._value(held) for name, held in vars(value).items()}
        return number

    def _view(self, array: np.ndarray) -> Any:
        """Return an array as a view of the array that owns its memory."""
        owner = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        number = self._numbers.get(id(owner))
        if number is None:
            number = self._numbers[id(owner)] = self._own(owner)
        place = array.__array_interface__['data'][0] - owner.__array_interface__['data'][0]
        whole = owner.flags.forc
        if array.dtype != owner.dtype or not (whole or array is owner):
            raise StateError(f'an array of {array.dtype} is a view that cannot be written')
        layout = [list(array.shape), list(array.strides), place]
        return {'array': [number, *layout, array.flags.writeable]}

    def _own(self, owner: np.ndarray) -> int:
        if owner.dtype.kind not in _KINDS:
            raise StateError(f'an array of {owner.dtype} cannot be written')
        fortran = owner.flags.f_contiguous and not owner.flags.c_contiguous
        order: Literal['C', 'F'] = 'F' if fortran else 'C'
        raw = owner.astype(owner.dtype.newbyteorder('<'), copy=False).tobytes(order)
        self._owners.append(owner)  # keeps it alive, so that its id stays unique
        self._arrays.append([owner.dtype.str, list(owner.shape), order, self._size, len(raw)])
        self._data.append(raw)
        self._size += len(raw)
        return len(self._arrays) - 1


class _Rebuild:
    def __init__(self, tree: dict[str, Any], data: bytes, classes: Classes) -> None:
        self._classes = classes
        self._objects = tree['objects']
        self._made: dict[int, Any] = {}
        self._owners = [self._own(data, *entry) for entry in tree['arrays']]

    @staticmethod
    def _own(data: bytes, kind: str, shape: list[int], order: str, at: int, size: int) -> Any:
        dtype = np.dtype(kind)
        count = int(np.prod(shape, dtype=object))
        if dtype.kind not in _KINDS or count * dtype.itemsize != size or at < 0:
            raise StateError(f'an array of {kind} and shape {shape} has {size} bytes')
        _refuse_long(shape, size)
        flat = np.frombuffer(data, dtype, count, at).astype(dtype.newbyteorder('='))
        return flat.reshape(shape, order='F' if order == 'F' else 'C')

    def value(self, value: Any, depth: int = 0) -> Any:
        """Return a value of the tree."""
        if not isinstance(value, dict):
            return value
        if depth > _MAX_DEPTH:
            raise StateError('its objects lie too deep in each other')
        (kind, held), deeper = next(iter(value.items())), depth + 1
        match kind:
            case 'enum':
                return self._enum(*held)
            case 'array':
                return self._view(*held)
            case 'scalar':
                return self.value(held, deeper)[()]
            case 'list':
                return [self.value(item, deeper) for item in held]
            case 'tuple':
                return tuple(self.value(item, deeper) for item in held)
            case 'named':
                made = self._class(held[0])
                if not hasattr(made, '_fields'):
                    raise StateError(f'{held[0]} is no named tuple')
                return made(*(self.value(item, deeper) for item in held[1]))
            case 'deque':
                return deque((self.value(item, deeper) for item in held[0]), held[1])
            case 'dict':
                return {self.value(k, deeper): self.value(v, deeper) for k, v in held}
            case 'object':
                return self._object(held, deeper)
        raise StateError(f'{kind!r} is no kind of value')

    def _class(self, name: str) -> type:
        if name not in self._classes:
            raise StateError(f'{name} is none of the classes that a state may hold')
        return self._classes[name]

    def _enum(self, name: str, value: Any) -> Any:
        kind = self._class(name)
        if not issubclass(kind, enum.Enum):
            raise StateError(f'{name} is no enumeration')
        return kind(value)

    def _object(self, number: int, depth: int) -> Any:
        if number not in self._made:
            name, values = self._objects[number]
            made: Any = object.__new__(self._class(name))
            self._made[number] = made
            vars(made).update({key: self.value(held, depth) for key, held in values.items()})
        return self._made[number]

    def _view(
        self, number: int, shape: list[int], strides: list[int], place: int, writeable: bool
    ) -> np.ndarray:
        owner = self._owners[number]
        array = owner
        if (list(owner.shape), list(owner.strides), 0) != (shape, strides, place):
            array = np.ndarray(shape, owner.dtype, owner.reshape(-1, order='A'), place, strides)
            repeats = any(not by and n > 1 for n, by in zip(shape, strides, strict=True))
            if (repeats and array.size) or array.nbytes > owner.nbytes:
                raise StateError(f'a view of shape {shape} has more than the array it is one of')
            _refuse_long(shape, owner.nbytes)
        if not writeable:
            array = array.view()
            array.flags.writeable = False
        return array


def _refuse_long(shape: list[int], size: int) -> None:
    """Refuse an axis without bytes behind it, such as in (1 << 40, 0)."""
    if max(shape, default=0) > max(size, _MAX_EMPTY_AXIS):
        raise StateError(f'an array of shape {shape} has {size} bytes')
