"""Decorators of kernels, the functions that Numba compiles once and keeps in its cache.

With `NUMBA_DISABLE_JIT=1` both leave a function as it is.
"""

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.extending import register_jitable


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that Python calls, with options of `numba.njit`."""
    compiled = njit(cache=True, no_cfunc_wrapper=True, **options)
    return compiled if function is None else compiled(function)


def inner(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function where a kernel calls it; Python interprets it.

    Half of a small kernel's compile time is the wrapper by which Python calls it: it has none.
    """
    compiled = register_jitable(cache=True, no_cfunc_wrapper=True, **options)
    return compiled if function is None else compiled(function)
