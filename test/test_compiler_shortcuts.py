"""Setting up takes shortcuts through Numba's compiler: to the same code."""

import re
import subprocess
import sys

import pytest

from cutting_trainer.session.compiler_shortcuts import SHORTCUTS

COMPILE = """
import sys
import numpy as np
from numba import njit
from numba.extending import register_jitable
from cutting_trainer.session.compiler_shortcuts import take_shortcuts

if sys.argv[1:] == ['short']:
    take_shortcuts()

@register_jitable
def mean(values, by):
    return values.sum() / by

def both(values, by):
    total = mean(values, by) + mean(values[::2], by)
    for k in range(len(values)):
        total += max(values[k] / by, np.sqrt(values[k]))
    return total

for options in ({}, {'error_model': 'numpy'}, {'fastmath': True}, {'boundscheck': True}):
    compiled = njit(**options)(both)
    compiled(np.arange(5.0), 3)
    print(compiled.inspect_asm(compiled.signatures[0]))
"""


def compiled(*words: str) -> str:
    """The machine code, without the numbers by which Numba tells functions apart."""
    done = subprocess.run(
        [sys.executable, '-c', COMPILE, *words], capture_output=True, text=True, check=True
    )
    return re.sub(r'B\d+v\d+', 'B', done.stdout)


def test_numba_has_each_function_that_is_replaced() -> None:
    for owner, functions in SHORTCUTS.items():
        for name, function in functions.items():
            assert getattr(owner, name) is not function


@pytest.mark.long
def test_the_machine_code_is_the_same_whatever_the_settings_of_the_caller() -> None:
    code = compiled()
    assert len(code) > 10_000 and compiled('short') == code
