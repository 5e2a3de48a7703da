"""Claims about the hand on the emulated arm, its script and its settings."""

import numpy as np
import pytest
from arms import STAY, move, script
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings, HandSettings
from cutting_trainer.haptic_bridge.scene_schema import SettingsError, Transform
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.scene_reader import read_section


def hand_on(*phases, seconds=1.0, transform=None, tremor=0.0, seed=0, **start):
    settings_ = ArmSettings.model_validate({'script': script(*phases, seconds=seconds, **start)})
    path = compile_script(settings_.script, transform or Transform())
    return EmulatedHand(HandSettings(tremor=tremor), path, seed)


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
