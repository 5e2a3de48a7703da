"""Claims about the guided set-up: touches of known points say where a device is, or why not."""

import json
import os
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from scipy.spatial.transform import Rotation

from bench.figures.arms_placement import PlacedDevice, set_up
from cutting_trainer.cli import main as cli
from cutting_trainer.haptic_bridge.devices import placement
from cutting_trainer.haptic_bridge.devices.placement import (
    PlacementError,
    check_lift,
    find_touch,
    place,
    why_no_touch,
)
from cutting_trainer.haptic_bridge.devices.probe_node import DeviceProbe
from cutting_trainer.haptic_bridge.devices.probe_stream import Poses, ProbeCheck
from cutting_trainer.haptic_bridge.scene_schema import SettingsError, Transform
from cutting_trainer.node_common.orientation import from_rpy
from cutting_trainer.node_common.share_folder import SCENES, scene_names
from cutting_trainer.session import probe_command as command
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.place_device import SHIPPED, Guide, write_placement
from cutting_trainer.session.probe_command import Emulation, ProbeOptions, run_probe
from cutting_trainer.session.scene_loader import load_scene

ROOT = Path(__file__).parents[1]
SHEET = np.array([[-0.03, -0.02, 0.0], [0.03, -0.02, 0.0], [0.03, 0.02, 0.0], [-0.03, 0.02, 0.0]])


def own_scene(folder: Path) -> Path:
    """A copy of a scene that comes with the trainer."""
    text = (SCENES / 'block.yaml').read_text()
    mesh = f'mesh: {ROOT / "config" / "meshes" / "block_yi2007.msh"}'
    path = folder / 'mine.yaml'
    path.write_text(text.replace('mesh: ../meshes/block_yi2007.msh', mesh))
    return path


@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 4, 6]))
def test_exact_touches_give_the_exact_placement(seed, count):
    random = np.random.default_rng(seed)
    turn, scale = Rotation.random(random_state=seed).as_matrix(), random.uniform(0.2, 5.0)
    translation = random.uniform(-0.5, 0.5, 3)
    points = np.vstack([SHEET[:3], random.uniform(-0.05, 0.05, (3, 3))])[:count]
    found = place((points - translation) @ turn / scale, points)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9)
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(from_rpy(found.rpy_deg), turn, atol=1e-9)
    assert found.residuals.max() < 1e-9


def test_roll_pitch_and_yaw_are_found_where_the_pitch_is_a_right_angle():
    for pitch in (90, -90):
        turn = from_rpy((20, pitch, 50))
        found = place(SHEET @ turn, SHEET)
        np.testing.assert_allclose(from_rpy(found.rpy_deg), turn, atol=1e-6)


BUMP = np.array([[0.01, 0.01, 0.02]])
REFUSED = {
    'too few': (SHEET[:2], SHEET[:2], 'it takes 3'),
    'points in line': (SHEET[:3], SHEET[0] + np.outer([0, 1, 2], [0.01, 0, 0]), 'points are in'),
    'touches in line': (SHEET[0] + np.outer([0, 1, 2], [0.01, 0, 0]), SHEET[:3], 'touches are in'),
    'the same place': (SHEET[[0, 0, 0]], SHEET[:3], 'touches are in line, or at one place'),
    'two exchanged': (SHEET[[1, 0, 2]], SHEET[:3], 'off where the other touches put it'),
    'one off': (SHEET + np.diag([1, 0, 0, 0])[:, :1] * [0.003, 0, 0], SHEET, 'off where'),
    'mirrored': (
        np.vstack([SHEET, BUMP]) * [1, 1, -1],
        np.vstack([SHEET, BUMP]),
        'left-handed',
    ),
    'millimetres': (1e6 * SHEET, SHEET, 'length_unit'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_touches_that_say_nothing_are_refused_with_the_reason(name):
    touched, points, reason = REFUSED[name]
    with pytest.raises(PlacementError, match=reason):
        place(touched, points)


def test_the_lift_tells_a_mirrored_frame_from_points_in_one_plane():
    found = place(SHEET * [1, 1, -1], SHEET)
    check_lift(found, np.array([0, 0, 0.05]))
    for lift, reason in (
        ((0, 0, -0.05), 'would go down'),
        ((0.05, 0, 0.01), 'straight up'),
        ((0, 0, 0.004), 'lifted by 4 mm'),
    ):
        with pytest.raises(PlacementError, match=reason):
            check_lift(found, np.array(lift))


def test_a_tip_that_is_not_still_is_not_taken_and_told():
    times = np.arange(0, 4, 1e-3)
    way = np.clip(times - 0.5, 0, 1)[:, None] * [0.05, 0, 0]
    shaky = way + 0.003 * np.sin(40 * times)[:, None]
    ends = [n for n in range(100, 4000, 50) if find_touch(times[:n], way[:n], 1.0) is not None]
    assert 1.5 + placement.HOLD_S - 0.2 < times[ends[0]] < 1.5 + placement.HOLD_S + 0.1
    assert find_touch(times, shaky, 1.0) is None
    assert 'not held still' in str(why_no_touch(shaky, 1.0, 'the corner'))
    assert 'was not moved' in str(why_no_touch(way[:100], 1.0, 'the corner'))


def test_devices_turned_at_random_are_found():
    for seed in range(5):
        device = PlacedDevice(seed)
        found = set_up(device)
        assert np.linalg.norm(found.translation - device.translation) < 1e-3
        assert found.scale == pytest.approx(device.scale, rel=0.01)


def test_the_scene_keeps_all_but_where_the_device_is(tmp_path):
    path = own_scene(tmp_path)
    before = path.read_text().splitlines()
    turn = from_rpy((10, 20, 30))
    write_placement(load_scene(str(path)), place(SHEET @ turn / 0.8 + 0.1, SHEET))
    after = path.read_text().splitlines()
    assert len(after) == len(before)
    changed = [new.strip() for old, new in zip(before, after, strict=True) if old != new]
    assert [line.split(':')[0] for line in changed] == ['translation', 'rotation_rpy_deg', 'scale']
    device = load_scene(str(path)).device
    np.testing.assert_allclose(device.tissue_from_device.rotation(), turn, atol=1e-6)
    assert device.tissue_from_device.scale == pytest.approx(0.8)
    with pytest.raises(SettingsError, match='the device bears'):
        write_placement(load_scene(str(path)), place(SHEET / 8.0, SHEET))
    assert path.read_text().splitlines() == after


def test_the_scene_stays_as_private_as_it_was(tmp_path):
    path = own_scene(tmp_path)
    path.chmod(0o600)
    write_placement(load_scene(str(path)), place(SHEET, SHEET))
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_scene_without_the_section_gets_it(tmp_path):
    path = own_scene(tmp_path)
    lines = path.read_text().splitlines()
    first = lines.index('device:')
    path.write_text('\n'.join([*lines[:first], *lines[first + 6 :]]) + '\n')
    assert load_scene(str(path)).device.tissue_from_device == Transform()
    write_placement(load_scene(str(path)), place(SHEET - [0, 0, 0.1], SHEET))
    assert load_scene(str(path)).device.tissue_from_device.translation == (0.0, 0.0, 0.1)


def test_a_scene_of_the_trainer_and_points_in_line_are_bad_input(capsys, tmp_path):
    scene = str(own_scene(tmp_path))
    in_line = ['--point', '0,0,0', '--point', '0.01,0,0', '--point', '0.02,0,0']
    for words, reason in (
        (['--place', 'block'], 'copy it'),
        (['--place', scene, *in_line], 'in line'),
        (['--place', scene, '--point', '0,0'], 'x,y,z in metres'),
    ):
        with pytest.raises(SystemExit) as stopped:
            cli.main(['probe-device', '--domain', 'free', *words])
        assert stopped.value.code == Status.BAD_INPUT
        assert reason in ' '.join(capsys.readouterr().err.split())


def test_the_scenes_of_the_trainer_are_known_and_a_copy_beside_them_is_none():
    assert set(SHIPPED) <= set(scene_names())


def test_a_late_stream_does_not_stop_the_writing_and_a_wrong_unit_does(tmp_path):
    guide = Guide.of(str(own_scene(tmp_path)))
    guide.found = place(SHEET + np.array([0.01, 0.0, 0.0]), SHEET)
    late = [ProbeCheck(name, 'wrong', '') for name in ('rate', 'jitter', 'age')]
    refused = guide.write([*late, ProbeCheck('range', 'wrong', '')])
    assert refused.sentence == 'nothing was written because of range'
    assert guide.write(late).verdict == 'ok'
    found = load_scene(str(guide.scene.path)).device.tissue_from_device
    np.testing.assert_allclose(found.translation, (-0.01, 0, 0), atol=1e-6)


def test_no_touch_is_asked_for_where_nothing_could_be_written(tmp_path, capsys):
    times = np.arange(0, 3, 1e-3)
    poses = Poses(times, times, np.full((len(times), 7), np.nan))
    node = mock.Mock(pose_topic='/bad/measured_cp', frames={'base'})
    node.find.return_value = ProbeCheck('publisher', 'ok', 'one, reliable')
    node.listen.return_value = poses
    guide = Guide.of(str(own_scene(tmp_path)))
    checks = command._checks(node, ProbeOptions(), guide.profile, Console(stderr=True), guide)
    node.await_touch.assert_not_called()
    assert 'Touch' not in capsys.readouterr().err
    assert 'values' in guide.write(checks).sentence


def test_a_driver_that_dies_between_two_touches_is_named():
    context = rclpy.Context()
    with reserved_domain('free') as domain:
        rclpy.init(context=context, domain_id=domain)
    probe = DeviceProbe('/gone', context)
    try:
        with pytest.raises(PlacementError, match='/gone/measured_cp fell silent before the corner'):
            probe.await_touch(1.0, 1.5, 'the corner')
    finally:
        probe.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.live
def test_an_emulated_device_is_placed_over_dds(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, 'REST_TIME_S', 1.0)
    path = own_scene(tmp_path)
    frame = Transform(translation=(0.05, -0.1, 0.08), rotation_rpy_deg=(30, -50, 140), scale=1.5)
    emulation = Emulation(device={'tissue_from_device': frame.model_dump()})
    options = ProbeOptions(emulation=emulation, domain='free', as_json=True, place=str(path))
    with mock.patch.dict(os.environ):
        run_probe(options)  # a busy machine may fail checks of time: those stop nothing
    checks = {check['name']: check for check in json.loads(capsys.readouterr().out)}
    assert checks['orientation']['verdict'] == 'ok', checks
    late = [n for n, check in checks.items() if check['verdict'] == 'wrong']
    assert set(late) <= {'rate', 'jitter', 'age'}, checks
    found = load_scene(str(path)).device.tissue_from_device
    np.testing.assert_allclose(found.rotation(), frame.rotation(), atol=0.01)
    np.testing.assert_allclose(found.translation, frame.translation, atol=1e-3)
    assert found.scale == pytest.approx(1.5, rel=0.01)


def test_the_guide_asks_for_the_corners_of_the_tissue(tmp_path):
    guide = Guide.of(str(own_scene(tmp_path)))
    assert guide.points.tolist() == pytest.approx(
        np.array([[-0.02, -0.02, 0], [0.02, -0.02, 0], [0.02, 0.02, 0], [-0.02, 0.02, 0]])
    )
    assert guide.names[2] == 'the back right corner'
