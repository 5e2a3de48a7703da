"""Code of functions that only kernels call: Numba compiles it where it is called, and there alone.

Numba optimises each such function by itself and makes machine code of it, which nothing runs. Then
each kernel that calls it takes in its code and optimises it again. That was a quarter of the time
in which all kernels are compiled. The two parts of Numba that are replaced are those of the locked
version.
"""

from typing import Any

from numba import _dynfunc
from numba.core.codegen import JITCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.typed_passes import BaseNativeLowering

_lower = BaseNativeLowering.run_pass
_executable = CPUContext.get_executable


class LinkedCode(JITCodeLibrary):
    """Code that others link, as it was lowered; it has no machine code."""

    def _optimize_final_module(self) -> None:
        """Leave optimisation to the kernels that link the code."""

    def _finalize_final_module(self) -> None:
        """Make the code ready to be linked."""
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


def _lower_linked(self: BaseNativeLowering, state: Any) -> bool:
    """Lower a function; one without a wrapper for Python is to be linked."""
    if state.flags.no_cpython_wrapper and state.library is None:
        name = state.func_id.func_qualname
        state.library = LinkedCode(state.targetctx.codegen(), name)
    return bool(_lower(self, state))


def _linked_executable(self: CPUContext, library: Any, fndesc: Any, env: Any) -> Any:
    """Return the function that Python calls; of linked code, one that cannot be called."""
    if not isinstance(library, LinkedCode):
        return _executable(self, library, fndesc, env)
    library.finalize()
    return _dynfunc.make_function(fndesc.lookup_module(), library.name, '', 0, env, (library,))


def link_inner_functions() -> None:
    """Let Numba leave functions without a wrapper for Python to the kernels that call them."""
    BaseNativeLowering.run_pass = _lower_linked
    CPUContext.get_executable = _linked_executable
