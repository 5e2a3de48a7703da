"""Claims about the motors of the emulated arm: limits, delay, watchdog."""

import numpy as np
import pytest
from arms import MS, make_arm, move, run, script
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation


@given(st.tuples(*[st.floats(-1e200, 1e200)] * 3))
def test_force_never_exceeds_saturation_and_keeps_its_direction(force):
    arm = make_arm(max_force=4.0)
    arm.command(1, force, 0)
    arm.advance(0, enabled=True)
    norm = np.linalg.norm(arm.force)
    assert np.isfinite(norm)
    assert norm <= 4.0 * (1 + 1e-12)
    if 1e-3 < np.abs(force).max() < 1e100:
        assert_allclose(arm.force / norm, force / np.linalg.norm(force), atol=1e-9)


@given(st.tuples(*[st.floats(-10, 10)] * 3), st.floats(1e-3, 0.2))
def test_force_is_a_multiple_of_the_motor_resolution_and_not_beyond_saturation(force, step):
    arm = make_arm(force_resolution=step, max_force=4.0)
    arm.command(1, force, 0)
    arm.advance(0, enabled=True)
    counts = arm.force / step
    assert_allclose(counts, np.round(counts), atol=1e-6)
    assert np.linalg.norm(arm.force) <= 4.0 * (1 + 1e-12)


@pytest.mark.parametrize('periods', [0, 1, 7])
def test_force_arrives_after_the_delay(periods):
    _, forces = run(make_arm(delay=periods / 1000), 12, force=(1.0, 0, 0))
    assert_array_equal(forces[:periods], 0)
    assert_array_equal(forces[periods:, 0], 1.0)


def test_command_in_body_axes_is_turned_into_the_base():
    arm = make_arm(body_force=True, script=script({'kind': 'rest'}, rpy_deg=(20, -40, 70)))
    arm.command(1, (0.3, -0.5, 0.7), 0)
    arm.advance(0, enabled=True)
    axes = Rotation.from_euler('xyz', (20, -40, 70), degrees=True)
    assert_allclose(arm.force, axes.apply((0.3, -0.5, 0.7)), atol=1e-12)


@pytest.mark.parametrize('delay', [0.0, 0.05])
def test_watchdog_has_the_force_at_zero_30_ms_after_the_last_command(delay):
    arm = make_arm(delay=delay)
    run(arm, 100, force=(1.0, 0, 0))
    _, forces = run(arm, 40, start=100)
    assert_array_equal(forces[:28, 0], 1.0)
    assert_array_equal(forces[28:], 0)
    assert arm.watchdog_trips == 1
    run(arm, 100, force=(1.0, 0, 0), start=140)
    assert arm.force[0] == 1.0
    assert arm.watchdog_trips == 1


def test_watchdog_counts_nothing_before_the_first_command():
    arm = make_arm()
    run(arm, 100)
    assert arm.watchdog_trips == 0


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('axis', range(3))
def test_nan_command_zeroes_the_motors_at_once(bad, axis):
    arm = make_arm(delay=0.003)
    run(arm, 50, force=(1.0, 1.0, 1.0))
    force = [1.0, 1.0, 1.0]
    force[axis] = bad
    _, forces = run(arm, 10, force=tuple(force), start=50)
    assert_array_equal(forces, 0)
    assert arm.rejections.total == 10


def test_zero_stamp_marks_a_command_invalid():
    arm = make_arm()
    run(arm, 50, force=(1.0, 0, 0))
    arm.command(0, (1.0, 0, 0), 51 * MS)
    arm.advance(51 * MS, enabled=True)
    assert_array_equal(arm.force, 0)


def test_repeated_and_older_commands_neither_act_nor_feed_the_watchdog():
    arm = make_arm()
    run(arm, 50, force=(1.0, 0, 0))
    for tick in range(51, 76):
        arm.command(50 * MS, (2.0, 0, 0), tick * MS)
        arm.command(49 * MS, (2.0, 0, 0), tick * MS)
        arm.advance(tick * MS, enabled=True)
        assert arm.force[0] == 1.0
    assert arm.rejections.total == 50
    run(arm, 5, start=75)
    assert_array_equal(arm.force, 0)


def test_a_sender_whose_clock_was_set_back_is_heard_again_after_the_watchdog():
    arm = make_arm()
    run(arm, 50, force=(1.0, 0, 0))
    forces = []
    for tick in range(51, 151):
        arm.command((tick - 50) * 1000, (0.5, 0, 0), tick * MS)
        arm.advance(tick * MS, enabled=True)
        forces.append(arm.force[0])
    assert arm.watchdog_trips == 1
    assert forces[-1] == 0.5


@pytest.mark.parametrize('delay', [0.0, 0.01])
def test_no_force_unless_enabled_and_the_hand_goes_on_moving_the_arm(delay):
    arm = make_arm(delay=delay, script=script(move((0.01, 0, 0))))
    arm.script_running = True
    _, forces = run(arm, 500, force=(0, 0, 1.0), enabled=False)
    assert_array_equal(forces, 0)
    assert arm.true_position[0] > 0.002
    run(arm, 20, force=(0, 0, 1.0), start=500)
    assert arm.force[2] == 1.0
    arm.advance(521 * MS, enabled=False)
    assert_array_equal(arm.force, 0)
