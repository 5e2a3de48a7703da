"""Decorators of kernels, the functions that Numba compiles once and keeps in its cache.

With `NUMBA_DISABLE_JIT=1` both leave a function as it is.
"""

from collections.abc import Callable
from typing import Any

from numba import config, njit
from numba.extending import intrinsic, overload, register_jitable
from numba.np import arrayobj

from cutting_trainer.node_common.linked_code import link_inner_functions

_OPTIONS = {'no_cfunc_wrapper': True}


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that Python calls, with options of `numba.njit`."""
    compiled = njit(**_OPTIONS | {'cache': True} | options)
    return compiled if function is None else compiled(function)


def inner(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function where a kernel calls it, see `linked_code`; Python interprets it."""
    compiled = register_jitable(**_OPTIONS | options)
    return compiled if function is None else compiled(function)


def operation(in_python: Callable[..., Any]) -> Callable[..., Any]:
    """Return the decorator of an intrinsic operation, see `numba.extending.intrinsic`.

    Args:
        in_python: its Python version for NUMBA_DISABLE_JIT=1, for debugging.
    """
    return (lambda _: in_python) if config.DISABLE_JIT else intrinsic


def _raise_for_shape(source: Any, target: Any) -> None:
    """Raise for an array that is copied to a slice of another shape."""


@overload(_raise_for_shape)
def _raise_in_kernel(source: Any, target: Any) -> Callable[..., None]:
    def raise_error(source: Any, target: Any) -> None:
        raise ValueError('an array is copied to a slice of another shape')

    return raise_error


# The sentence that Numba puts together for it, with both shapes, took a seventh of the time in
# which the force loop is compiled.
arrayobj.raise_with_shape_context = _raise_for_shape
link_inner_functions()
