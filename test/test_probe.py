"""Claims about what the probe tells from samples, without any arm."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.devices.probe_force import check_push
from cutting_trainer.haptic_bridge.devices.probe_stream import (
    PUSH_FORCE_N,
    REQUESTED_MOVE_M,
    Poses,
    check_moves,
    check_stream,
    find_move,
)
from cutting_trainer.haptic_bridge.scene_schema import DeviceProfile

PROFILE = DeviceProfile(max_force=1, max_slew=100, max_stiffness=100, workspace=(0.2, 0.2, 0.2))
START = 1.7e9
FORCES = PUSH_FORCE_N * np.vstack([np.eye(3), -np.eye(3)])


def stream(rate: float = 1000.0, age: float = 5e-4, **changes: object) -> Poses:
    stamps = START + np.arange(2000) / rate
    values = np.tile([0.01, 0.02, 0.03, 0, 0, 0, 1.0], (len(stamps), 1))
    poses = {'arrivals': stamps + age, 'stamps': stamps, 'values': values} | changes
    return Poses(**poses)


def verdicts(poses: Poses) -> dict[str, str]:
    return {check.name: check.verdict for check in check_stream(poses, PROFILE, 'cp')}


def test_a_good_stream_is_good_in_everything():
    assert set(verdicts(stream()).values()) == {'ok'}


def broken() -> dict[str, tuple[Poses, str]]:
    good = stream()
    gap = good.stamps + np.where(np.arange(2000) > 1000, 0.025, 0.0)
    twice = good.stamps.copy()
    twice[7] = twice[6]
    nan = good.values.copy()
    nan[9, 2] = np.nan
    return {
        'slow': (stream(rate=250.0), 'rate'),
        'a gap of 25 ms': (stream(stamps=gap, arrivals=gap + 5e-4), 'jitter'),
        'another clock': (stream(age=3.0), 'age'),
        'a clock ahead': (stream(age=-3.0), 'age'),
        'invalid': (stream(stamps=np.where(np.arange(2000) < 5, 0.0, good.stamps)), 'stamps'),
        'repeated': (stream(stamps=twice), 'stamps'),
        'nan': (stream(values=nan), 'values'),
        'no quaternion': (stream(values=good.values * 1.5), 'values'),
        'millimetres': (stream(values=good.values * ([1e3] * 3 + [1] * 4)), 'range'),
    }


@pytest.mark.parametrize('name', broken())
def test_each_fault_of_a_stream_is_found_and_is_the_only_one(name):
    poses, check = broken()[name]
    found = verdicts(poses)
    assert found.pop(check) == 'wrong'
    assert 'wrong' not in found.values()


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 10.0, 100.0, 1000.0]), st.booleans())
def test_unit_and_handedness_are_found_however_the_device_stands(seed, unit, mirrored):
    random = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    hand = np.diag([1.0, 1.0, -1.0 if mirrored else 1.0])
    lengths = REQUESTED_MOVE_M * random.uniform(0.5, 1.8, 3)
    slanted = np.eye(3) + random.uniform(-0.15, 0.15, (3, 3))
    moves = [unit * hand @ turn @ (lengths[k] * slanted[k]) for k in range(3)]
    by_name = {check.name: check for check in check_moves(moves, 'cp')}
    assert by_name['unit'].verdict == ('ok' if unit == 1 else 'wrong')
    assert by_name['handedness'].verdict == ('wrong' if mirrored else 'ok')


def test_moves_that_are_missing_or_in_one_plane_leave_the_handedness_unknown():
    right, away = np.array([0.05, 0, 0]), np.array([0, 0.05, 0])
    for moves in ([right, away], [right, away, right + away]):
        assert check_moves(moves, 'cp')[1].verdict == 'unknown'


@pytest.mark.parametrize('unit', [1.0, 1000.0])
def test_a_move_is_found_once_it_has_come_to_rest(unit):
    times = np.arange(0, 3, 1e-3)
    ramp = np.clip(times - 0.5, 0, 1)[:, None] * [0.05, 0, 0]
    positions = unit * ([0.3, -0.2, 0.1] + ramp + 2e-4 * np.sin(60 * times)[:, None])
    noise = unit * 4e-4
    ends = [
        n for n in range(100, 3000, 50) if find_move(times[:n], positions[:n], noise) is not None
    ]
    assert 1.95 < times[ends[0]] < 2.15
    np.testing.assert_allclose(
        find_move(times, positions, noise), [0.05 * unit, 0, 0], atol=unit * 1e-3
    )


def sentence(response: np.ndarray) -> tuple[str, str]:
    (check,) = check_push(FORCES, FORCES @ response.T, 'cf')
    return check.verdict, check.sentence


def test_sign_and_axes_of_the_force_are_told_from_how_the_hand_gives_way():
    soft = np.diag([2.0, 1.0, 3.0]) * 1e-3
    assert sentence(soft)[0] == 'ok'
    assert 'force_sign: -1' in sentence(-soft)[1]
    assert 'only along y' in sentence(soft * [1, -1, 1])[1]
    swapped = soft[:, [0, 2, 1]]
    assert 'moved the tip along' in sentence(swapped)[1]
    assert sentence(soft * 1e-2)[0] == 'unknown'
