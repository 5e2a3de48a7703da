"""Claims about each link of the safety chain, and about the links together."""

import math
import sys

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cutting_trainer.haptic_bridge import safety
from cutting_trainer.haptic_bridge.devices.motion_gate import GATE, judge
from cutting_trainer.node_common.vectors import norm

UNIT = np.array([0.0, 0.0, 0.0, 1.0])
components = st.floats(-50, 50)
forces = st.tuples(components, components, components).map(np.array)


def vector(*values):
    return np.array(values, float)


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('where', range(7))
def test_a_pose_with_a_number_that_is_none_is_refused(bad, where):
    pose = np.concatenate([vector(0.1, 0, 0), UNIT])
    pose[where] = bad
    assert safety.pose_gate(pose[:3], pose[3:]) == safety.NOT_FINITE
    assert judge(np.zeros(1, GATE), pose, 10**9, False) == safety.NOT_FINITE


@pytest.mark.parametrize('scale', [0.0, 0.9, 1.1])
def test_an_orientation_that_is_no_rotation_is_refused(scale):
    gate = safety.pose_gate(np.zeros(3), scale * UNIT)
    assert gate == safety.NOT_A_ROTATION


def test_millimetres_sent_as_metres_are_refused():
    for place in 120 * np.eye(3):
        pose = np.concatenate([place, UNIT])
        assert judge(np.zeros(1, GATE), pose, 10**9, False) == safety.OUT_OF_RANGE


def moved(gate, ms, position=(0, 0, 0), turn=0.0):
    """What the gate says of a pose at a time, turned about z by an angle [rad]."""
    orientation = (0, 0, np.sin(turn / 2), np.cos(turn / 2))
    pose = np.array([*position, *orientation])
    return judge(gate, pose, 10**9 + round(ms * 1e6), ms > 0)


def test_a_jump_of_a_metre_is_refused_and_the_fastest_hand_is_not():
    gate = np.zeros(1, GATE)
    assert moved(gate, 0) == safety.OK
    assert moved(gate, 1, (1, 0, 0)) == safety.JUMP
    assert moved(gate, 1, (0.005, 0, 0)) == safety.OK


def test_a_step_faster_than_10_m_per_s_is_refused_in_a_single_sample():
    gate = np.zeros(1, GATE)
    moved(gate, 0)
    assert moved(gate, 1, (0.0145, 0, 0)) == safety.JUMP
    assert moved(gate, 1.001, (0.0099, 0, 0)) == safety.OK


@pytest.mark.parametrize('sign', [1, -1])
def test_a_glitch_of_90_degrees_is_refused_and_a_flick_of_the_wrist_is_not(sign):
    gate = np.zeros(1, GATE)
    moved(gate, 0)
    assert moved(gate, 1, turn=np.pi / 2) == safety.ROTATION_JUMP
    assert moved(gate, 1, turn=0.03) == safety.OK
    same = sign * np.array([0, 0, np.sin(0.03), np.cos(0.03)]) * 0.991
    pose = np.array([0, 0, 0, *same])
    assert judge(gate, pose, 10**9 + 2_000_000, True) == safety.OK


def test_jitter_of_stamps_is_no_jump_but_many_steps_with_the_same_stamp_are():
    rng, gate = np.random.default_rng(1), np.zeros(1, GATE)
    stamps = np.arange(1, 2000) + rng.uniform(-0.9, 0.0, 1999)
    moved(gate, 0)
    for i, ms in enumerate(np.maximum.accumulate(stamps)):  # 5 m/s, back and forth
        assert moved(gate, ms, (0.005 * abs((i + 1) % 20 - 10) - 0.05, 0, 0)) == safety.OK
    gate = np.zeros(1, GATE)
    codes = [moved(gate, 0.01 * i, (0.008 * i, 0, 0)) for i in range(10)]
    assert safety.JUMP in codes


def test_every_pose_fault_has_a_sentence():
    codes = (
        safety.NOT_FINITE,
        safety.NOT_A_ROTATION,
        safety.OUT_OF_RANGE,
        safety.JUMP,
        safety.ROTATION_JUMP,
    )
    assert set(safety.POSE_FAULTS) == set(codes)


def test_no_force_passes_the_state_gate_unless_enabled():
    force = vector(1, 2, 3)
    safety.state_gate(True, force)
    np.testing.assert_array_equal(force, [1, 2, 3])
    safety.state_gate(False, force)
    np.testing.assert_array_equal(force, 0)


def test_stale_data_fade_between_100_and_150_ms():
    ages = [0.0, 0.1, 0.125, 0.15, 10.0, np.inf]
    gains = [safety.freshness(age, 0.1, 0.05) for age in ages]
    np.testing.assert_allclose(gains, [1, 1, 0.5, 0, 0, 0], atol=1e-12)


def test_soft_start_grows_linearly_and_a_zero_duration_turns_it_off():
    gains = [safety.soft_start(t, 0.5) for t in (0, 0.25, 0.5, 9)]
    np.testing.assert_allclose(gains, [0, 0.5, 1, 1])
    assert safety.soft_start(0.0, 0.0) == 1.0


def test_observer_sees_a_conservative_spring_give_back_exactly_what_it_got():
    k, energy, depth = 300.0, 0.0, 0.0
    path = np.concatenate([np.linspace(0, 5e-3, 200), np.linspace(5e-3, 0, 200)])
    stored = 0.0
    for x in path:
        # the mean force over the step: no error of sampling
        mean = vector(0, 0, k * (x + depth) / 2)
        energy = safety.observe(energy, mean, vector(0, 0, depth - x))
        stored = max(stored, energy)
        depth = x
    assert stored == pytest.approx(0.5 * k * 5e-3**2)
    assert energy == pytest.approx(0, abs=1e-15)


def test_controller_leaves_a_passive_force_alone():
    force = vector(1, 0, 0)
    assert safety.control(1e-3, vector(0.1, 0, 0), 1e-3, 5.0, force) == 0
    np.testing.assert_array_equal(force, [1, 0, 0])


def test_controller_takes_back_the_deficit_within_a_period():
    energy, velocity, period = -2e-6, vector(0.1, 0, -0.1), 1e-3
    force = np.zeros(3)
    safety.control(energy, velocity, period, 5.0, force)
    assert safety.observe(energy, force, velocity * period) == pytest.approx(0, abs=1e-18)


def test_controller_damping_is_bounded_also_at_rest():
    force = np.zeros(3)
    assert safety.control(-1.0, vector(0.1, 0, 0), 1e-3, 5.0, force) == 5.0
    np.testing.assert_allclose(force, [-0.5, 0, 0])
    force = np.zeros(3)
    assert safety.control(-1.0, np.zeros(3), 1e-3, 5.0, force) == 5.0
    np.testing.assert_array_equal(force, 0)


def returned_energy(max_damping):
    """A spring of 100 N/m whose force comes 20 ms late, pressed to and fro by 3 mm at 2 Hz."""
    dt, k, delay = 1e-3, 100.0, 20
    t = np.arange(0, 3, dt)
    x = -3e-3 * (1 - np.cos(2 * np.pi * 2 * t)) / 2
    energy = lowest = 0.0
    last = np.zeros(3)
    for i in range(1, len(t)):
        moved = vector(0, 0, x[i] - x[i - 1])
        energy = safety.observe(energy, last, moved)
        lowest = min(lowest, energy)
        last = vector(0, 0, -k * x[max(i - delay, 0)])
        safety.control(energy, moved / dt, dt, max_damping, last)
    return lowest


def test_energy_returned_never_exceeds_what_was_observed_by_more_than_one_period():
    """A late spring makes k A^2 pi sin(w d)/4 a cycle; under control a period's work at most."""
    made = 100.0 * 3e-3**2 * np.pi * np.sin(2 * np.pi * 2 * 0.02) / 4
    one_period = 100.0 * 3e-3 * (np.pi * 2 * 3e-3) * 1e-3
    assert returned_energy(0.0) < -4 * made
    assert returned_energy(50.0) > -one_period


@given(forces, forces, st.floats(1e-3, 10))
def test_slew_limit_bounds_the_step_and_keeps_its_direction(last, wanted, largest):
    force = wanted.copy()
    safety.limit_slew(last, largest, force)
    step, full = force - last, wanted - last
    assert np.linalg.norm(step) <= largest * (1 + 1e-12) + 1e-12
    assert np.linalg.norm(np.cross(step, full)) <= 1e-9 * (1 + full @ full)
    assert step @ full >= 0


@given(forces, st.floats(0, 20))
@example(vector(3.0, 4.0, 0.0), 5e-162)
@example(vector(5e-162, 0.0, 0.0), 4e-162)
@example(vector(0.0, 1e-170, 0.0), 0.0)
def test_clamp_bounds_the_norm_and_keeps_the_direction(wanted, ceiling):
    force = wanted.copy()
    safety.clamp(ceiling, force)
    # The squares of such numbers are none; hypot scales them first.
    assert math.hypot(*force) <= ceiling * (1 + 1e-12) + sys.float_info.min
    assert np.linalg.norm(np.cross(force, wanted)) <= 1e-9 * (1 + wanted @ wanted)


@given(
    st.lists(st.tuples(forces, st.floats(0, 1)), min_size=1, max_size=40),
    st.floats(0.5, 10),
)
def test_norm_and_slew_hold_at_every_sample_whatever_is_wanted(wishes, max_force):
    """The gain sinks no faster than settings allow: max_force / fade <= max_slew."""
    max_step = 0.05 * max_force
    last, gain = np.zeros(3), 0.0
    for wanted, target in wishes:
        gain += np.clip(target - gain, -0.05, 0.05)
        force = wanted.copy()
        safety.settle(last, max_step, max_force, gain, force)
        assert np.linalg.norm(force) <= gain * max_force * (1 + 1e-12) + 1e-15
        assert np.linalg.norm(force - last) <= max_step * (1 + 1e-9)
        last = force


def test_a_step_from_5_n_to_zero_takes_the_time_that_the_slew_limit_says():
    force, ticks = vector(5, 0, 0), 0
    while np.any(force):
        last, force = force, np.zeros(3)
        safety.settle(last, 0.5, 6.0, 1.0, force)
        ticks += 1
    assert ticks == 10


def test_a_gain_of_zero_is_zero_force():
    force = vector(1, 1, 1)
    safety.settle(np.zeros(3), 1.0, 5.0, 0.0, force)
    np.testing.assert_array_equal(force, 0)


def test_a_soft_start_that_begins_under_force_lets_it_down_at_the_slew_limit() -> None:
    last = np.array([0.0, 0.0, 2.0])
    force = np.array([0.0, 0.0, 2.0])
    for _ in range(3):
        before = last.copy()
        out = force.copy()
        safety.settle(before, 0.5, 3.3, 0.0, out)
        assert norm(out - before) <= 0.5 * (1 + 1e-9)
        assert norm(out) < norm(before)
        last = out
