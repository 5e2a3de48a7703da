"""Claims about the emulated arm and its hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from haptic_bridge.arm import EmulatedArm
from haptic_bridge.arm_settings import ArmSettings, HandSettings
from haptic_bridge.hand import Hand, compile_script
from haptic_bridge.settings import SettingsError, Transform
from tissue_sim.errors import SceneError
from tissue_sim.scene_file import read_section

MS = 1_000_000
LIMP = {'stiffness': 0.0, 'damping': 0.0}
STAY = {'start': {'position': (0.0, 0.0, 0.0)}, 'phases': ({'kind': 'rest'},)}


def move(*waypoints, kind='approach', **phase):
    points = tuple({'position': point} for point in waypoints)
    return {'kind': kind, 'waypoints': points, **phase}


def script(*phases, seconds=1.0, **start):
    return {
        'start': {'position': (0.0, 0.0, 0.0), **start},
        'seconds': seconds,
        'phases': phases,
    }


def make_arm(*, seed=0, body_force=False, transform=None, **changes) -> EmulatedArm:
    """An exact arm without friction, unless `changes` say else."""
    exact = {
        'encoder_resolution': 0.0,
        'force_resolution': 0.0,
        'viscous_friction': 0.0,
        'coulomb_friction': 0.0,
        'script': STAY,
    }
    arm = ArmSettings.model_validate(exact | changes)
    hand = Hand(arm.hand, compile_script(arm.script, transform or Transform()), seed)
    return EmulatedArm(arm, hand, body_force=body_force)


def run(arm, ticks, force=None, enabled=True, start=0):
    """Lets milliseconds pass with a command in each; returns true positions and motor forces."""
    positions, forces = [], []
    for tick in range(start + 1, start + ticks + 1):
        if force is not None:
            arm.command(tick * MS, force, tick * MS)
        arm.advance(tick * MS, enabled=enabled)
        positions.append(arm.true_position.copy())
        forces.append(arm.force.copy())
    return np.array(positions), np.array(forces)


def kinetic(arm, mass=0.1):
    return 0.5 * mass * arm.true_velocity @ arm.true_velocity


# Mechanics


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


# Sensors


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


# Motors


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
    assert arm.rejected == 10


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
    assert arm.rejected == 50
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


# Hand and script


def hand_on(*phases, seconds=1.0, transform=None, tremor=0.0, seed=0, **start):
    settings_ = ArmSettings.model_validate({'script': script(*phases, seconds=seconds, **start)})
    path = compile_script(settings_.script, transform or Transform())
    return Hand(HandSettings(tremor=tremor), path, seed)


def test_minimum_jerk_passes_the_middle_at_half_time_with_15_8_of_the_mean_speed():
    hand = hand_on(move((0.08, 0, 0)), seconds=2.0)
    hand.move_to(1.0, 0.0)
    assert_allclose(hand.position, (0.04, 0, 0), atol=1e-12)
    assert_allclose(hand.velocity, (0.04 * 15 / 8, 0, 0), atol=1e-12)


def test_velocity_of_the_target_is_the_derivative_of_its_position():
    hand = hand_on(move((0.02, 0.01, 0), (0, 0, -0.01)), tremor=1e-3)
    step = 1e-6
    for time in np.linspace(0.05, 0.95, 13):
        hand.move_to(time - step, time - step)
        before = hand.position.copy()
        hand.move_to(time + step, time + step)
        slope = (hand.position - before) / (2 * step)
        hand.move_to(time, time)
        assert_allclose(hand.velocity, slope, atol=1e-6)


def test_target_rests_at_every_waypoint_and_phases_last_their_share():
    hand = hand_on(
        move((0.01, 0, 0), share=1),
        move((0.01, 0, -0.01), (0.01, 0, 0), kind='palpate', repeat=2, share=4),
        {'kind': 'rest', 'name': 'wait', 'share': 3},
        seconds=8.0,
    )
    assert_allclose(hand.script.phase_ends, (1, 5, 8))
    assert_allclose(hand.script.times, (0, 1, 2, 3, 4, 5, 8))
    for time, height in ((1, 0), (2, -0.01), (3, 0), (4, -0.01), (5, 0), (9, 0)):
        hand.move_to(time, 0.0)
        assert_allclose(hand.position, (0.01, 0, height), atol=1e-12)
        assert_allclose(hand.velocity, 0, atol=1e-12)
    phases = [hand.script.phase_at(t) for t in (0.5, 1.5, 6, 99)]
    assert phases == [
        ('approach', 'approach'),
        ('palpate', 'palpate'),
        ('wait', 'rest'),
        ('wait', 'rest'),
    ]


def test_seconds_scale_the_whole_script():
    settings_ = ArmSettings.model_validate({'script': script(move((0.01, 0, 0)), seconds=4.0)})
    longer = compile_script(settings_.script, Transform(), 10.0)
    assert longer.seconds == 10.0
    assert_array_equal(longer.phase_ends, (10.0,))


def test_script_in_the_tissue_frame_reaches_the_hand_in_the_device_frame():
    transform = Transform(
        translation=(0.1, 0.2, 0.3), rotation_rpy_deg=(10.0, 20.0, 130.0), scale=2.0
    )
    point = {'position': (0.12, 0.2, 0.31), 'rpy_deg': (5, 6, 7)}
    hand = hand_on({'kind': 'approach', 'waypoints': (point,)}, transform=transform)
    hand.move_to(1.0, 0.0)
    assert_allclose(transform.to_tissue(hand.position), (0.12, 0.2, 0.31), atol=1e-12)
    in_tissue = transform.rotation() @ Rotation.from_quat(hand.orientation).as_matrix()
    expected = Rotation.from_euler('xyz', (5, 6, 7), degrees=True).as_matrix()
    assert_allclose(in_tissue, expected, atol=1e-12)


def test_orientation_turns_the_short_way_and_stays_a_unit_quaternion():
    points = (
        {'position': (0, 0, 0), 'rpy_deg': (0, 0, 170)},
        {'position': (0, 0, 0), 'rpy_deg': (0, 0, -170)},
    )
    hand = hand_on({'kind': 'palpate', 'waypoints': points}, seconds=2.0)
    hand.move_to(1.5, 0.0)
    turn = Rotation.from_quat(hand.orientation).as_rotvec(degrees=True)
    assert_allclose(np.abs(turn), (0, 0, 180), atol=1e-6)
    assert_allclose(np.linalg.norm(hand.orientation), 1, rtol=1e-12)


def test_waypoint_without_orientation_keeps_the_last_one():
    points = ({'position': (0, 0, 0), 'rpy_deg': (0, 30, 0)}, {'position': (0.01, 0, 0)})
    hand = hand_on({'kind': 'cut', 'waypoints': points})
    hand.move_to(1.0, 0.0)
    turn = Rotation.from_quat(hand.orientation).as_rotvec(degrees=True)
    assert_allclose(turn, (0, 30, 0), atol=1e-9)


def test_tremor_has_its_amplitude_and_band_and_comes_from_its_seed():
    times = np.arange(0, 60, 0.005)

    def trace(seed):
        hand = hand_on({'kind': 'rest'}, tremor=1e-3, seed=seed)
        positions = []
        for time in times:
            hand.move_to(0.0, time)
            positions.append(hand.position.copy())
        return np.array(positions)

    first = trace(3)
    assert_array_equal(first, trace(3))
    assert np.abs(first - trace(4)).max() > 1e-4
    assert_allclose(first.std(axis=0), 1e-3, rtol=0.1)
    power = np.abs(np.fft.rfft(first[:, 0] * np.hanning(len(times)))) ** 2
    band = np.fft.rfftfreq(len(times), 0.005)
    assert power[(band > 7.9) & (band < 12.1)].sum() > 0.999 * power.sum()


def test_hand_that_would_have_to_fly_is_refused_with_the_time_it_needs():
    settings_ = ArmSettings.model_validate({'script': script(move((0.5, 0, 0)))})
    compile_script(settings_.script, Transform())
    with pytest.raises(SettingsError, match='a hand reaches 2 m/s'):
        compile_script(settings_.script, Transform(), 0.2)


# Settings


@pytest.mark.parametrize(
    ('changes', 'sentence'),
    [
        ({'mass': 0}, 'mass'),
        ({'watchdog': 0.005, 'rate': 100}, 'less than five periods'),
        ({'hand': {'stifness': 3}}, 'stifness'),
        ({'script': script({'kind': 'cut'})}, 'needs waypoints'),
        ({'script': script()}, 'phases'),
        ({'script': script(move((0, 0, 0), kind='hover'))}, 'approach'),
        ({'script': script({'kind': 'rest'}, quaternion=(1, 1, 0, 0))}, 'must be 1'),
        (
            {'script': script({'kind': 'rest'}, quaternion=(1, 0, 0, 0), rpy_deg=(0, 0, 0))},
            'delete one',
        ),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, sentence):
    with pytest.raises(ValidationError, match=sentence):
        ArmSettings.model_validate({'script': STAY} | changes)


def test_a_script_knows_whether_it_means_to_cut():
    def cuts(*phases):
        return ArmSettings.model_validate({'script': script(*phases)}).script.cuts

    assert cuts(move((0, 0, 0)), move((0, 0, 0), kind='cut'))
    assert not cuts(move((0, 0, 0)), {'kind': 'rest'})


def test_error_in_a_scene_names_file_line_and_key(tmp_path):
    scene = tmp_path / 'scene.yaml'
    scene.write_text(
        'arm:\n  mass: 9\n  script: {start: {position: [0, 0, 0]}, phases: [{kind: rest}]}\n'
    )
    with pytest.raises(SceneError, match=r'scene\.yaml:2: arm\.mass is 9'):
        read_section(scene, 'arm', ArmSettings)
