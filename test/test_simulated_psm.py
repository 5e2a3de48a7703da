"""Tissue in a simulator of arms: a PSM is the tool, its jaws grasp, its master takes the force."""

import os
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from live import (
    ABOVE,
    PRESSED,
    PRESSING,
    PROFILE,
    SPOT,
    free_domain,
    node_words,
    phase,
    running,
    wait_for,
    write_scene,
)
from psm import PsmWithMaster
from ruamel.yaml import YAML
from sensor_msgs.msg import JointState
from test_launch_files import launch_description, of_kind

from cutting_trainer.haptic_bridge import device_jaw
from cutting_trainer.haptic_bridge.scene_schema import Transform
from cutting_trainer.node_common.rejections import RejectionStatistics
from cutting_trainer.session.node_commands import MODULES, node_environment
from cutting_trainer.tissue_sim.contact.tool import ToolMode

CLOSED, OPEN = 0.0, 1.0
"""[rad]"""
CLOSES_AT = 0.2
FRAME = {'translation': (0.01, 0.02, 0.12), 'rotation_rpy_deg': (160.0, 20.0, 90.0), 'scale': 1.0}
LIFTED = 0.0220


def remapped(monkeypatch: pytest.MonkeyPatch, **given: str) -> dict[str, str]:
    """Names of the bridge's topics, as the launch file gives them."""
    entities = launch_description(monkeypatch, 'simulator')
    values = {
        e.args[0]: e.kwargs['default_value'] for e in of_kind(entities, 'DeclareLaunchArgument')
    } | given
    nodes = {e.kwargs['name']: e.kwargs for e in of_kind(entities, 'Node')}
    assert nodes.keys() == MODULES.keys() - {'emulated_arm'}
    assert nodes['viewer']['remappings'] == nodes['haptic_bridge']['remappings']

    def text(part: Any) -> str:
        return part if isinstance(part, str) else values[part.args[0]]

    return {a: ''.join(map(text, b)) for a, b in nodes['haptic_bridge']['remappings']}


def test_the_launch_file_takes_poses_of_the_psm_and_gives_the_force_to_the_master(monkeypatch):
    names = remapped(monkeypatch, psm='/PSM2', master='/MTML', pose_topic='local/measured_cp')
    forces = {'servo_cf', 'body/servo_cf', 'spatial/servo_cf'}
    assert {n for n, to in names.items() if to.startswith('/MTML/')} == {f'arm/{n}' for n in forces}
    assert names['arm/measured_cp'] == '/PSM2/local/measured_cp'
    assert names['arm/jaw/measured_js'] == '/PSM2/jaw/measured_js'
    assert names['arm/operating_state'] == '/PSM2/operating_state'


def grasping(folder: Path) -> Path:
    path = write_scene(folder, [phase('rest')], 20.0, cut_threshold=100.0)
    scene = YAML(typ='safe').load(path)
    scene['tool']['mode'] = 'open_grasper'
    scene['device'] |= {'jaw_closed': CLOSES_AT, 'force_topic': 'body/servo_cf'}
    scene['device']['tissue_from_device'] = {
        key: list(value) if isinstance(value, tuple) else value for key, value in FRAME.items()
    }
    with path.open('w') as file:
        YAML().dump(scene, file)
    return path


@pytest.mark.live
def test_a_psm_at_120_hz_presses_grasps_lifts_and_lets_go(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rules = remapped(monkeypatch)
    remaps = [word for rule in rules.items() for word in ('-r', ':='.join(rule))]
    scene, domain = grasping(tmp_path), free_domain()
    environment = os.environ | node_environment(domain)
    monkeypatch.setattr(os, 'environ', environment)
    frame = Transform.model_validate(FRAME)
    with ExitStack() as stack:
        for name, more in (('tissue_sim', []), ('haptic_bridge', ['-p', 'auto_enable:=true'])):
            words = node_words(MODULES[name], '-p', f'scene:={scene}', *more, *remaps)
            stack.enter_context(running(words, environment, f'ready: {name}'))
        psm = PsmWithMaster(domain, '/PSM1', '/MTMR', frame, (*SPOT, ABOVE))
        stack.callback(psm.close)
        wait_for(lambda: psm.forces, 'a force for the master')
        assert not psm.felt().any()
        psm.goal = np.array([*SPOT, PRESSED])
        wait_for(lambda: psm.felt()[2] > PRESSING, 'the press to be felt')
        along, across = psm.felt()[2], np.linalg.norm(psm.felt()[:2])
        assert along > 5 * across  # in the axes of the poses
        psm.jaw = CLOSED
        held = len(psm.forces)
        wait_for(lambda: len(psm.forces) > held + 300, 'the jaws to close')
        psm.goal = np.array([*SPOT, LIFTED])
        wait_for(lambda: psm.felt()[2] < -0.02, 'the lifted tissue to pull')
        psm.jaw = OPEN
        wait_for(lambda: not psm.felt().any(), 'the tissue to be let go')
        norms = np.linalg.norm([force for _, force in psm.forces], axis=1)
        assert PRESSING < norms.max() <= PROFILE.max_force


def jaws(monkeypatch: pytest.MonkeyPatch, *messages: Any) -> tuple[list[bool], Any]:
    """What a jaw says of messages, and what it has refused."""
    waiting = list(messages)
    monkeypatch.setattr(device_jaw.ros, 'polled', lambda *_: None)
    monkeypatch.setattr(device_jaw.ros, 'take', lambda *_: waiting.pop(0))
    node: Any = SimpleNamespace(max_message=1e6, rejections=RejectionStatistics())
    said: list[bool] = []
    jaw = device_jaw.DeviceJaw(node, CLOSES_AT, said.append)
    while waiting:
        jaw.poll()
    return said, node.rejections


def test_jaws_close_at_their_angle_and_do_not_flutter_about_it(monkeypatch):
    angles = (1.0, 0.21, 0.2, 0.25, 0.19, 0.29, 0.31, 0.25, -0.3)
    said, _ = jaws(monkeypatch, *(JointState(position=[angle]) for angle in angles))
    assert said == [False, True, False, True]


def test_a_message_without_the_one_angle_changes_nothing_and_is_counted(monkeypatch):
    wrong = [JointState(position=given) for given in ([], [0.0, 0.0], [float('nan')])]
    said, rejections = jaws(monkeypatch, JointState(position=[OPEN]), *wrong, None)
    assert said == [False]
    assert rejections.values() == {'refused arm/jaw/measured_js: no angle of the jaws': 3}


@pytest.mark.parametrize(
    ('closed', 'opened'),
    [(ToolMode.CLOSED_GRASPER, ToolMode.OPEN_GRASPER), (ToolMode.SCALPEL, ToolMode.PALPATOR)],
)
def test_jaws_make_a_grasper_or_scissors_of_a_tool(closed: ToolMode, opened: ToolMode) -> None:
    for mode in (closed, opened):
        assert mode.with_jaws(closed=True) is closed
        assert mode.with_jaws(closed=False) is opened
