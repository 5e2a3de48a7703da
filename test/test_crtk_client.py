"""A CRTK client, and a CRTK device, against the arm and the bridge by remapping alone."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from live import free_domain, node_words, running

pytest.importorskip('rclpy')

from cutting_trainer.session.node_commands import MODULES, node_environment

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[1]
DOMAIN = free_domain()
SCENE = """
arm:
  frame_id: MTML_base
  force_resolution: 0
  script:
    start: {position: [0.01, 0, 0.03]}
    phases: [{kind: rest}]
device: {profile: touch, force_topic: body/servo_cf}
haptics: {device_timeout: 0.2}
"""
"""The device's deadline is longer than 20 ms, so that a machine that is held up is no fault."""
OURS = 'crtk_msgs' if find_spec('crtk_msgs') else 'cutting_trainer_msgs'


@pytest.fixture(params=[OURS, pytest.param('crtk_msgs', marks=pytest.mark.thorough)])
def types(request: pytest.FixtureRequest) -> tuple[str, dict[str, str]]:
    """The package that the types come from, and the environment in which it is there."""
    if request.param == OURS:
        return OURS, dict(os.environ)
    return 'crtk_msgs', request.getfixturevalue('others_messages')


def started(name: str, scene: Path, environment: dict[str, str], remappings: dict[str, str]) -> Any:
    remaps = [word for rule in remappings.items() for word in ('-r', ':='.join(rule))]
    command = node_words(MODULES[name], '-p', f'scene:={scene}', *remaps)
    return running(command, environment, f'ready: {name}')


def play(types: tuple[str, dict[str, str]], *arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, str(ROOT / 'test' / 'crtk_client.py'), types[0], *arguments],
        env=in_domain(types[1]),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def in_domain(environment: dict[str, str]) -> dict[str, str]:
    ours = node_environment(DOMAIN)
    return environment | {key: ours[key] for key in ours if key.startswith(('ROS_', 'FASTRTPS_'))}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / 'scene.yaml'
    path.write_text(SCENE)
    return path


def at_once(joined: dict[str, Any], state: str) -> None:
    """A volatile subscriber has heard nothing before its word, and the answer to it soon after."""
    assert joined['before a word'] == ''
    for word in ('enable', 'home'):
        done, seconds = joined[word]
        assert done, f'{word} was not answered'
        assert seconds < 2.0
    assert joined['then'] == [state, True]


def test_a_crtk_client_that_joins_late_enables_reads_moves_and_operates_the_arm(types, scene):
    names = ('measured_cp', 'measured_cv', 'measured_cf', 'button')
    names = (*names, 'operating_state', 'state_command', 'hand/servo_cp')
    remapped = {f'arm/{name}': f'/MTML/{name}' for name in names}
    remapped['arm/body/servo_cf'] = '/MTML/servo_cf'  # the client has no `body`
    with started('emulated_arm', scene, in_domain(types[1]), remapped):
        seen = play(types, 'arm', '/MTML')
    at_once(seen['joined'], 'ENABLED')
    assert seen['query'] == ['ENABLED', True, False]
    assert seen['with command'] == 0.5
    assert seen['without command'] == 0
    assert seen['while disabled'] == 0
    # PAUSED + enable and DISABLED + pause are invalid; homing changes no state.
    after = ['PAUSED', 'PAUSED', 'ENABLED', 'DISABLED', 'DISABLED', *4 * ['ENABLED']]
    assert seen['states'] == after
    assert all(seen['around'])
    assert seen['frame'] == 'MTML_base'
    assert seen['position'] == pytest.approx([0.01, 0.03], abs=2e-3)
    assert seen['guided to'] == pytest.approx(0.05, abs=2e-3)
    assert all(count > 100 for count in seen['messages'].values())


def test_a_crtk_device_drives_the_bridge_and_a_client_operates_it(types, scene):
    remapped = {
        'arm/measured_cp': '/phantom/measured_cp',
        'arm/body/servo_cf': '/phantom/body/servo_cf',
        'haptic_bridge/operating_state': '/bridge/operating_state',
        'haptic_bridge/state_command': '/bridge/state_command',
    }
    with started('haptic_bridge', scene, in_domain(types[1]), remapped):
        seen = play(types, 'device', '/phantom', '/bridge')
    assert seen['query'] == ['DISABLED', True, False]
    at_once(seen['joined'], 'ENABLED')
    assert seen['states'] == ['ENABLED', 'PAUSED', 'PAUSED', 'ENABLED', 'DISABLED', 'ENABLED']
    assert all(seen['around'])
    # Leaving FAULT is a command, a retry that fails while its cause is there.
    assert seen['device silent'] == ['FAULT', 'FAULT', 'FAULT']
    assert seen['device back'] == ['FAULT', True]
    assert seen['force'] == 0
    assert seen['wrenches'] > 500
