"""What the probe's pushes and turns find on an emulated arm, by a clock that the test turns."""

import math
import re
from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.devices import probe_node
from cutting_trainer.haptic_bridge.devices.probe_force import check_gain, check_push, check_release
from cutting_trainer.haptic_bridge.devices.probe_node import DeviceProbe, Pushes
from cutting_trainer.haptic_bridge.devices.probe_pose import (
    RULER_LENGTH_M,
    check_frame,
    check_rotation,
    check_ruler,
    find_rotation,
)
from cutting_trainer.haptic_bridge.devices.probe_stream import ProbeCheck
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.faults import DriverFaults
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import Transform
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec, WrenchStampedCodec

pytestmark = pytest.mark.long

TICK = 2_000_000
TREMOR = 1e-4
"""[m] root mean square of a hand that is held still."""


def seeds(quick: int, all_of_them: int) -> list[Any]:
    """The first ones, and the others for whoever has more time."""
    slow = [pytest.param(n, marks=pytest.mark.thorough) for n in range(quick, all_of_them)]
    return [*range(quick), *slow]


class Bench(DeviceProbe):
    """The probe with an emulated arm and a clock in place of ROS."""

    def __init__(self, faults: str, seed: int, *, measures: bool = True) -> None:
        self.pose_topic, self.force_topic, self.felt_topic = 'cp', 'cf', 'felt'
        self._arm, self._poses, self._wrenches = 'arm', deque(), deque()
        self._codec, self._wrench_codec = PoseStampedCodec('base'), WrenchStampedCodec('base')
        self.frames = set()
        self._clear()
        random = np.random.default_rng(seed)
        hand = {'stiffness': float(random.uniform(80, 500)), 'tremor': TREMOR}
        start = {'position': [0, 0, 0]}
        script = {'start': start, 'phases': [{'kind': 'rest'}]}
        settings = ArmSettings.model_validate({'rate': 500.0, 'hand': hand, 'script': script})
        played = compile_script(settings.script, Transform(), 0.0)
        self.arm = EmulatedArm(settings, EmulatedHand(settings.hand, played, seed))
        self.faults, self.measures = DriverFaults.read(faults), measures
        self.now = 1_700_000_000 * 10**9
        self.began, self.held, self.frame = self.now, None, ''

    def count_publishers(self, _topic: str) -> int:
        return 0

    def resolve_topic_name(self, topic: str, **_: Any) -> str:
        return topic

    def create_publisher(self, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(publish=self.command)

    def command(self, data: bytes) -> None:
        stamp, _, values = self._wrench_codec.decode(data)
        self.held = self.faults.force(values[:3])
        self.arm.command(stamp, self.held, self.now)

    def sleep(self, seconds: float) -> None:
        for _ in range(max(round(seconds * 1e9 / TICK), 1)):
            self.now += TICK
            if self.faults.held and self.held:
                self.arm.command(self.now, self.held, self.now)
            self.arm.advance(self.now, enabled=True)
            pose = (*self.arm.position.tolist(), *self.arm.orientation.tolist())
            frame = self.faults.frame('base', (self.now - self.began) * 1e-9)
            if frame != self.frame:
                self.frame, self.codec = frame, PoseStampedCodec(frame)
            self._poses.append(self.codec.encode(self.now, self.faults.pose(pose)))
            if self.measures:
                felt = (*self.arm.force.tolist(), 0.0, 0.0, 0.0)
                self._wrenches.append(self._wrench_codec.encode(self.now, felt))


def pushed(monkeypatch: pytest.MonkeyPatch, faults: str, seed: int, **how: Any) -> Any:
    bench = Bench(faults, seed, **how)
    clock = SimpleNamespace(
        time=lambda: bench.now * 1e-9,
        monotonic=lambda: bench.now * 1e-9,
        time_ns=lambda: bench.now,
        sleep=bench.sleep,
    )
    monkeypatch.setattr(probe_node, 'time', clock)
    monkeypatch.setattr(probe_node, 'take_raw', lambda q: q.popleft() if q else None)
    pushes = bench.push(1.0)
    return bench, pushes


def judged(bench: Bench, pushes: Pushes) -> dict[str, ProbeCheck]:
    last = pushes.times, pushes.along, pushes.deflection, pushes.still_felt
    checks = [
        *check_push(pushes.forces, pushes.yields, 'cf', pushes.tool),
        *check_gain(pushes.forces, pushes.felt, 'felt'),
        *check_release(*last, 'cf'),
        check_frame(bench.frames, 'cp'),
    ]
    return {check.name: check for check in checks}


def wrong(checks: dict[str, ProbeCheck]) -> set[str]:
    return {name for name, check in checks.items() if check.verdict != 'ok'}


@pytest.mark.parametrize('seed', seeds(4, 20))
def test_a_good_driver_raises_no_alarm_whatever_the_hand(monkeypatch, seed):
    checks = judged(*pushed(monkeypatch, '', seed))
    assert not wrong(checks), checks
    assert checks.keys() == {'force', 'gain', 'release', 'frame'}


@pytest.mark.parametrize('seed', seeds(1, 3))
@pytest.mark.parametrize(
    ('faults', 'name', 'words'),
    [
        ('turn=16', 'force', 'rotated by 1[4-8] degrees'),
        ('turn=-30', 'force', 'rotated by (29|30|31) degrees'),
        ('turn=60', 'force', 'rotated by (59|60|61) degrees'),
        ('turn=120', 'force', 'moved the tip along'),
        ('gain=5', 'gain', 'scales the force by 5'),
        ('gain=0.2', 'gain', 'scales the force by 0.2'),
        ('frame_after=2', 'frame', "'base' and 'base_2'"),
        ('held=1', 'release', 'the last force stayed on'),
    ],
)
def test_each_fault_of_a_driver_is_found_and_is_the_only_one(
    monkeypatch, faults, name, words, seed
):
    checks = judged(*pushed(monkeypatch, faults, seed))
    assert {n for n, check in checks.items() if check.verdict == 'wrong'} == {name}
    assert re.search(words, checks[name].sentence), checks[name].sentence


def test_a_driver_that_does_not_measure_is_still_found_to_hold_and_its_gain_is_unknown(monkeypatch):
    checks = judged(*pushed(monkeypatch, 'held=1 gain=5', 1, measures=False))
    assert checks['release'].verdict == 'wrong' and 'by the tip' in checks['release'].measured
    assert checks['gain'].verdict == 'unknown' and 'kitchen scale' in checks['gain'].sentence


def answers(response: np.ndarray, tool: np.ndarray | None = None, noise: float = 0.0) -> ProbeCheck:
    forces = 0.3 * np.vstack([np.eye(3), -np.eye(3)])
    random = np.random.default_rng(0)
    yields = forces @ response.T + noise * random.normal(size=(6, 3))
    return check_push(forces, yields, 'cf', tool)[0]


@pytest.mark.parametrize('seed', range(10))
def test_a_hand_that_is_soft_one_way_and_stiff_another_hides_and_makes_no_turn(seed):
    axes = Rotation.random(random_state=seed).as_matrix()
    soft = axes @ np.diag([4e-3, 2e-3, 0.8e-3]) @ axes.T
    assert answers(soft).verdict == 'ok'
    turn = Rotation.from_rotvec(math.radians(16) * axes[0]).as_matrix()
    assert answers(soft @ turn).verdict == 'wrong'
    less = Rotation.from_rotvec(math.radians(6) * axes[0]).as_matrix()
    assert answers(soft @ less).verdict == 'ok'


def test_a_force_that_turns_with_the_tool_is_told_from_one_that_is_turned():
    tool = Rotation.from_euler('xyz', (10, 40, 70), degrees=True).as_matrix()
    assert 'force_frame: body' in answers(2e-3 * tool, tool).sentence
    assert 'force_frame: body' not in answers(2e-3 * tool, np.eye(3)).sentence


def test_a_hand_that_moves_by_itself_is_unknown_and_no_verdict():
    check = answers(2e-3 * np.eye(3), noise=3e-4)
    assert check.verdict == 'unknown' and 'hand moved by itself' in check.sentence


@pytest.mark.parametrize(
    ('scale', 'verdict'),
    [(0.35, 'wrong'), (2.0, 'wrong'), (1.1, 'ok'), (0.9, 'ok'), (0.7, 'wrong'), (1.3, 'wrong')],
)
@pytest.mark.parametrize('metres', [1.0, 0.001])
def test_a_scale_of_the_positions_is_found_by_the_ruler(scale, verdict, metres):
    move = scale * RULER_LENGTH_M / metres * np.array([0.6, 0.0, 0.8])
    (check,) = check_ruler(move, metres, 'cp')
    assert check.verdict == verdict and 'by the ruler' in check.measured
    assert check_ruler(None, metres, 'cp')[0].verdict == 'unknown'


@pytest.mark.parametrize('seed', range(20))
@pytest.mark.parametrize('order', ['x y z w', 'w x y z', 'x y z w of the inverse'])
def test_the_order_of_the_quaternion_is_found_by_a_turn_from_identity_too(order, seed):
    random = np.random.default_rng(seed)
    frame = Rotation.random(random_state=seed)
    start = Rotation.identity() if seed < 3 else Rotation.random(random_state=seed + 100)
    up = frame.apply([0.0, 0.0, 0.05])
    slip = Rotation.from_rotvec(np.radians(random.uniform(-12, 12, 3)))
    turn = slip * Rotation.from_rotvec(frame.apply([0, 0, math.radians(random.uniform(65, 115))]))
    sent = []
    for rotation in (start, turn * start):
        x, y, z, w = (rotation.inv() if 'inverse' in order else rotation).as_quat()
        sent.append(np.array([w, x, y, z] if order[0] == 'w' else [x, y, z, w]))
    check = check_rotation(*sent, up, 'cp')
    assert check.verdict == ('ok' if order == 'x y z w' else 'wrong'), check
    assert order == 'x y z w' or f'is {order},' in check.sentence


def test_a_turn_that_was_not_made_or_the_wrong_one_is_unknown():
    start, up = np.array([0, 0, 0, 1.0]), np.array([0, 0, 0.05])
    assert check_rotation(start, None, up, 'cp').verdict == 'unknown'
    rolled = Rotation.from_euler('xyz', (30, 30, 0), degrees=True).as_quat()
    assert check_rotation(start, rolled, up, 'cp').verdict == 'unknown'


def test_a_turn_is_found_once_it_has_come_to_rest():
    times = np.arange(0, 3, 1e-3)
    turns = Rotation.from_rotvec(np.clip(times - 0.5, 0, 1)[:, None] * [0, 0, math.pi / 2])
    sent = turns.as_quat()
    ends = [n for n in range(100, 3000, 50) if find_rotation(times[:n], sent[:n]) is not None]
    assert 1.95 < times[ends[0]] < 2.15


def test_faults_that_do_not_exist_are_one_sentence():
    for text in ('speed=3', 'gain=much', 'gain'):
        with pytest.raises(ValueError, match='is no fault of a driver: use turn=NUMBER'):
            DriverFaults.read(text)
