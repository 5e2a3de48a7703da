"""The nodes of a session, as commands in the order in which they are ended."""

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from session.node_process import NodeCommand
from tissue_sim.share import PACKAGES, share_folder

ARM_NODE, BRIDGE_NODE, TISSUE_NODE = 'emulated_arm', 'haptic_bridge', 'tissue_sim'
CUTTING_NODE, RECORDER_NODE, VIEWER_NODE = 'cutting', 'recorder', 'viewer'

MODULES = {
    ARM_NODE: 'haptic_bridge.arm_node',
    BRIDGE_NODE: 'haptic_bridge.node',
    TISSUE_NODE: 'tissue_sim.node',
    CUTTING_NODE: 'cutting.node',
    RECORDER_NODE: 'bags.node',
    VIEWER_NODE: 'viewer.node',
}
SIMULATION = (ARM_NODE, BRIDGE_NODE, TISSUE_NODE, CUTTING_NODE)
"""The nodes of a session, without who only listens."""
CLOSING_A_BAG = 20.0  # [s]
LOCAL, PORT = '127.0.0.1', 8080
"""Where the page is served unless the user says else."""
RANGE, PROFILES = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'FASTRTPS_DEFAULT_PROFILES_FILE'


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
    }
    common = {'scene': str(scene), 'seed': seed}
    commands = [node_command(name, common | own.get(name, {})) for name in SIMULATION]
    return [*commands, recorder_command(scene, bag, seed)]


def simulation_nodes(scene: Path, seed: int) -> list[NodeCommand]:
    """Commands for a session that waits for its operator: the hand has no script, no force is on.

    Args:
        scene: file that all of them read.
        seed: of everything random.
    """
    common = {'scene': str(scene), 'seed': seed}
    own = {ARM_NODE: {'guided': True}}
    return [node_command(name, common | own.get(name, {})) for name in SIMULATION]


def viewer_command(scene: Path, host: str, port: int, *, session: bool) -> NodeCommand:
    """The page.

    Args:
        scene: file that the session runs.
        host, port: where the page is served.
        session: whether the launcher does what the page asks for.
    """
    parameters = {'scene': str(scene), 'host': host, 'port': port, 'session': session}
    return replace(node_command(VIEWER_NODE, parameters), converses=session)


def node_command(
    name: str, parameters: Mapping[str, object], remapped: Mapping[str, str] | None = None
) -> NodeCommand:
    """A node to run.

    Args:
        name: one of `MODULES`.
        parameters: by name.
        remapped: topics and services by the names that the node's code gives them.
    """
    renamed = [f'{before}:={after}' for before, after in (remapped or {}).items()]
    argv = _argv(MODULES[name], parameters) + tuple(x for rule in renamed for x in ('-r', rule))
    return NodeCommand(name, argv)


def recorder_command(scene: Path | None, bag: Path, seed: int) -> NodeCommand:
    """The recorder, which is ended last and has time to close its bag.

    Args:
        scene: file of which the text goes into the bag; None: not known.
        bag: folder of the new bag.
        seed: goes into the bag.
    """
    parameters = {'scene': str(scene or ''), 'seed': seed, 'bag': str(bag)}
    command = node_command(RECORDER_NODE, parameters)
    return replace(command, records=True, grace=CLOSING_A_BAG)


def discovery(environ: Mapping[str, str]) -> dict[str, str]:
    """The variables that keep the nodes to this machine unless the shell says else.

    The profile does what the range LOCALHOST asks for: with that word, rmw_fastrtps would add
    transports of its own, shared memory and sockets on all interfaces (config/dds/localhost.xml).

    Args:
        environ: of the shell.
    """
    given = environ.get(RANGE, 'LOCALHOST')
    profile = 'localhost' if given == 'LOCALHOST' else 'network'
    path = str(share_folder() / 'config' / 'dds' / f'{profile}.xml')
    if environ.get(PROFILES, path) != path:
        return {RANGE: given, PROFILES: environ[PROFILES]}
    return {RANGE: 'SYSTEM_DEFAULT' if given == 'LOCALHOST' else given, PROFILES: path}


def arm_command(scene: Path, **parameters: object) -> NodeCommand:
    """The emulated arm alone."""
    values = {'scene': str(scene), **parameters}
    return NodeCommand(ARM_NODE, _argv(MODULES[ARM_NODE], values))


def _argv(module: str, parameters: Mapping[str, object]) -> tuple[str, ...]:
    # What a node says goes to the log in the bag; ROS would keep a copy in ~/.ros/log for ever.
    argv = [sys.executable, '-m', module, '--ros-args', '--disable-external-lib-logs']
    for key, value in parameters.items():
        argv += ['-p', f'{key}:={json.dumps(value, ensure_ascii=False)}']
    return tuple(argv)


def node_environment(domain: int) -> dict[str, str]:
    """The one environment of all nodes: this process's own, on this machine unless it says else.

    Args:
        domain: ROS domain.
    """
    inherited = dict(os.environ)
    path = [str(PACKAGES), *filter(None, [inherited.get('PYTHONPATH')])]
    return {
        **inherited,
        **discovery(inherited),
        'ROS_DOMAIN_ID': str(domain),
        'PYTHONPATH': os.pathsep.join(path),
        'PYTHONUNBUFFERED': '1',
    }
