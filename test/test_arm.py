"""Claims about the mechanics and sensors of the emulated arm."""

import numpy as np
import pytest
from arms import LIMP, MS, kinetic, make_arm, move, run, script
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation


def test_free_arm_in_equilibrium_stays():
    positions, _ = run(make_arm(), 500)
    assert_array_equal(positions, 0)


def test_free_arm_keeps_its_velocity():
    arm = make_arm(hand=LIMP)
    arm.true_velocity[:] = (0.1, -0.2, 0.3)
    run(arm, 1000)
    assert_allclose(arm.true_position, (0.1, -0.2, 0.3), rtol=1e-9)


def test_force_on_a_free_arm_accelerates_it_by_force_over_mass():
    arm = make_arm(hand=LIMP, mass=0.2)
    run(arm, 500, force=(0.4, 0.0, 0.0))
    assert_allclose(arm.true_velocity, (1.0, 0, 0), rtol=1e-9)
    assert_allclose(arm.true_position[0], 0.5 * 2.0 * 0.5**2, rtol=1e-3)


def test_viscous_friction_alone_decays_with_mass_over_friction():
    arm = make_arm(hand=LIMP, viscous_friction=0.5)
    arm.true_velocity[:] = (0.3, 0, 0)
    run(arm, 200)
    assert_allclose(arm.true_velocity[0], 0.3 * np.exp(-1), rtol=1e-2)


@settings(deadline=None, max_examples=30)
@given(
    mass=st.floats(0.05, 0.3),
    viscous=st.floats(0, 5),
    coulomb=st.floats(0, 1),
    velocity=st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_kinetic_energy_of_a_passive_arm_never_grows(mass, viscous, coulomb, velocity):
    arm = make_arm(hand=LIMP, mass=mass, viscous_friction=viscous, coulomb_friction=coulomb)
    arm.true_velocity[:] = velocity
    energy = kinetic(arm, mass)
    for tick in range(100):
        arm.advance(tick * MS, enabled=True)
        assert kinetic(arm, mass) <= energy * (1 + 1e-12)
        energy = kinetic(arm, mass)


@settings(deadline=None, max_examples=30)
@given(mass=st.floats(0.05, 0.3), stiffness=st.floats(10, 5000), damping=st.floats(0, 200))
def test_a_hand_that_holds_still_brings_no_energy_in(mass, stiffness, damping):
    arm = make_arm(mass=mass, hand={'stiffness': stiffness, 'damping': damping})
    arm.true_velocity[:] = (0.2, 0, 0)
    first = kinetic(arm, mass)
    for tick in range(400):
        arm.advance(tick * MS, enabled=True)
        stored = 0.5 * stiffness * arm.true_position @ arm.true_position
        # Semi-implicit Euler conserves an energy that differs from the true one by its step.
        assert kinetic(arm, mass) + stored <= first * 1.1


def test_coulomb_friction_stops_the_arm_where_work_says_and_it_stays_stopped():
    arm = make_arm(hand=LIMP, coulomb_friction=0.2)
    arm.true_velocity[:] = (0.12, 0.16, 0)
    positions, _ = run(arm, 200)
    assert_array_equal(arm.true_velocity, 0)
    assert_array_equal(positions[-1], positions[120])
    assert_allclose(np.linalg.norm(positions[-1]), 0.5 * 0.1 * 0.2**2 / 0.2, rtol=1e-2)


def test_force_below_coulomb_friction_does_not_move_the_arm_and_one_above_it_does():
    arm = make_arm(hand=LIMP, coulomb_friction=0.2)
    positions, _ = run(arm, 200, force=(0.11, 0.11, 0.11))
    assert_array_equal(positions, 0)
    run(arm, 200, force=(0.13, 0.13, 0.13), start=200)
    assert (arm.true_velocity > 0).all()


def test_friction_does_not_chatter_at_rest_under_a_holding_force():
    arm = make_arm(coulomb_friction=0.2, hand={'stiffness': 400, 'damping': 2})
    positions, _ = run(arm, 2000, force=(0.0, 0.0, 1.0))
    assert_array_equal(positions[-500:], np.broadcast_to(positions[-1], (500, 3)))
    assert abs(400 * positions[-1, 2] - 1.0) <= 0.2


def test_an_elastic_hand_gives_way_by_force_over_stiffness():
    arm = make_arm(hand={'stiffness': 400, 'damping': 10})
    run(arm, 2000, force=(0.0, 0.0, 2.0))
    assert_allclose(arm.true_position, (0, 0, 2.0 / 400), atol=1e-6)


@pytest.mark.parametrize('stiffness', [50, 400, 5000])
@pytest.mark.parametrize('mass', [0.05, 0.3])
@pytest.mark.parametrize('rate', [250, 1000])
def test_hand_brings_arm_to_the_end_of_its_script_from_limp_to_stiff(stiffness, mass, rate):
    path = script(move((0.02, 0.0, -0.03)), {'kind': 'rest'}, seconds=2.0)
    hand = {'stiffness': stiffness, 'damping': 2 * np.sqrt(stiffness * mass)}
    arm = make_arm(mass=mass, rate=rate, hand=hand, script=path)
    arm.script_running = True
    for tick in range(2 * rate + 1):
        arm.advance(tick * 1_000_000_000 // rate, enabled=True)
    assert arm.script_over
    assert_allclose(arm.true_position, (0.02, 0, -0.03), atol=1e-4)


def test_missed_periods_are_made_up_for():
    slow, fast = (make_arm(script=script(move((0.01, 0, 0)))) for _ in range(2))
    slow.script_running = fast.script_running = True
    for tick in range(0, 600, 3):
        slow.advance(tick * MS, enabled=True, steps=3)
    for tick in range(600):
        fast.advance(tick * MS, enabled=True)
    assert_array_equal(slow.true_position, fast.true_position)
    assert slow.script_time == fast.script_time


@settings(deadline=None, max_examples=20)
@given(st.floats(1e-6, 1e-3), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_position_is_a_multiple_of_the_encoder_resolution_and_the_nearest(resolution, velocity):
    arm = make_arm(hand=LIMP, encoder_resolution=resolution)
    arm.true_velocity[:] = velocity
    run(arm, 20)
    counts = arm.position / resolution
    assert_allclose(counts, np.round(counts), atol=1e-6)
    assert np.abs(arm.position - arm.true_position).max() <= resolution / 2 * (1 + 1e-9)


def test_measured_velocity_comes_from_encoders_through_a_low_pass():
    arm = make_arm(hand=LIMP, encoder_resolution=2e-5, velocity_cutoff=20)
    arm.true_velocity[:] = (0.05, 0, 0)
    arm.advance(0, enabled=True)
    assert arm.velocity[0] < 0.02
    run(arm, 300)
    assert_allclose(arm.velocity, (0.05, 0, 0), atol=0.005)


def test_orientation_and_angular_velocity_are_those_of_the_hand():
    turn = {'kind': 'approach', 'waypoints': ({'position': (0, 0, 0), 'rpy_deg': (0, 0, 90)},)}
    arm = make_arm(script=script(turn, rpy_deg=(0, 0, 0)))
    arm.script_running = True
    turned = np.zeros(3)
    for tick in range(500):
        arm.advance(tick * MS, enabled=True)
        turned += arm.angular_velocity * 1e-3
    assert_allclose(turned, (0, 0, np.pi / 4), atol=1e-3)
    assert_allclose(Rotation.from_quat(arm.orientation).as_rotvec(), turned, atol=1e-3)
    assert_allclose(arm.angular_velocity[2], 1.875 * np.pi / 2, rtol=1e-3)
