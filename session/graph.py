"""The nodes of a session, as commands in the order in which they are ended."""

import json
import os
import sys
from pathlib import Path

from session.node_process import NodeCommand
from tissue_sim.share import PACKAGES, share_folder

ARM_NODE, BRIDGE_NODE, TISSUE_NODE = 'emulated_arm', 'haptic_bridge', 'tissue_sim'
CUTTING_NODE, RECORDER_NODE = 'cutting', 'recorder'

MODULES = {
    ARM_NODE: 'haptic_bridge.arm_node',
    BRIDGE_NODE: 'haptic_bridge.node',
    TISSUE_NODE: 'tissue_sim.node',
    CUTTING_NODE: 'cutting.node',
    RECORDER_NODE: 'bags.node',
}
CLOSING_A_BAG = 20.0  # [s]


def session_nodes(scene: Path, bag: Path, seed: int, seconds: float) -> list[NodeCommand]:
    """Commands for the five nodes.

    Args:
        scene: file that all of them read.
        bag: folder of the new bag.
        seed: of everything random.
        seconds: duration of the arm's script [s].
    """
    own: dict[str, dict[str, object]] = {
        ARM_NODE: {'seconds': float(seconds)},
        BRIDGE_NODE: {'auto_enable': True},
        RECORDER_NODE: {'bag': str(bag)},
    }
    commands = []
    for name, module in MODULES.items():
        parameters = {'scene': str(scene), 'seed': seed, **own.get(name, {})}
        argv = [sys.executable, '-m', module, '--ros-args']
        for key, value in parameters.items():
            argv += ['-p', f'{key}:={json.dumps(value, ensure_ascii=False)}']
        records = name == RECORDER_NODE
        grace = CLOSING_A_BAG if records else NodeCommand.grace
        commands.append(NodeCommand(name, tuple(argv), records=records, grace=grace))
    return commands


def node_environment(domain: int) -> dict[str, str]:
    """The one environment of all nodes: this process's own, on this machine unless it says else.

    Args:
        domain: ROS domain.
    """
    inherited = dict(os.environ)
    path = [str(PACKAGES), *filter(None, [inherited.get('PYTHONPATH')])]
    return {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(share_folder() / 'config' / 'fastdds.xml'),
        **inherited,
        'ROS_DOMAIN_ID': str(domain),
        'PYTHONPATH': os.pathsep.join(path),
        'PYTHONUNBUFFERED': '1',
    }
