"""The command `probe-device` on the emulated arm, as it should be and wrong in every way."""

import json
import os
from collections.abc import Iterator
from unittest import mock

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy

from cutting_trainer.cli import main as cli
from cutting_trainer.haptic_bridge.devices import probe_node
from cutting_trainer.node_common.qos import STREAM
from cutting_trainer.node_common.ros import polled, take
from cutting_trainer.session import probe_command as command
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.probe_command import Emulation, ProbeOptions, run_probe

pytestmark = pytest.mark.live


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(command, 'REST_TIME_S', 1.0)
    with mock.patch.dict(os.environ):
        yield


def found(capsys: pytest.CaptureFixture[str], **options: object) -> tuple[Status, dict[str, dict]]:
    status = run_probe(ProbeOptions(domain='free', as_json=True, **options))
    return status, {check['name']: check for check in json.loads(capsys.readouterr().out)}


@pytest.mark.thorough
def test_a_good_arm_passes_every_check(capsys):
    for _ in range(3):  # again where the machine was held up
        status, checks = found(capsys, emulation=Emulation(), push=True)
        wrong = {name for name, check in checks.items() if check['verdict'] != 'ok'}
        if not wrong:
            break
    assert (status, wrong) == (Status.OK, set())
    assert {'publisher', 'rate', 'jitter', 'age', 'unit', 'handedness', 'force'} < set(checks)
    assert {'scale', 'orientation', 'gain', 'release', 'frame'} < set(checks)


@pytest.mark.thorough
def test_a_driver_that_gets_everything_wrong_is_told_so(capsys):
    faults = 'turn=40 gain=2 scale=2 w_first=1 frame_after=4 held=1'
    status, checks = found(capsys, emulation=Emulation(faults=faults), push=True)
    assert status == Status.FAILED
    for name in ('force', 'gain', 'scale', 'orientation', 'frame', 'release'):
        assert checks[name]['verdict'] == 'wrong', checks[name]
    assert 'w x y z' in checks['orientation']['sentence']


@pytest.mark.thorough
def test_an_arm_at_rest_is_enabled_to_be_pushed(capsys):
    faults = Emulation(faults='turn=30 gain=5')
    status, checks = found(capsys, emulation=faults, push=True, moves=False)
    assert status == Status.FAILED
    assert checks['force']['verdict'] == checks['gain']['verdict'] == 'wrong', checks
    assert checks['release']['verdict'] == 'ok'
    assert 'unit' not in checks


@pytest.mark.thorough
def test_an_arm_that_is_wrong_in_every_way_is_told_so_in_every_way(capsys):
    wrong = Emulation(
        arm={'rate': 200.0},
        device={'length_unit': 'mm', 'mirrored_axis': 'y', 'force_sign': -1},
    )
    status, checks = found(capsys, emulation=wrong, push=True)
    assert status == Status.FAILED
    assert 150 < float(checks['rate']['measured'].split()[0]) < 250
    for name, remedy in {
        'rate': 'raise the rate',
        'unit': 'device.length_unit: mm',
        'handedness': 'left-handed',
        'force': 'device.force_sign: -1',
    }.items():
        assert checks[name]['verdict'] == 'wrong'
        assert remedy in checks[name]['sentence']


@pytest.fixture
def neighbour(monkeypatch: pytest.MonkeyPatch) -> Iterator[rclpy.node.Node]:
    """A node in the domain that the probe will take."""
    monkeypatch.setattr(probe_node, 'FIRST_POSE_TIMEOUT_S', 2.0)
    with command.reserved_domain('free') as domain:
        pass
    os.environ.update(command.node_environment(domain))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('neighbour', context=context)
    node.domain = domain
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def probed(capsys, neighbour, **options):
    status = run_probe(ProbeOptions(domain=neighbour.domain, as_json=True, **options))
    return status, json.loads(capsys.readouterr().out)


def test_nobody_there_is_wrong_and_the_arms_that_are_there_are_named(capsys, neighbour):
    neighbour.create_publisher(PoseStamped, '/MTML/measured_cp', STREAM)
    status, (check,) = probed(capsys, neighbour)
    assert status == Status.FAILED
    assert '/MTML/measured_cp' in check['sentence'] and '--arm' in check['sentence']


def test_an_arm_that_is_silent_or_best_effort_is_wrong_and_nothing_is_sent_to_it(capsys, neighbour):
    shy = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    neighbour.create_publisher(PoseStamped, 'arm/measured_cp', shy)
    forces = polled(neighbour, WrenchStamped, 'arm/servo_cf', STREAM)
    status, checks = probed(capsys, neighbour, push=True)
    assert status == Status.FAILED
    by_name = {check['name']: check for check in checks}
    assert 'best effort' in by_name['publisher']['sentence']
    assert 'sends nothing' in by_name['rate']['sentence']
    assert take(forces) is None


def test_two_arms_on_one_topic_are_told(capsys, neighbour):
    for _ in range(2):
        neighbour.create_publisher(PoseStamped, 'arm/measured_cp', STREAM)
    _, checks = probed(capsys, neighbour)
    assert '2 publishers' in checks[0]['sentence']


def test_an_unknown_profile_is_bad_input_before_anything_starts(capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(['probe-device', '--profile', 'tuch', '--emulated', '--domain', 'free'])
    assert stopped.value.code == Status.BAD_INPUT
    assert 'did you mean touch?' in capsys.readouterr().err
