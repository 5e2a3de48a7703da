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
SIM_SIDE = (TISSUE_NODE, CUTTING_NODE)
"""What may run on another host than the device."""
SIMULATION = (ARM_NODE, BRIDGE_NODE, TISSUE_NODE, CUTTING_NODE)
"""The nodes of a session, without who only listens."""
AGAIN: dict[str, dict[str, object]] = {
    BRIDGE_NODE: {'auto_enable': False},
    TISSUE_NODE: {'resume': True},
    RECORDER_NODE: {'resume': True},
}
"""Parameters of nodes that take the place of one that died: no force without a command, the tissue
as it was, a bag beside the one that was cut off."""
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


def simulation_nodes(scene: Path, seed: int, checkpoint: Path) -> list[NodeCommand]:
    """Commands for a session that waits for its operator: the hand has no script, no force is on.

    Args:
        scene: file that all of them read.
        seed: of everything random.
        checkpoint: file in which the tissue is kept.
    """
    common = {'scene': str(scene), 'seed': seed}
    own: dict[str, dict[str, object]] = {
        ARM_NODE: {'guided': True},
        TISSUE_NODE: {'checkpoint': str(checkpoint)},
    }
    return [node_command(name, common | own.get(name, {})) for name in SIMULATION]


def bridge_side_nodes(
    scene: Path, bag: Path, seed: int, seconds: float, *, arm: bool
) -> list[NodeCommand]:
    """Commands for the host with the device: the bridge, the recorder, and an arm if none is there.

    Args:
        scene: file that all of them read.
        bag: folder of the new bag.
        seed: of everything random.
        seconds: duration of the arm's script [s].
        arm: whether the emulated arm takes the place of a device; else the bridge waits for an
            operator who enables it.
    """
    nodes = session_nodes(scene, bag, seed, seconds)
    if not arm:
        nodes = [n for n in nodes if n.name not in (ARM_NODE, BRIDGE_NODE)]
        nodes.insert(0, node_command(BRIDGE_NODE, {'scene': str(scene), 'seed': seed}))
    return [node for node in nodes if node.name not in SIM_SIDE]


def sim_side_nodes(
    scene: Path, seed: int, checkpoint: Path, mesh_bandwidth: float
) -> list[NodeCommand]:
    """Commands for the host that computes the tissue.

    Args:
        scene: file that both sides read.
        seed: of everything random.
        checkpoint: file in which the tissue is kept.
        mesh_bandwidth: most that goes out for meshes [bytes/s]; 0: no limit.
    """
    common: dict[str, object] = {'scene': str(scene), 'seed': seed}
    kept = {'checkpoint': str(checkpoint), 'mesh_bandwidth': mesh_bandwidth}
    return [node_command(TISSUE_NODE, common | kept), node_command(CUTTING_NODE, common)]


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
    remaps = tuple(word for rule in renamed for word in ('-r', rule))
    argv = _argv(MODULES[name], parameters) + remaps
    return NodeCommand(name, argv, again=_parameters(AGAIN.get(name, {})))


def recorder_command(
    scene: Path | None, bag: Path, seed: int, parameters: Mapping[str, object] | None = None
) -> NodeCommand:
    """The recorder, which is ended last and has time to close its bag.

    Args:
        scene: file of which the text goes into the bag; None: not known.
        bag: folder of the new bag.
        seed: goes into the bag.
        parameters: others of the node, by name.
    """
    own = {'scene': str(scene or ''), 'seed': seed, 'bag': str(bag)}
    command = node_command(RECORDER_NODE, own | dict(parameters or {}))
    return replace(command, records=True, grace=CLOSING_A_BAG)


def discovery(environ: Mapping[str, str]) -> dict[str, str]:
    """The variables that keep the nodes to this machine unless the shell says else.

    The profile does what the range LOCALHOST asks for: with that word, rmw_fastrtps would add
    transports of its own, shared memory and sockets on all interfaces (config/dds/localhost.xml).

    Args:
        environ: of the shell.
    """
    folder = share_folder() / 'config' / 'dds'
    local, network = (str(folder / f'{name}.xml') for name in ('localhost', 'network'))
    given = environ.get(RANGE, 'LOCALHOST')
    if environ.get(PROFILES, local) not in (local, network):
        return {RANGE: given, PROFILES: environ[PROFILES]}
    if given == 'LOCALHOST' or (given, environ.get(PROFILES)) == ('SYSTEM_DEFAULT', local):
        return {RANGE: 'SYSTEM_DEFAULT', PROFILES: local}  # the latter: within `trainer run`
    return {RANGE: given, PROFILES: network}


def arm_command(scene: Path, **parameters: object) -> NodeCommand:
    """The emulated arm alone."""
    values = {'scene': str(scene), **parameters}
    return NodeCommand(ARM_NODE, _argv(MODULES[ARM_NODE], values))


def _argv(module: str, parameters: Mapping[str, object]) -> tuple[str, ...]:
    # What a node says goes to the log in the bag; ROS would keep a copy in ~/.ros/log for ever.
    argv = [sys.executable, '-m', module, '--ros-args', '--disable-external-lib-logs']
    return (*argv, *_parameters(parameters))


def _parameters(values: Mapping[str, object]) -> tuple[str, ...]:
    # Of a parameter that is given twice, the last one holds.
    given = [f'{key}:={json.dumps(value, ensure_ascii=False)}' for key, value in values.items()]
    return tuple(word for text in given for word in ('-p', text))


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
