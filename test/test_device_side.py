"""Claims about how devices differ: profiles, units, mirror images, signs, streams, a button."""

import math

import numpy as np
import pytest
from flat_tissue import flat_surface
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.devices.convention import DeviceConvention
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    Transform,
    check_together,
)
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState, OperatingStateMachine
from cutting_trainer.node_common.rejections import RejectionStatistics
from cutting_trainer.node_common.share_folder import share_folder
from cutting_trainer.node_common.stream_monitor import MAX_QUEUE_DELAY_S, StreamMonitor

PROFILES = sorted((share_folder() / 'config' / 'devices').glob('*.yaml'))
NO_LIMITS = {'device', 'sources'}
UNITS = {'m': 1.0, 'dm': 0.1, 'cm': 0.01, 'mm': 0.001}
SECOND = 10**9

settings = st.builds(
    DeviceSettings,
    length_unit=st.sampled_from(list(UNITS)),
    mirrored_axis=st.sampled_from(['none', 'x', 'y', 'z']),
    force_sign=st.sampled_from([1, -1]),
)
vectors = st.tuples(*[st.floats(-1, 1)] * 3)
rotations = st.builds(
    lambda v: Rotation.from_rotvec(v), st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
)


@pytest.mark.parametrize('path', PROFILES, ids=lambda path: path.stem)
def test_a_shipped_profile_names_the_source_of_each_figure_and_fits_the_default_haptics(path):
    profile = DeviceProfile.load(path)
    assert profile.device and profile.workspace
    assert set(profile.sources) == profile.model_fields_set - NO_LIMITS
    assert all(len(source) > 10 for source in profile.sources.values())
    check_together(ToolSettings(), DeviceSettings(), HapticsSettings(), profile)


def test_there_is_a_profile_for_each_device_that_the_guide_names():
    names = {path.stem for path in PROFILES}
    assert {'emulated', 'touch', 'premium_1_5', 'omega', 'dvrk_mtm'} <= names


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('max_force: 1\nmax_slew: 9\n', 'max_stiffness is missing: [N/m]'),
        ('max_force: -1\nmax_slew: 9\nmax_stiffness: 9\n', 'max_force is -1'),
        ('max_forse: 1\nmax_slew: 9\nmax_stiffness: 9\n', 'max_force is missing'),
        ('max_force: 1\nmax_slew: 9\nmax_stiffness: 9\nmax_fource: 2\n', 'did you mean max_force?'),
        ('max_force: 1\nmax_slew: 9\nmax_stiffness: 9\nworkspace: [160, 120, 70]\n', 'workspace.0'),
        ('max_force: .nan\nmax_slew: 9\nmax_stiffness: 9\n', 'max_force is nan'),
        ('max_force: 1\nmax_slew: 9\nmax_stiffness: 9\nsources: {weight: x}\n', 'sources'),
        ('- 1\n', 'a mapping'),
        ('max_force: [\n', 'not valid YAML'),
    ],
)
def test_a_bad_profile_is_refused_with_file_key_and_what_would_be_right(tmp_path, text, said):
    path = tmp_path / 'arm.yaml'
    path.write_text(text)
    with pytest.raises(SettingsError) as refused:
        DeviceProfile.load(path)
    sentence = str(refused.value)
    assert sentence.startswith(f'{path}') and said in sentence and '\n' not in sentence


@given(settings, vectors, rotations, vectors, vectors)
def test_a_convention_maps_motion_force_and_power_alike(device, position, turn, velocity, force):
    convention = DeviceConvention(device)
    pose = (*position, *turn.as_quat())
    spoken = convention.to_device_pose(pose)
    assert_allclose(convention.pose(StampedMessage(1, '', spoken)).values, pose, atol=1e-12)
    mirror = np.array([-1.0 if axis == device.mirrored_axis else 1.0 for axis in 'xyz'])
    unit = UNITS[device.length_unit]
    assert_allclose(np.multiply(unit, spoken[:3]), mirror * position, atol=1e-12)
    # A vector that is turned and then mirrored is one that is mirrored and then turned as spoken.
    theirs = Rotation.from_quat(spoken[3:])
    assert_allclose(theirs.apply(mirror * velocity), mirror * turn.apply(velocity), atol=1e-9)
    linear = convention.to_device_twist((*velocity, 0.0, 0.0, 0.0))[:3]
    wrench = convention.force((*force, *velocity))
    assert_allclose(
        device.force_sign * unit * np.dot(linear, wrench[:3]), np.dot(velocity, force), atol=1e-9
    )
    assert_allclose(convention.force(wrench), (*force, *velocity))


@given(settings, rotations, vectors)
def test_angular_velocity_is_that_of_the_spoken_orientation(device, turn, omega):
    convention = DeviceConvention(device)
    step = 1e-4
    later = Rotation.from_rotvec(np.multiply(step, omega)) * turn
    before, after = (
        Rotation.from_quat(convention.to_device_pose((0.0, 0.0, 0.0, *r.as_quat()))[3:])
        for r in (turn, later)
    )
    spoken = convention.to_device_twist((0.0, 0.0, 0.0, *omega))[3:]
    assert_allclose((after * before.inv()).as_rotvec() / step, spoken, atol=1e-6)


@pytest.mark.parametrize('frame', ['base', 'body'])
@pytest.mark.parametrize('axis', ['none', 'x', 'z'])
def test_what_a_device_speaks_changes_nothing_in_what_the_hand_feels(frame, axis):
    transform = Transform(translation=(0, 0, 0.01), rotation_rpy_deg=(20, -30, 70))
    turn = Rotation.from_euler('xyz', [10, 40, -25], degrees=True)
    felt = []
    for words in ({}, {'length_unit': 'mm', 'mirrored_axis': axis, 'force_sign': -1}):
        device = DeviceSettings(tissue_from_device=transform, force_frame=frame, **words)
        convention = DeviceConvention(device)
        path = ForcePath(
            ToolSettings(), device, HapticsSettings(soft_start=0), DeviceSettings().load_profile()
        )
        for tick in range(1, 60):
            depth = transform.to_device(np.array([0.0, 0.0, 0.006 - 1e-4 * tick]))
            spoken = convention.to_device_pose((*depth.tolist(), *turn.as_quat().tolist()))
            sample = (tick, tick, 1, tick, 0, tick, 0, *(0.0,) * 18, 0, *(0.0,) * 6)
            wrench = path.tick(
                tick * 1_000_000,
                state=CrtkState.ENABLED,
                pose=convention.pose(StampedMessage(tick * 1_000_000, '', spoken)),
                sample=StampedMessage(tick, '', sample),
                surface=flat_surface(revision=tick),
            ).wrench
        force = np.array(convention.force(convention.force(wrench))[:3])
        sent = np.array(convention.force(wrench)[:3])
        mirror = np.array([-1.0 if words and name == axis else 1.0 for name in 'xyz'])
        assert_allclose(sent, (-1 if words else 1) * mirror * force, atol=1e-15)
        felt.append(force)
    assert np.linalg.norm(felt[0]) > 0.1
    assert_allclose(felt[1], felt[0], atol=1e-9)
    base = felt[0] if frame == 'base' else turn.apply(felt[0])
    assert_allclose(np.cross(transform.rotation() @ base, [0, 0, 1]), 0, atol=1e-9)


def test_a_restarted_publisher_is_one_and_two_publishers_are_two():
    watch = StreamMonitor('cp')
    for number in (*range(1, 100), *range(1, 50)):
        assert watch.see(number, 0, number * 1_000_000) == ''
    said = [
        watch.see(n, 0, SECOND + n)
        for pair in zip(range(50, 60), range(1, 11), strict=True)
        for n in pair
    ]
    assert any('more than one publisher' in sentence for sentence in said)
    assert watch.cause(SECOND + 100)
    assert watch.cause(3 * SECOND) == ''


def test_numbers_that_are_not_given_are_not_looked_at():
    watch = StreamMonitor('cp')
    assert not any(watch.see(0, 0, tick) for tick in range(100))


@pytest.mark.parametrize('jump', [3600.0, -3600.0, 0.6, -0.6])
def test_a_clock_that_jumps_is_told_once_and_its_new_time_is_taken(jump):
    watch = StreamMonitor('cp')
    stamps = [100 * SECOND + k * 1_000_000 for k in range(10)]
    stamps += [round(stamp + jump * SECOND) for stamp in stamps]
    said = [watch.see(k + 1, stamp, k % 10 * 1_000_000) for k, stamp in enumerate(stamps)]
    assert [k for k, sentence in enumerate(said) if sentence] == [10]
    assert f'{jump:+.3g} s' in said[10]


def test_a_message_that_is_late_or_invalid_is_no_jump_of_the_clock():
    watch = StreamMonitor('cp')
    assert not watch.see(1, SECOND, SECOND)
    assert not watch.see(2, SECOND + 1, round(1.4 * SECOND))
    assert not watch.see(3, 0, 2 * SECOND)
    assert not watch.see(4, 3 * SECOND, 3 * SECOND)


def test_messages_that_wait_in_a_network_are_late_and_its_clock_is_believed():
    watch = StreamMonitor('force', queues=True)
    delays = [0.02] * 30 + [0.8 - 0.03 * k for k in range(20)] + [0.02] * 30
    late = []
    for number, delay in enumerate(delays, 1):
        sent = number * SECOND // 30
        assert not watch.see(number, sent, round(sent + delay * SECOND))
        late.append(watch.late)
    assert [delay > 0.52 for delay in delays] == late


def test_messages_are_older_by_what_they_waited_more_than_is_usual():
    watch = StreamMonitor('force', queues=True)
    frame = SECOND // 30
    delays = [0.02] * 30 + [0.4 - 0.03 * k for k in range(12)] + [0.02] * 30
    waited = []
    for number, delay in enumerate(delays):
        watch.see(number + 1, number * frame, round(number * frame + delay * SECOND))
        waited.append(watch.delay / SECOND)
    assert waited == pytest.approx([delay - 0.02 for delay in delays], abs=0.005)
    longer = [0.12] * 1200
    for number, delay in enumerate(longer, len(delays)):
        watch.see(number + 1, number * frame, round(number * frame + delay * SECOND))
    assert watch.delay / SECOND < 1e-3  # a way that has become longer is usual in the end


def test_a_clock_that_was_set_back_behind_a_network_is_told_in_the_end():
    watch = StreamMonitor('force', queues=True)
    said = []
    for number in range(1, 200):
        now = number * SECOND // 30
        said.append(watch.see(number, now + 100 * SECOND - (number > 30) * 3600 * SECOND, now))
    (told,) = (k for k, sentence in enumerate(said) if sentence)
    assert (told - 30) / 30 == pytest.approx(MAX_QUEUE_DELAY_S, abs=0.1)
    assert not watch.late


def test_a_frame_that_changes_is_told_and_its_new_name_is_taken():
    watch = StreamMonitor('cp')
    frames = ['base', 'base', 'camera', 'camera']
    said = [watch.see(n, 0, n, frame) for n, frame in enumerate(frames, 1)]
    assert [n for n, sentence in enumerate(said) if sentence] == [2]
    assert "from 'base' to 'camera'" in said[2]


class FakeNode:
    max_message = 1000

    def __init__(self):
        self.rejections = RejectionStatistics()

    def create_subscription(self, _kind, topic, callback, _qos, *, raw):
        self.topic, self.press = topic, callback
        assert raw


@pytest.fixture
def held():
    crtk = pytest.importorskip('cutting_trainer.node_common.crtk')
    joy = pytest.importorskip('sensor_msgs.msg').Joy
    node, machine = FakeNode(), OperatingStateMachine()
    button = crtk.HoldButton(node, 'arm', machine)
    encode = pytest.importorskip('rclpy.serialization').serialize_message
    return button, machine, lambda pressed: node.press(encode(joy(buttons=[int(pressed)])))


def test_there_is_force_only_while_the_button_is_held(held):
    button, machine, press = held
    machine.command('enable')
    button.enforce()
    assert machine.state is CrtkState.PAUSED
    press(True)
    assert machine.state is CrtkState.ENABLED
    press(False)
    assert machine.state is CrtkState.PAUSED


def test_the_button_resumes_neither_a_pause_by_command_nor_a_fault(held):
    button, machine, press = held
    press(True)
    machine.command('enable')
    machine.command('pause')
    press(False)
    press(True)
    assert machine.state is CrtkState.PAUSED
    machine.command('disable')
    machine.fault('broken')
    press(False)
    press(True)
    button.enforce()
    assert machine.state is CrtkState.FAULT
