"""Every kernel runs in Python, too, where it can be stepped through: NUMBA_DISABLE_JIT=1."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cutting_trainer.node_common.kernels import kernel

pytestmark = pytest.mark.long

TEST = Path(__file__).parent


def small_session(**environment: str) -> dict[str, np.ndarray]:
    """The numbers of `small_session.py`, by kind of tissue."""
    paths = os.pathsep.join([str(TEST.parent), str(TEST), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, TEST / 'small_session.py'],
        env=os.environ | {'PYTHONPATH': paths} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {name: np.array(values) for name, values in json.loads(done.stdout).items()}


@pytest.mark.thorough
def test_kernels_in_python_come_to_what_the_compiled_ones_do_but_for_rounding() -> None:
    compiled, python = small_session(), small_session(NUMBA_DISABLE_JIT='1')
    assert compiled.keys() == python.keys()
    for name, values in compiled.items():
        assert np.abs(values).max() > 1e-4
        np.testing.assert_allclose(python[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
    assert compiled['elements cut'] > 0


def test_a_copy_to_a_slice_of_another_shape_is_an_error_without_the_shapes() -> None:
    """Numba's own sentence would bring its functions of text into each kernel that copies so."""

    def copy(target: np.ndarray, source: np.ndarray) -> None:
        target[:] = source

    copied, target = kernel(copy, cache=False), np.zeros(3)
    copied(target, np.arange(3.0))
    np.testing.assert_array_equal(target, np.arange(3.0))
    with pytest.raises(ValueError, match='to a slice of another shape'):
        copied(target, np.zeros(2))
