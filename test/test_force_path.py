"""Claims about whole ticks, without ROS: a device over a flat tissue simulated at 30 Hz."""

import numpy as np
import pytest
from rig import FRAME, MS, PROFILE, QUIET, RADIUS, UNIT, K, Rig, lowered, pressed, spoiled

from cutting_trainer.haptic_bridge.force_kernels import INSIDE, NONE, TOUCHING
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    Transform,
)
from cutting_trainer.haptic_bridge.warm_up import warm_up
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState


def test_force_is_zero_before_contact_rises_with_depth_and_is_zero_after():
    rig = Rig()
    way = lowered(5e-3, 400)
    before = rig.run(way[way > RADIUS])
    assert not before.any()
    rig.run(way[way <= RADIUS])
    held = [rig.run(np.full(100, RADIUS - d))[-1, 2] for d in (1e-3, 2e-3, 4e-3)]
    np.testing.assert_allclose(held, [K * 1e-3, K * 2e-3, K * 4e-3], rtol=1e-6)
    rig.run(np.linspace(RADIUS, RADIUS + 2e-3, 50))
    assert not np.any(rig.forces[-1])
    assert rig.contact('state') == (NONE,)


def test_position_law_follows_a_linear_tissue_between_the_frames():
    rig = pressed()
    t = np.arange(1000) / 1000
    depth = 3e-3 + 2e-3 * np.cos(2 * np.pi * t)
    force = rig.run(RADIUS - depth)[:, 2]
    wrong = np.abs(force - K * depth)
    # where the tool turns, two samples can be too close for a line and the force is held
    assert np.percentile(wrong, 95) < 0.03 * K * 5e-3


def test_contact_lost_between_frames_is_felt_at_once():
    rig = pressed()
    rig.sim = False
    ticks = int(np.ceil(K * 5e-3 / (PROFILE.max_slew * 1e-3)))
    forces = rig.run(np.full(ticks + 1, RADIUS + 1e-4))
    assert not forces[-1].any()
    assert ticks < FRAME


def test_contact_made_between_frames_is_felt_at_once_no_stiffer_than_the_tissue_was():
    rig = pressed()
    rig.run(np.full(40, RADIUS + 1e-3))
    rig.sim = False
    force = rig.run(np.full(5, RADIUS - 2e-3))[-1, 2]
    assert force == pytest.approx(K * 2e-3)


def test_onset_of_contact_does_not_drop_when_the_tissue_answers():
    """The tool comes near, so the tissue has told its stiffness before the touch."""
    rig = Rig()
    rig.near = True
    force = rig.run(lowered(5e-3, 400))[:, 2]
    depth = np.maximum(RADIUS - lowered(5e-3, 400), 0.0)
    np.testing.assert_allclose(force, K * depth, atol=0.02 * K * 5e-3)


@pytest.mark.parametrize('height', [5e-3, 0.02, 0.5])
def test_a_free_tool_names_the_triangle_that_it_would_touch_however_far(height):
    rig = Rig()
    rig.run([RADIUS + height])
    assert rig.contact('state') == (NONE,)
    assert sum(rig.contact('weights')) == pytest.approx(1)
    np.testing.assert_allclose(rig.contact('normal'), [0, 0, 1])


@pytest.mark.parametrize('forces', ['one', 'two'])
def test_one_force_is_the_proxys_and_two_are_the_tissues(forces):
    """A tissue that says it is softer than it answers: the two differ."""
    rig = Rig(haptics=QUIET.model_copy(update={'forces': forces}))
    rig.spoil = lambda sample: spoiled(sample, stiffness=(*(0.0,) * 8, K / 2))
    force = rig.run(np.concatenate([lowered(5e-3, 300), np.full(100, RADIUS - 5e-3)]))[-1, 2]
    assert force == pytest.approx((K / 2 if forces == 'one' else K) * 5e-3, rel=1e-6)


def test_a_tissue_that_has_said_nothing_of_itself_is_felt_by_a_tenth_of_the_devices_force():
    rig = Rig()
    rig.run(np.full(40, RADIUS + 1e-3))
    rig.sim = False
    for depth, force in ((1e-3, 200.0 * 1e-3), (5e-3, 0.1 * PROFILE.max_force)):
        assert rig.run(np.full(5, RADIUS - depth))[-1, 2] == pytest.approx(force)


def test_a_stiffness_that_arrives_after_the_touch_it_foresaw_counts():
    rig = Rig()
    rig.run(np.full(40, RADIUS + 1e-3))
    rig.near = True
    late = rig._sample()
    assert rig.run([RADIUS - 1e-3])[0, 2] == pytest.approx(200.0 * 1e-3)
    rig._sample, rig.ms = lambda: late, FRAME - 1
    assert rig.run([RADIUS - 1e-3])[0, 2] == pytest.approx(K * 1e-3)


def test_proxy_spring_and_tissue_share_the_depth_by_their_stiffness():
    rig = pressed(depth=5e-3)
    np.testing.assert_allclose(rig.contact('external_force'), [0, 0, -K * 5e-3], atol=1e-9)
    assert sum(rig.contact('weights')) == pytest.approx(1)
    np.testing.assert_allclose(rig.contact('normal'), [0, 0, 1], atol=1e-9)
    stretch = np.subtract(rig.contact('device'), rig.contact('proxy'))
    np.testing.assert_allclose(200.0 * stretch, rig.contact('external_force'), atol=1e-9)


def test_a_touched_surface_never_pulls():
    rig = pressed()
    rig.spoil = lambda sample: spoiled(sample, force=(0.0, 0.0, -1.0))
    assert not rig.run(np.full(100, RADIUS - 5e-3))[-1].any()


def test_silent_simulation_fades_after_100_ms_and_is_zero_after_150():
    rig = pressed()
    rig.run(np.full(FRAME - rig.ms % FRAME, RADIUS - 5e-3))
    rig.sim = False
    force = np.linalg.norm(rig.run(np.full(200, RADIUS - 5e-3)), axis=1) / (K * 5e-3)
    # Ages count 3 ms more than has passed, for what a sample may have lain unread.
    np.testing.assert_allclose(force[:96], 1)
    assert force[121] == pytest.approx(0.5, abs=0.03)
    assert (np.diff(force[97:147]) < 0).all()
    assert not force[147:].any()
    assert rig.path.stale_trips == 1
    assert rig.state is CrtkState.ENABLED


def test_a_simulation_that_returns_is_let_in_softly():
    rig = pressed(haptics=HapticsSettings(soft_start=0.2, max_damping=0.0))
    rig.sim = False
    rig.run(np.full(300, RADIUS - 5e-3))
    rig.sim = True
    force = rig.run(np.full(400, RADIUS - 5e-3))[:, 2]
    assert np.diff(force).max() <= K * 5e-3 / 200 * 1.01
    assert force[-1] == pytest.approx(K * 5e-3)


def test_forces_that_waited_in_a_queue_are_as_old_as_that():
    rig = pressed()
    rig.waited = 90
    force = rig.run(np.full(200, RADIUS - 5e-3))[:, 2] / (K * 5e-3)
    assert force[FRAME - 1 :].min() < 1 and rig.path.stale_trips
    rig.waited = 150
    assert not rig.run(np.full(200, RADIUS - 5e-3))[FRAME:].any()
    rig.waited = 0
    assert rig.run(np.full(200, RADIUS - 5e-3))[-1, 2] == pytest.approx(K * 5e-3)


def test_a_surface_that_lags_behind_the_forces_counts_as_silence():
    rig = pressed()
    rig.mesh = False
    rig.run(np.full(200, RADIUS - 5e-3))
    assert rig.path.simulation_age(rig.now) > 0.1
    assert not np.any(rig.forces[-1])


def test_silent_device_is_a_fault_at_zero_force_after_20_ms():
    rig = pressed()
    rig.poses = False
    force = rig.run(np.full(40, 0.0))[:, 2]
    np.testing.assert_allclose(force[:20], K * 5e-3)
    assert not force[20:].any()
    assert rig.state is CrtkState.FAULT
    faults = [tick.fault for tick in rig.ticks if tick.fault]
    assert faults == ['no valid device pose for 20 ms']


def test_poses_with_a_zero_stamp_are_no_poses():
    rig = pressed()
    for _ in range(30):
        rig.now += MS
        out = rig.path.tick(
            rig.now,
            state=rig.state,
            pose=StampedMessage(0, '', (0, 0, 0, *UNIT)),
            surface=rig.surface,
        )
        if out.fault:
            break
    assert out.fault == 'no valid device pose for 20 ms'


@pytest.mark.parametrize(
    ('position', 'orientation', 'word'),
    [
        ((np.nan, 0, 0), UNIT, 'not finite'),
        ((0, 0, 0), (0, 0, 0, 0), 'quaternion'),
        ((0, 0, 90.0), UNIT, 'metre'),
        ((1.0, 0, 0), UNIT, 'jumped'),
    ],
)
def test_a_pose_that_cannot_be_is_a_fault_at_zero_force_in_the_same_tick(
    position, orientation, word
):
    rig = pressed()
    assert np.any(rig.forces[-1])
    out = rig.tick(position, orientation)
    assert word in out.fault
    assert not np.any(out.wrench)
    assert np.isfinite(out.contact).all()


@pytest.mark.parametrize('bad', [np.nan, np.inf, 1e6])
def test_a_tissue_force_that_cannot_be_is_a_fault_at_zero_force(bad):
    rig = pressed()
    rig.spoil = lambda sample: spoiled(sample, force=(0.0, bad, 0.0))
    forces = rig.run(np.full(40, RADIUS - 5e-3))
    assert rig.state is CrtkState.FAULT
    assert np.isfinite(forces).all()
    assert not forces[-1].any()


def test_fault_stays_until_enabled_again_and_then_all_is_well():
    rig = pressed()
    rig.tick((1.0, 0.0, 0.0))
    assert rig.state is CrtkState.FAULT
    assert not rig.run(np.full(100, RADIUS - 5e-3)).any()
    rig.state = CrtkState.ENABLED
    rig.run(np.full(50, RADIUS + 1e-3))
    force = rig.run(np.concatenate([lowered(5e-3, 300), np.full(50, RADIUS - 5e-3)]))
    assert rig.state is CrtkState.ENABLED
    assert force[-1, 2] == pytest.approx(K * 5e-3)


@pytest.mark.parametrize('state', [CrtkState.DISABLED, CrtkState.PAUSED])
def test_no_force_and_no_contact_unless_enabled(state):
    rig = pressed()
    rig.state = state
    forces = rig.run(np.full(20, RADIUS - 5e-3))
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert steps.max() <= PROFILE.max_slew * 1e-3 * (1 + 1e-9)
    assert not forces[-1].any()
    assert rig.contact('state') == (NONE,)
    assert not np.any(rig.contact('external_force'))


def test_norm_and_slew_hold_whatever_the_tissue_says():
    profile = DeviceProfile(max_force=0.5, max_slew=20.0, max_stiffness=1000.0)
    rig = Rig(profile=profile)
    rng = np.random.default_rng(1)
    rig.spoil = lambda sample: spoiled(sample, force=tuple(rng.normal(0, 20, 3)))
    t = np.arange(3000) / 1000
    forces = rig.run(RADIUS - 2e-3 + 4e-3 * np.sin(2 * np.pi * 3 * t))
    assert np.linalg.norm(forces, axis=1).max() <= 0.5 * (1 + 1e-12)
    assert np.linalg.norm(np.diff(forces, axis=0), axis=1).max() <= 20.0 * 1e-3 * (1 + 1e-9)
    assert np.any(forces)


def test_soft_start_bounds_force_by_the_time_since_enabling():
    rig = Rig(haptics=HapticsSettings(soft_start=0.5, max_damping=0.0))
    rig.run(np.full(40, RADIUS + 1e-3))
    rig.state = CrtkState.DISABLED
    rig.run([RADIUS + 1e-3])
    rig.state = CrtkState.ENABLED
    force = rig.run(np.full(500, RADIUS - 5e-3))[:, 2]
    share = np.minimum(np.arange(500) / 500, 1)
    assert (force <= 200.0 * 5e-3 * share + 1e-9).all()


def test_repeated_and_reordered_messages_change_nothing():
    rig = pressed()
    before = rig.path.rejections.total
    out = rig.tick((0.0, 0.0, RADIUS - 4e-3), stamp=rig.now - 5 * MS)
    assert rig.path.rejections.total == before + 1
    assert out.wrench[2] == pytest.approx(K * 5e-3)


def test_clock_of_the_device_that_jumps_back_is_a_fault_and_can_be_left():
    rig = pressed()
    for i in range(30):
        rig.tick((0.0, 0.0, RADIUS - 5e-3), stamp=(i + 1) * MS)
    assert rig.state is CrtkState.FAULT
    rig.state = CrtkState.ENABLED
    for i in range(60):
        rig.tick((0.0, 0.0, RADIUS - 5e-3), stamp=(i + 31) * MS)
    assert rig.state is CrtkState.ENABLED


def test_announced_cut_releases_the_proxy_and_is_bounded_by_the_resistance():
    rig = pressed()
    rig.inside = True
    forces = rig.run(np.full(100, RADIUS - 5e-3))
    assert rig.contact('state') == (INSIDE,)
    assert rig.contact('proxy') == rig.contact('device')
    assert not np.any(rig.contact('external_force'))
    assert forces[-1, 2] == pytest.approx(0.3)
    rig.inside = False
    rig.run(np.full(FRAME, RADIUS + 5e-3))
    assert rig.contact('state') == (NONE,)


def test_a_blade_of_which_no_part_is_in_tissue_transmits_no_force():
    rig = pressed()
    rig.inside = True
    rig.spoil = lambda sample: spoiled(sample, resistance=(0.0,))
    assert not rig.run(np.full(200, RADIUS - 5e-3))[-1].any()


def test_a_blade_that_is_drawn_out_fast_is_not_held_5_mm_beyond_the_surface():
    """The last word of the tissue is old by then; inside, the blade is held as before."""
    rig = pressed()
    rig.inside = True
    assert rig.run(np.full(100, RADIUS - 5e-3))[-1].any()
    rig.sim = False
    end = rig.tool.blade_tip[2]
    forces = rig.run(np.linspace(RADIUS - 5e-3, 5.2e-3 - end, 20))
    assert rig.contact('state') == (INSIDE,)
    assert forces[0].any()
    assert not forces[-1].any()


def test_sliding_into_a_cut_does_not_interrupt_the_force():
    rig = pressed(depth=3e-3)
    rig.inside = True
    force = rig.run(np.full(100, RADIUS - 3e-3))[:, 2]
    np.testing.assert_allclose(force, K * 3e-3, rtol=1e-6)


def test_a_change_of_connectivity_voids_the_line_of_the_older_sample():
    rig = pressed(haptics=QUIET.model_copy(update={'extrapolation': 'time'}))
    rig.run(np.linspace(RADIUS - 5e-3, RADIUS - 6e-3, FRAME))
    rig.topology = 2
    rig.run(np.full(FRAME - rig.ms % FRAME, RADIUS - 6e-3))
    at = rig.forces[-1]
    rig.sim = False
    np.testing.assert_allclose(rig.run(np.full(10, RADIUS - 8e-3)), [at] * 10)


def test_device_frame_maps_positions_in_and_back():
    turn = Transform(translation=(0.1, 0.2, 0.3), rotation_rpy_deg=(0, 90, 0), scale=2.0)
    p = np.array([0.01, -0.02, 0.03])
    np.testing.assert_allclose(turn.to_tissue(p), [0.1 + 0.06, 0.2 - 0.04, 0.3 - 0.02])
    np.testing.assert_allclose(turn.to_device(turn.to_tissue(p)), p)


def test_a_rotated_device_feels_the_same_force_along_its_own_axis():
    """The device lies on its side: its x is the tissue's -z."""
    turn = Transform(translation=(0, 0, 0.05), rotation_rpy_deg=(0, 90, 0))
    rig = Rig(device=DeviceSettings(tissue_from_device=turn))
    for z in np.concatenate([lowered(5e-3, 300), np.full(50, RADIUS - 5e-3)]):
        rig.tick(tuple(turn.to_device(np.array([0, 0, z]))))
    np.testing.assert_allclose(rig.forces[-1], [-K * 5e-3, 0, 0], atol=1e-9)
    np.testing.assert_allclose(rig.contact('device'), [0, 0, RADIUS - 5e-3], atol=1e-12)


def test_body_frame_rotates_the_wrench_into_the_tool():
    half = np.sqrt(0.5)
    for frame, expected in (('base', (0, 0, 1)), ('body', (0, 1, 0))):
        rig = Rig(device=DeviceSettings(force_frame=frame))
        for z in np.concatenate([lowered(5e-3, 300), np.full(50, RADIUS - 5e-3)]):
            rig.tick((0, 0, z), (half, 0, 0, half))
        np.testing.assert_allclose(rig.forces[-1], K * 5e-3 * np.array(expected), atol=1e-9)


def test_blade_turns_with_the_tool():
    half = np.sqrt(0.5)
    tool = ToolSettings(radius=RADIUS, blade_root=(0, 0, 0.02), blade_tip=(0, 0, -0.004))
    rig = Rig(tool=tool)
    rig.tick((0.0, 0.0, 0.05), (half, 0, 0, half))
    np.testing.assert_allclose(rig.contact('blade_root'), [0, -0.02, 0.05], atol=1e-12)
    np.testing.assert_allclose(rig.contact('blade_tip'), [0, 0.004, 0.05], atol=1e-12)


def test_energy_of_a_press_and_release_is_never_given_back_with_interest():
    rig = Rig(haptics=HapticsSettings(soft_start=0.0, max_damping=5.0))
    way = lowered(5e-3, 300)
    rig.run(np.concatenate([way, way[::-1], way, way[::-1]]))
    stored = 0.5 * K * 5e-3**2
    assert rig.path.energy > -0.02 * stored


def test_settings_that_cannot_hold_together_are_refused_with_the_number_that_would():
    slow = DeviceProfile(max_force=3.0, max_slew=20.0, max_stiffness=1000.0)
    with pytest.raises(SettingsError, match=r'at least 0\.15 s'):
        Rig(profile=slow)
    soft = DeviceProfile(max_force=3.0, max_slew=500.0, max_stiffness=150.0)
    with pytest.raises(SettingsError, match='200 N/m'):
        Rig(profile=soft)


@pytest.mark.parametrize('scale', [0.05, 1.0, 50.0])
@pytest.mark.parametrize('radius', [0.001, 0.05])
def test_warm_up_touches_wherever_the_device_stands(scale, radius):
    """What it has not called is loaded in the first contact, which took 50 ms."""
    frame = Transform(translation=(0.3, -1.0, 0.2), rotation_rpy_deg=(90, 0, 20), scale=scale)
    tool = ToolSettings(radius=radius, coupling_stiffness=1.0)
    device = DeviceSettings(tissue_from_device=frame)
    assert warm_up(tool, device, HapticsSettings(), PROFILE).contact == TOUCHING


def test_force_scale_may_change_while_pressing_and_never_faster_than_the_slew():
    rig = Rig()
    rig.run(lowered(5e-3, 300))
    before = rig.run(np.full(200, RADIUS - 5e-3))[-1, 2]
    rig.path.coupling.change(force_scale=2.0)
    after = rig.run(np.full(200, RADIUS - 5e-3))[:, 2]
    assert after[-1] == pytest.approx(2 * before, rel=0.05)
    assert np.diff(np.concatenate([[before], after])).max() <= PROFILE.max_slew * 1e-3 + 1e-12
    with pytest.raises(SettingsError, match='the device bears 1000 N/m'):
        rig.path.coupling.change(force_scale=6.0)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match='force_scale'):
            rig.path.coupling.change(force_scale=wrong)
    assert rig.path.haptics.force_scale == 2.0
