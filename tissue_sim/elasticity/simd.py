"""Vectors of four numbers in kernels: three components and a spare lane.

The compiler does not recognise the three rows of a 3x3 tensor as vectors: with explicit vectors, a
force evaluation takes 0.6 of the time. The operations exist in every processor's vector registers,
so the module is portable. Arrays are contiguous; indices are unsigned and not checked.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import models, register_model

from cutting_trainer.node_common.kernels import inner, operation

_DOUBLE, _INT, _BYTE = ir.DoubleType(), ir.IntType(32), ir.IntType(8)
_FOUR, _TWO = ir.VectorType(_DOUBLE, 4), ir.VectorType(_DOUBLE, 2)


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name='Vector')


_VECTOR = _VectorType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _FOUR)


def _at(context: Any, builder: Any, array: tuple[Any, Any], index: Any, kind: Any) -> Any:
    """Return the pointer to an element of a contiguous array, given by type and value."""
    of = array[0]
    assert of.layout == 'C' and of.ndim == 1 and (kind is _BYTE or of.dtype == types.float64), of
    data = context.make_array(array[0])(context, builder, array[1]).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


def _places(context: Any, builder: Any, signature: Any, given: Any) -> tuple[Any, Any]:
    """Return pointers to two consecutive numbers of an array, and to the third.

    All reads and writes of three numbers use these: a load across two stores would wait for both.
    """
    array, index = (signature.args[0], given[0]), given[1]
    third = builder.add(index, ir.Constant(index.type, 2))
    return _at(context, builder, array, index, _TWO), _at(context, builder, array, third, _DOUBLE)


def _load(builder: Any, two: Any, third: Any) -> Any:
    none = ir.Constant(_TWO, [0.0, 0.0])
    last = builder.insert_element(none, builder.load(third), ir.Constant(_INT, 0))
    return _picked(builder, builder.load(two, align=8), last, [0, 1, 2, 3])


def _store(builder: Any, two: Any, third: Any, vector: Any) -> None:
    builder.store(_picked(builder, vector, vector, [0, 1]), two, align=8)
    builder.store(_lane(builder, vector, 2), third)


def _lane(builder: Any, vector: Any, which: int) -> Any:
    return builder.extract_element(vector, ir.Constant(_INT, which))


def _picked(builder: Any, one: Any, other: Any, lanes: list[int]) -> Any:
    mask = ir.Constant(ir.VectorType(_INT, len(lanes)), lanes)
    return builder.shuffle_vector(one, other, mask)


def _four(values: np.ndarray, index: int) -> np.ndarray:
    return values[int(index) : int(index) + 4].copy()


def _three(values: np.ndarray, index: int) -> np.ndarray:
    return np.append(values[int(index) : int(index) + 3], 0.0)


def _put(values: np.ndarray, index: int, a: np.ndarray) -> None:
    values[int(index) : int(index) + 3] = a[:3]


def _add(values: np.ndarray, index: int, a: np.ndarray) -> None:
    values[int(index) : int(index) + 3] += a[:3]


@operation(_four)
def load_four(typing: Any, values: Any, index: Any) -> Any:
    """Return four consecutive numbers of an array; it must be long enough."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _at(context, builder, (signature.args[0], given[0]), given[1], _FOUR)
        return builder.load(place, align=8)

    return _VECTOR(values, index), generate


@operation(_three)
def load_three(typing: Any, values: Any, index: Any) -> Any:
    """Return three consecutive numbers of an array, and 0."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _load(builder, *_places(context, builder, signature, given))

    return _VECTOR(values, index), generate


@operation(lambda x, y, z: np.array([x, y, z, 0.0]))
def three(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """Return three numbers, and 0."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        vector = ir.Constant(_FOUR, [0.0] * 4)
        for which, number in enumerate(given):
            vector = builder.insert_element(vector, number, ir.Constant(_INT, which))
        return vector

    return _VECTOR(types.float64, types.float64, types.float64), generate


@operation(lambda x: np.full(4, x))
def spread(typing: Any, x: Any) -> Any:
    """Return one number in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        first = ir.Constant(_INT, 0)
        vector = builder.insert_element(ir.Constant(_FOUR, ir.Undefined), given[0], first)
        return _picked(builder, vector, vector, [0, 0, 0, 0])

    return _VECTOR(types.float64), generate


@operation(np.multiply)
def product(typing: Any, a: Any, b: Any) -> Any:
    """Return the product lane by lane."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.fmul(*given, flags=('contract',))

    return _VECTOR(_VECTOR, _VECTOR), generate


@operation(lambda a, b, c: a + b * c)
def plus_product(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return lane by lane a + b c, rounded once where the processor can."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        a, b, c = given
        return builder.fadd(a, builder.fmul(b, c, flags=('contract',)), flags=('contract',))

    return _VECTOR(_VECTOR, _VECTOR, _VECTOR), generate


@operation(lambda a: tuple(a[:3]))
def unpack(typing: Any, a: Any) -> Any:
    """Return the first three lanes, a tuple."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        numbers = [_lane(builder, given[0], which) for which in range(3)]
        return context.make_tuple(builder, signature.return_type, numbers)

    return types.UniTuple(types.float64, 3)(_VECTOR), generate


@operation(_put)
def put_three(typing: Any, values: Any, index: Any, a: Any) -> Any:
    """Store the first three lanes in an array, aligned as `add_three` expects."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        _store(builder, *_places(context, builder, signature, given), given[2])
        return context.get_dummy_value()

    return types.void(values, index, _VECTOR), generate


@operation(_add)
def add_three(typing: Any, values: Any, index: Any, a: Any) -> Any:
    """Add the first three lanes to consecutive numbers of an array."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        places = _places(context, builder, signature, given)
        _store(builder, *places, builder.fadd(_load(builder, *places), given[2]))
        return context.get_dummy_value()

    return types.void(values, index, _VECTOR), generate


@operation(lambda values, index: None)
def prefetch(typing: Any, values: Any, index: Any) -> Any:
    """Prefetch an element of an array to the first cache; the index may be beyond the end."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _at(context, builder, (signature.args[0], given[0]), given[1], _BYTE)
        kind = ir.FunctionType(ir.VoidType(), [place.type, _INT, _INT, _INT])
        fetch = builder.module.declare_intrinsic('llvm.prefetch', [place.type], kind)
        # To be read, to be kept in all caches, as data.
        builder.call(fetch, [place, *(ir.Constant(_INT, number) for number in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(values, index), generate


@inner(error_model='numpy')
def total(a):
    """Return the sum of the first three lanes."""
    x, y, z = unpack(a)
    return x + y + z
