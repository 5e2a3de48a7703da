"""Claims about the adapter for drivers that speak omni_msgs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from live import free_domain, node_words, running

from cutting_trainer.haptic_bridge.devices.omni import ForceLatch, OmniConvention
from cutting_trainer.session.node_commands import node_environment

ROOT = Path(__file__).resolve().parents[1]
DOMAIN = free_domain()
MILLISECOND = 1_000_000


def test_millimetres_become_metres_and_the_axes_of_the_force_are_the_drivers():
    convention = OmniConvention('mm', 'x -z y')
    assert convention.metres((10.0, -20.0, 5.0)) == pytest.approx((0.01, -0.02, 0.005))
    assert convention.driver_force((1.0, 2.0, 3.0)) == (1.0, -3.0, 2.0)


@pytest.mark.parametrize('bad', [('cm',), ('mm', 'x y y'), ('mm', 'x y'), ('mm', 'x y z', 3.0)])
def test_a_wrong_convention_is_refused_in_a_sentence(bad):
    with pytest.raises(ValueError, match=r'use|name'):
        OmniConvention(*bad)


def test_a_force_is_held_for_30_ms_and_no_longer():
    latch = ForceLatch(OmniConvention())
    latch.take(5, (0.0, 0.0, 1.0), 0)
    assert latch.force(30 * MILLISECOND) == (0, 0, 1)
    assert latch.force(31 * MILLISECOND) == (0, 0, 0)
    latch.take(3, (0.0, 0.0, 2.0), 40 * MILLISECOND)  # another clock, after a silence
    assert latch.force(41 * MILLISECOND) == (0, 0, 2)
    latch.take(2, (0.0, 0.0, 9.0), 42 * MILLISECOND)
    assert latch.force(42 * MILLISECOND) == (0, 0, 2)
    for stamp, force in ((0, (1.0, 0.0, 0.0)), (9, (float('nan'), 0.0, 0.0))):
        latch.take(stamp, force, 43 * MILLISECOND)
        assert latch.force(43 * MILLISECOND) == (0, 0, 0)


@pytest.mark.live
@pytest.mark.thorough
def test_a_driver_of_omni_msgs_is_an_arm_after_crtk(others_messages):
    ours = node_environment(DOMAIN)
    environment = others_messages | {
        key: ours[key] for key in ours if key.startswith(('ROS_', 'FASTRTPS_'))
    }
    names = ('state', 'button', 'force_feedback')
    remapped = [word for name in names for word in ('-r', f'omni/{name}:=phantom/{name}')]
    parameters = ['-p', 'unit:=mm', '-p', 'force_axes:=x z y']
    module = 'cutting_trainer.haptic_bridge.devices.omni_node'
    command = node_words(module, *parameters, *remapped)
    with running(command, environment, 'ready: omni_adapter'):
        done = subprocess.run(
            [sys.executable, str(ROOT / 'test' / 'omni_driver.py')],
            env=environment,
            capture_output=True,
            text=True,
            timeout=90,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen['pushed'] == pytest.approx(0.8)
    assert seen['silent'] == 0
    assert seen['position'] == pytest.approx(0.05 + 0.8 / 400)
    assert seen['buttons'] == [[1, 0]]


@pytest.mark.long
def test_without_omni_msgs_the_adapter_says_what_to_do(tmp_path):
    pytest.importorskip('rclpy')
    done = subprocess.run(
        [sys.executable, '-m', 'cutting_trainer.haptic_bridge.devices.omni_node'],
        cwd=ROOT,
        env=node_environment(DOMAIN),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert 'omni_msgs is not installed' in done.stderr
