"""Shortcuts through Numba's compiler, for processes that compile the trainer's kernels and end.

Numba tries all variants of a function at each call, several times, and writes a sentence about each
that does not fit. With these shortcuts it makes the same code in three quarters of the time. The
parts of Numba that are replaced are those of the locked version.
"""

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

from numba.core import event, ir
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.types.functions import BaseFunction

_resolve = BaseFunction.get_call_type
_known: dict[Any, tuple[Any, Any]] = {}
"""Signature and implementation by function, types and settings of the compiler."""


def _call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call, and put its implementation in place, as Numba's own."""
    settings = ConfigStack.top_or_none()
    call = self, context, tuple(args), tuple(kws.items())
    known = _known.get((*call, settings))
    if known:
        signature, implementation = known
        self._impl_keys[signature.args] = implementation
        return signature
    new: Any = _resolve(self, context, args, kws)
    _known[*call, settings and settings.copy()] = new, self._impl_keys[new.args]
    return new


@cache
def _hash_of_class(kind: Any) -> int:
    return hash(tuple(sorted(kind.options)))


def _hash_settings(self: TargetConfig) -> int:
    """Return the hash of settings: in Numba, too, it depends on their names alone."""
    kind: Any = type(self)
    return _hash_of_class(kind)


def _equal_settings(self: TargetConfig, other: object) -> bool:
    """Return whether settings are equal; defaults are looked at only where given values differ."""
    if not isinstance(other, TargetConfig):
        return NotImplemented
    alike = type(self) is type(other) and self._values == other._values
    return bool(alike or self.values() == other.values())


@cache
def _finder(kind: Any) -> Callable[[Any], Iterable[ir.Var]] | None:
    """Return how variables are found in values of a type; None: there are none."""
    if issubclass(kind, ir.Var):
        return lambda value: (value,)
    if issubclass(kind, ir.Inst):
        return kind.list_vars
    if issubclass(kind, (list, tuple)):
        return _variables_in
    return (lambda value: _variables_in(value.values())) if issubclass(kind, dict) else None


def _variables_in(values: Iterable[Any]) -> list[ir.Var]:
    found: list[ir.Var] = []
    for value in values:
        kind: Any = type(value)
        if find := _finder(kind):
            found += find(value)
    return found


def _variables(_: ir.Inst, value: Any) -> list[ir.Var]:
    """Return the variables in a part of an instruction."""
    return _variables_in((value,))


def _tell_nobody(_: event.Event) -> None:
    """Tell no listener: the clock of each function would get all events of those that it calls."""


SHORTCUTS: dict[Any, dict[str, Any]] = {
    BaseFunction: {'get_call_type': _call_type},
    TargetConfig: {'__hash__': _hash_settings, '__eq__': _equal_settings},
    ir.Inst: {'_rec_list_vars': _variables},
    event: {'broadcast': _tell_nobody},
}
"""Replaced functions by class or module of Numba."""


def take_shortcuts() -> None:
    """Let Numba compile in less time, in this process."""
    for owner, functions in SHORTCUTS.items():
        for name, function in functions.items():
            setattr(owner, name, function)
