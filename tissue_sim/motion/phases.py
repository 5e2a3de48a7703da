"""Phases of work that the threads of a kernel share: a phase begins when that before is done.

Each item of a phase is done by the thread that claims it first. So nobody waits for a thread that
has no processor, unless it has an item. A thread without one looks for the next phase for some
microseconds, as one may begin sooner than a sleeper could wake up. Then it sleeps, by the system
call by which locks sleep: a thread that looked on might have the processor that another needs.
"""

import platform
import threading
import time
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from cutting_trainer.node_common.kernels import inner, operation

_LINE = 8
_PHASE, _SLEEPERS, _DONE, _CLAIMS = 0, _LINE, 2 * _LINE, 3 * _LINE
"""Places on the board, each in a cache line of its own: number of the phase, threads that sleep,
items done in the phase, and from there on the phase for which each item is free."""
_LOOKS = 3000
"""Looks at the board before a thread sleeps: 50 to 200 us, about the time to wake it up."""
_INTEL = platform.machine() in ('x86_64', 'AMD64')
_FUTEX = 202 if _INTEL else 98
"""Number of the system call, on x86-64 or on ARM."""
_WAIT, _WAKE = 128, 129
"""Its commands, for the threads of one process."""
_LONG = ir.IntType(64)
_LOCK = threading.Lock()


def make_board(items: int) -> np.ndarray:
    """Return the board of threads that begin with phase 0, int64.

    Args:
        items: largest number in a phase.
    """
    return np.zeros(_CLAIMS + _LINE * items, np.int64)


def _place(context: Any, builder: Any, signature: Any, given: Any) -> Any:
    """Return the pointer to a number of the board."""
    data = context.make_array(signature.args[0])(context, builder, given[0]).data
    return builder.gep(data, [given[1]])


def _call_futex(builder: Any, place: Any, command: int, value: Any) -> None:
    kind = ir.FunctionType(_LONG, [_LONG], var_arg=True)
    call = cgutils.get_or_insert_function(builder.module, kind, 'syscall')
    numbers = [ir.Constant(_LONG, _FUTEX), place, ir.Constant(_LONG, command), value]
    builder.call(call, [*numbers, *[ir.Constant(_LONG, 0)] * 3])


@operation(lambda board, index: int(board[index]))
def _load(typing: Any, board: Any, index: Any) -> Any:
    """Return a number that other threads change."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _place(context, builder, signature, given)
        return builder.load_atomic(place, 'seq_cst', align=8)

    return types.int64(board, types.int64), generate


def _add_in_python(board: np.ndarray, index: int, value: int) -> int:
    with _LOCK:
        board[index] += value
        return int(board[index]) - value


@operation(_add_in_python)
def _add(typing: Any, board: Any, index: Any, value: Any) -> Any:
    """Add to a number that other threads change; return its value before."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _place(context, builder, signature, given)
        return builder.atomic_rmw('add', place, given[2], 'seq_cst')

    return types.int64(board, types.int64, types.int64), generate


def _change_in_python(board: np.ndarray, index: int, before: int, after: int) -> bool:
    with _LOCK:
        changes = bool(board[index] == before)
        board[index] = after if changes else board[index]
        return changes


@operation(_change_in_python)
def _change(typing: Any, board: Any, index: Any, before: Any, after: Any) -> Any:
    """Change a number from one value to another; return False if another thread was first."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place = _place(context, builder, signature, given)
        found = builder.cmpxchg(place, given[2], given[3], 'seq_cst')
        return builder.extract_value(found, 1)

    return types.boolean(board, types.int64, types.int64, types.int64), generate


@operation(lambda board, index, value: time.sleep(1e-5))
def _sleep(typing: Any, board: Any, index: Any, value: Any) -> Any:
    """Sleep if a number has a value, until it is woken."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        _call_futex(builder, _place(context, builder, signature, given), _WAIT, given[2])
        return context.get_dummy_value()

    return types.none(board, types.int64, types.int64), generate


@operation(lambda board, index: None)
def _wake(typing: Any, board: Any, index: Any) -> Any:
    """Wake all threads that sleep at a number."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        everyone = ir.Constant(_LONG, 2**31 - 1)
        _call_futex(builder, _place(context, builder, signature, given), _WAKE, everyone)
        return context.get_dummy_value()

    return types.none(board, types.int64), generate


@operation(lambda: None)
def _pause(typing: Any) -> Any:
    """Leave the processor's units to the other thread of its core for a moment."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        if _INTEL:
            kind = ir.FunctionType(ir.VoidType(), [])
            pause = cgutils.get_or_insert_function(builder.module, kind, 'llvm.x86.sse2.pause')
            builder.call(pause, [])
        return context.get_dummy_value()

    return types.none(), generate


@inner
def claim(board, phase, item):
    """Return whether an item of a phase is for the thread that asks."""
    place = _CLAIMS + _LINE * item
    free = _load(board, place)
    return free <= phase and _change(board, place, free, phase + 1)


@inner
def finish(board, items):
    """Note that an item of the present phase is done, and begin the next one if it was the last."""
    if _add(board, _DONE, 1) == items - 1:
        board[_DONE] = 0
        _add(board, _PHASE, 1)
        if _load(board, _SLEEPERS) > 0:
            _wake(board, _PHASE)


@inner
def wait_for_end(board, phase):
    """Return the number of the phase that has begun since one ended."""
    for _ in range(_LOOKS):
        now = _load(board, _PHASE)
        if now > phase:
            return now
        _pause()
    _add(board, _SLEEPERS, 1)
    while _load(board, _PHASE) == phase:
        _sleep(board, _PHASE, phase)
    _add(board, _SLEEPERS, -1)
    return _load(board, _PHASE)
