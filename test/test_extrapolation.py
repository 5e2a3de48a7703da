"""Claims about the laws that turn 30 Hz samples of the tissue's force into a force at 1 kHz."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cutting_trainer.haptic_bridge import extrapolation as ex
from cutting_trainer.haptic_bridge.proxy.coupling_spring import surface_stiffness

FRAME = 1 / 30
STIFF = 1e9


def ns(seconds):
    return round(seconds * 1e9)


def time_law(t, samples):
    (t0, f0), (t1, f1) = samples
    out = np.zeros(3)
    forces = np.array([[f0, 0, 0], [f1, 0, 0]], float)
    ex.time_linear(ns(t), np.array([ns(t0), ns(t1)]), forces, out)
    return out[0]


def position_law(p, samples, max_stiffness=STIFF):
    (p0, f0), (p1, f1) = samples
    out = np.zeros(3)
    ex.position_linear(
        np.array(p, float), np.array([p0, p1], float), np.array([f0, f1], float), max_stiffness, out
    )
    return out


def history(*samples, topology=1, state=1):
    h = np.zeros(1, ex.HISTORY)
    for time, position, force in samples:
        push(h, ns(time), position, force, topology=topology, state=state)
    return h


def push(h, time, position, force, k=0.0, depth=(0, 0, 0), **where):
    stiffness = k * np.diag([0.0, 0.0, 1.0])
    ex.push(h, time, position, force, stiffness, np.array(depth, float), **where)


def estimate(law, h, time, position, depth=(0, 0, 0), touching=True, limit=STIFF):
    out = np.zeros(3)
    at, d = np.array(position, float), np.array(depth, float)
    ex.estimate(law, h, time, at, d, touching, np.zeros((2, 3)), limit, out, np.zeros(3))
    return out


def test_constant_law_is_the_last_force():
    out = np.zeros(3)
    ex.constant(np.array([1.0, -2.0, 3.0]), out)
    np.testing.assert_array_equal(out, [1, -2, 3])


def test_time_law_is_exact_for_a_force_linear_in_time():
    assert time_law(0.05, [(0.0, 0.0), (FRAME, FRAME)]) == pytest.approx(0.05, rel=1e-6)


def test_time_law_overshoots_a_reversal_by_twice_what_holding_errs():
    """A wave of rate r that turns at t_i: after a frame T it errs by 2 r T, holding by r T."""
    rate, peak = 1.0, 0.5
    true = peak - rate * FRAME
    linear = time_law(2 * FRAME, [(0.0, peak - rate * FRAME), (FRAME, peak)])
    assert linear - peak == pytest.approx(rate * FRAME, rel=1e-6)
    assert (linear - true) / (peak - true) == pytest.approx(2.0, rel=1e-6)


def test_position_law_has_no_error_at_a_reversal_of_a_linear_tissue():
    k = 50.0
    samples = [([0, 0, -1e-3], [0, 0, k * 1e-3]), ([0, 0, -2e-3], [0, 0, k * 2e-3])]
    for depth in (3e-3, 2.5e-3, 1.5e-3, 0.5e-3):
        np.testing.assert_allclose(position_law([0, 0, -depth], samples), [0, 0, k * depth])


def test_printed_unsigned_projection_pushes_the_wrong_way_on_retreat_and_ours_does_not():
    samples = [([0, 0, -1e-3], [0, 0, 0.1]), ([0, 0, -2e-3], [0, 0, 0.2])]
    back = np.array([0, 0, -1.5e-3])
    unsigned = 0.2 + abs(-0.5e-3) / 1e-3 * 0.1
    signed = position_law(back, samples)[2]
    assert unsigned == pytest.approx(0.25)
    assert signed == pytest.approx(0.15)


def test_position_law_ignores_motion_across_the_line_of_the_samples():
    samples = [([0, 0, -1e-3], [0, 0, 0.1]), ([0, 0, -2e-3], [0, 0, 0.2])]
    np.testing.assert_allclose(position_law([5e-3, -7e-3, -2e-3], samples), [0, 0, 0.2])


@given(
    st.floats(0, ex.MIN_SAMPLE_DISTANCE_M * 0.999),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    st.tuples(*[st.floats(-5, 5)] * 3),
)
def test_a_resting_tool_holds_the_last_force(gap, position, force):
    samples = [([0, 0, 0], [0, 0, 1.0]), ([0, 0, -gap], force)]
    np.testing.assert_array_equal(position_law(position, samples), force)


@given(st.floats(-0.1, 0.1), st.floats(1.001 * ex.MIN_SAMPLE_DISTANCE_M, 0.02), st.floats(-3, 3))
def test_position_law_is_bounded_in_reach_and_slope(along, gap, change):
    samples = [([0, 0, 0], [0, 0, 0]), ([gap, 0, 0], [0, 0, change])]
    out = position_law([along, 0, 0], samples, max_stiffness=300.0)
    correction = abs(out[2] - change)
    assert correction <= ex.MAX_EXTRAPOLATION * abs(change) * (1 + 1e-9)
    assert correction <= 300.0 * abs(along - gap) * (1 + 1e-9) + 1e-15


def test_time_law_is_bounded_in_reach_and_holds_when_the_clock_stands():
    samples = [(0.0, 0.0), (FRAME, 1.0)]
    assert time_law(100.0, samples) == pytest.approx(1 + ex.MAX_EXTRAPOLATION)
    assert time_law(-100.0, samples) == 1.0
    assert time_law(1.0, [(FRAME, 0.0), (FRAME, 1.0)]) == 1.0


def blade_law(at, k, limit=STIFF, arms=((0.0,) * 3,) * 2, torque=(0.0,) * 3, force=(0.0,) * 3):
    """Law from a sample at the origin, of a blade from z = -1 to 2 cm whose lower half is held."""
    h = np.zeros(1, ex.HISTORY)
    before = np.array([[0, 0, 0.02], [0, 0, -0.01]])
    where = {'topology': 1, 'state': 2, 'torque': torque, 'arms': before}
    zero = np.zeros(3)
    ex.push(h, 0, zero, np.array(force), k, zero, immersed=np.array([0.25, 1 / 12]), **where)
    out, turning = np.zeros(3), np.zeros(3)
    at, law = np.array(at, float), ex.LOCAL_STIFFNESS
    ex.estimate(law, h, 0, at, zero, False, before + arms, limit, out, turning)
    return out, turning


def test_local_stiffness_is_exact_for_a_linear_tissue_in_every_direction():
    k = np.array([[40.0, 5, 0], [5, 60, -3], [0, -3, 80]])
    force, moved = np.array([0.0, 0.1, 0.2]), np.array([0.4e-3, -0.2e-3, 1e-3])
    out, _ = blade_law(moved, k, force=force)
    np.testing.assert_allclose(out, force - k @ moved)


def test_a_turned_blade_feels_the_springs_along_what_of_it_is_in_the_tissue():
    rng = np.random.default_rng(4)
    k = np.diag([40.0, 60.0, 80.0])
    moved, angle = 1e-3 * rng.normal(size=3), 1e-3 * np.array([1.0, -0.7, 0.0])
    force, per_place = np.array([0.05, 0.02, 0.0]), np.array([0.05, 0.02, 0.0])
    arms = np.array([np.cross(angle, a) for a in ([0, 0, 0.02], [0, 0, -0.01])])
    edge = np.array([0, 0, 0.03])
    out, torque = blade_law(
        moved, k, arms=arms, torque=np.cross(0.25 * edge, per_place), force=force
    )
    places = (np.arange(5000) + 0.5) / 10000
    ways = moved + arms[1] + places[:, None] * (arms[0] - arms[1])
    pulls = per_place - ways @ k
    now = edge + arms[0] - arms[1]
    np.testing.assert_allclose(out, pulls.mean(axis=0), rtol=1e-6, atol=1e-9)
    expected = np.cross(now, (places[:, None] * pulls).mean(axis=0))
    np.testing.assert_allclose(torque, expected, rtol=1e-4, atol=1e-9)


def test_local_stiffness_is_no_stiffer_than_the_device_renders():
    out, _ = blade_law([0, 0, -1e-3], 5000 * np.eye(3), limit=400.0)
    assert np.linalg.norm(out) <= 400.0 * 1e-3


def surface_law(depth, at, force, k, here):
    out = np.zeros(3)
    ex.local_surface(np.array(depth, float), np.array(at, float), np.array(force), k, here, out)
    return out


@given(st.floats(0, 6.28), st.floats(1e-4, 0.01), st.floats(1e-4, 0.01), st.floats(10, 500))
def test_surface_law_is_exact_on_an_even_plane_however_it_is_tilted(angle, before, now, k):
    n = np.array([np.sin(angle), 0.0, np.cos(angle)])
    force = surface_law(now * n, before * n, k * before * n, k, k)
    np.testing.assert_allclose(force, k * now * n, rtol=1e-9, atol=1e-12)


def test_surface_law_turns_the_force_with_the_surface_over_an_edge():
    half = np.sqrt(0.5)
    force = surface_law([half * 2e-3, 0, half * 2e-3], [0, 0, 2e-3], [0, 0, 0.2], 100.0, 100.0)
    np.testing.assert_allclose(force, [half * 0.2, 0, half * 0.2])


def test_surface_law_never_pulls_and_ends_where_the_surface_is_left():
    assert not surface_law([0, 0, 0], [0, 0, 2e-3], [0, 0, 0.2], 100.0, 100.0).any()
    assert not surface_law([0, 0, 1e-3], [0, 0, 5e-3], [0, 0, 0.1], 100.0, 100.0).any()


def test_stiffness_of_a_surface_is_that_along_its_normal_and_the_largest_where_unknown():
    n = np.array([0.6, 0.0, 0.8])
    assert surface_stiffness(80.0 * np.outer(n, n), 200.0) == pytest.approx(80.0)
    assert surface_stiffness(np.zeros((3, 3)), 200.0) == 200.0
    assert surface_stiffness(900.0 * np.outer(n, n), 200.0) == 200.0


def sloping(k, gradient, depth):
    """Stiffness matrix, depth and force of a contact along z whose k changes along x [N/m^2]."""
    force = np.array([0.0, 0.0, k * depth])
    matrix = np.array([[0.0, 0, 0], [0, 0, 0], [-depth * gradient, 0, k]])
    return matrix, np.array([0.0, 0.0, depth]), force


@given(st.floats(10, 100), st.floats(-4e3, 4e3), st.floats(1e-3, 6e-3), st.floats(-1e-3, 1e-3))
def test_stiffness_that_changes_along_the_surface_is_followed_and_not_across_it(k, slope, d, x):
    matrix, depth, force = sloping(k, slope, d)
    for across in (0.0, 2e-3):
        way = np.array([x, across, -across])
        there = ex.stiffness_along_path(matrix, depth, force, way, 1000.0)
        assert there == pytest.approx(np.clip(k + slope * x, k / 2, 2 * k))


def test_force_between_frames_is_that_of_the_stiffness_where_the_tool_has_come_to():
    matrix, depth, force = sloping(40.0, 5e3, 4e-3)
    h = np.zeros(1, ex.HISTORY)
    ex.push(h, 0, [0, 0, -4e-3], force, matrix, depth, topology=1, state=1)
    felt = estimate(ex.LOCAL_STIFFNESS, h, ns(0.02), [2e-3, 0, -5e-3], depth=(0, 0, 5e-3))
    np.testing.assert_allclose(felt, [0, 0, 50.0 * 5e-3])


def test_stiffness_on_the_way_is_no_larger_than_what_is_rendered():
    matrix, depth, force = sloping(90.0, 1e4, 4e-3)
    assert ex.stiffness_along_path(matrix, depth, force, np.array([9e-3, 0, 0]), 120.0) == 120.0


@pytest.mark.parametrize('law', [ex.CONSTANT, ex.TIME])
def test_one_sample_is_held(law):
    h = history((0.0, [0, 0, 0], [0, 0, 0.4]))
    np.testing.assert_array_equal(estimate(law, h, ns(1.0), [0, 0, 0.01]), [0, 0, 0.4])


def test_first_sample_of_a_contact_is_followed_by_the_stiffness_until_there_is_a_line():
    h = np.zeros(1, ex.HISTORY)
    push(h, 0, [0, 0, -1e-3], [0, 0, 0.06], 60.0, depth=(0, 0, 1e-3), topology=1, state=1)
    deeper = estimate(ex.POSITION, h, ns(0.02), [0, 0, -3e-3], depth=(0, 0, 3e-3))
    np.testing.assert_allclose(deeper, [0, 0, 0.18])


@pytest.mark.parametrize('law', ex.LAWS.values())
def test_a_resting_tool_does_not_blow_up(law):
    """A trembling encoder under samples that differ: the force stays with the last of them."""
    h = np.zeros(1, ex.HISTORY)
    noise = np.random.default_rng(0)
    for i in range(60):
        tip = [0, 0, -2e-3 + 2e-5 * noise.integers(-1, 2)]
        push(h, ns(i * FRAME), tip, [0, 0, 0.2 + 0.02 * noise.uniform(-1, 1)], 50.0, (0, 0, 2e-3),
             topology=1, state=1)  # fmt: skip
        for _ in range(5):
            at = [0, 0, -2e-3 + 2e-5 * noise.integers(-1, 2)]
            out = estimate(law, h, ns((i + 0.9) * FRAME), at, depth=(0, 0, -at[2]))
            assert abs(out[2] - h[0]['force'][1, 2]) < 0.05


@pytest.mark.parametrize('change', [{'topology': 2}, {'state': 2}])
def test_a_cut_or_another_contact_state_makes_older_samples_void(change):
    h = history((0.0, [0, 0, 0], [0, 0, 0.1]), (FRAME, [0, 0, -1e-3], [0, 0, 0.2]))
    assert h[0]['count'] == 2
    kept = {'topology': 1, 'state': 1} | change
    push(h, ns(2 * FRAME), [0, 0, -2e-3], [0, 0, 0.9], **kept)
    assert h[0]['count'] == 1
    np.testing.assert_array_equal(estimate(ex.TIME, h, ns(3 * FRAME), [0, 0, 0]), [0, 0, 0.9])


@pytest.mark.parametrize(
    ('change', 'leaving'), [({}, 1.5), ({'topology': 2}, 1.5), ({'state': 3}, 0.0)]
)
def test_a_blade_leaves_as_two_samples_say_though_a_cut_lies_between_them(change, leaving):
    h, zero = np.zeros(1, ex.HISTORY), np.zeros(3)
    arms = np.array([[0.0, 0.0, 0.020], [0.0, 0.0, 0.0]])
    for z, inside, changed in ((0.0, 0.010, {}), (0.002, 0.007, change)):
        places = np.array([inside / 0.040, (inside / 0.020) ** 2 / 3])
        where = {'topology': 1, 'state': 2} | changed
        ex.push(h, 0, [0, 0, z], zero, np.eye(3), zero, arms=arms, immersed=places, **where)
    assert h['leaving'][0] == pytest.approx(leaving)


def test_stiffness_outlives_a_sample_without_one():
    h = np.zeros(1, ex.HISTORY)
    push(h, 0, [0, 0, 0], [0, 0, 0], 30.0, topology=1, state=1)
    ex.clear(h)
    push(h, 1, [0, 0, 0], [0, 0, 0], topology=1, state=0)
    np.testing.assert_array_equal(h[0]['stiffness'], 30 * np.diag([0, 0, 1]))
