"""Rotations agree with scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from cutting_trainer.node_common.orientation import from_quaternion, from_rpy, quaternion

ANGLE = st.floats(-720, 720) | st.sampled_from([0.0, 90.0, 180.0, -180.0])
PART = st.floats(-1, 1)


@given(st.tuples(ANGLE, ANGLE, ANGLE))
def test_roll_pitch_yaw_turn_about_fixed_axes(rpy: tuple[float, float, float]) -> None:
    wanted = Rotation.from_euler('xyz', rpy, degrees=True)
    assert_allclose(from_rpy(rpy), wanted.as_matrix(), atol=1e-14)
    turned = quaternion(from_rpy(rpy))
    assert abs(turned @ wanted.as_quat()) == pytest.approx(1.0, abs=1e-14)


@given(st.tuples(PART, PART, PART, PART).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_a_quaternion_of_any_length_is_the_matrix_s_again(parts: tuple[float, ...]) -> None:
    unit = np.array(parts) / np.linalg.norm(parts)
    matrix = from_quaternion(parts)
    assert_allclose(matrix, Rotation.from_quat(unit).as_matrix(), atol=1e-14)
    assert abs(quaternion(matrix) @ unit) == pytest.approx(1.0, abs=1e-14)


def test_no_turn_is_exactly_none() -> None:
    assert np.array_equal(from_rpy((0, 0, 0)), np.eye(3))
    assert np.array_equal(quaternion(np.eye(3)), [0, 0, 0, 1])
