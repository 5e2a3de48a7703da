"""Commands of the nodes of a session, in the order of their end."""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cutting_trainer.node_common.share_folder import PACKAGES, share_folder
from cutting_trainer.session.domain import RANGE
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.processors import Work

ARM_NODE, BRIDGE_NODE, TISSUE_NODE = 'emulated_arm', 'haptic_bridge', 'tissue_sim'
CUTTING_NODE, RECORDER_NODE, VIEWER_NODE = 'cutting', 'recorder', 'viewer'

MODULES = {
    ARM_NODE: 'cutting_trainer.haptic_bridge.emulated_arm.node',
    BRIDGE_NODE: 'cutting_trainer.haptic_bridge.node',
    TISSUE_NODE: 'cutting_trainer.tissue_sim.node',
    CUTTING_NODE: 'cutting_trainer.cutting.node',
    RECORDER_NODE: 'cutting_trainer.bags.recorder_node',
    VIEWER_NODE: 'cutting_trainer.viewer.node',
}
SIM_SIDE = (TISSUE_NODE, CUTTING_NODE)
"""Nodes that may run on another host than the device."""
SIMULATION = (ARM_NODE, BRIDGE_NODE, TISSUE_NODE, CUTTING_NODE)
"""Nodes of a session, without those that only subscribe."""
SESSION_PUBLISHERS = f'/{ARM_NODE},/{TISSUE_NODE}'
"""Publishers of poses, forces and meshes in a session with the emulated arm."""
OF_A_TOOL = (ARM_NODE, BRIDGE_NODE)
"""Nodes that each tool has."""
WORK: dict[str, Work] = {
    ARM_NODE: 'arm',
    BRIDGE_NODE: 'bridge',
    TISSUE_NODE: 'frames',
    RECORDER_NODE: 'messages',
}
"""Nodes that may get processors of their own."""
SHARED = (
    *('tissue/mesh', 'tissue/mesh_updates', 'tissue/get_mesh', 'tissue/reset'),
    'haptic_bridge/e_stop',
)
"""Topics and services of the graph that the bridge of a further tool uses."""
DEVICE_TOPICS = (
    *('measured_cp', 'servo_cf', 'body/servo_cf', 'spatial/servo_cf'),
    *('button', 'clutch', 'jaw/measured_js', 'operating_state', 'state_command'),
)
"""Topics between bridge, viewer and device."""
RESTART_PARAMETERS: dict[str, dict[str, object]] = {
    BRIDGE_NODE: {'auto_enable': False},
    TISSUE_NODE: {'resume': True},
    RECORDER_NODE: {'resume': True},
}
"""Parameters of restarted nodes: no force without a command, the tissue in its last state, a new
bag beside the truncated one."""
E_STOP_PARAMETERS: dict[str, dict[str, object]] = {BRIDGE_NODE: {'e_stop_pressed': True}}
"""Parameters of nodes that start while E-STOP is pressed."""
RECORDER_GRACE_S = 20.0  # [s]
LOCAL, PORT = '127.0.0.1', 8080
"""Default address and port of the page."""
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


def session_nodes(
    scene: Path,
    bag: Path,
    seed: int,
    seconds: float,
    tools: Sequence[str] = (),
    attempt: Mapping[str, object] | None = None,
) -> list[NodeCommand]:
    """Return commands for the five nodes, and arm and bridge of each further tool.

    Args:
        scene: scene file of all nodes.
        bag: folder of the new bag.
        seed: seed of all random numbers.
        seconds: duration of the arm's script [s].
        tools: names of the further tools of the scene.
        attempt: subject, attempt and notes, parameters of the recorder.
    """
    own: dict[str, dict[str, object]] = {
        ARM_NODE: {'seconds': float(seconds)},
        BRIDGE_NODE: {'auto_enable': True, 'accepted_publishers': SESSION_PUBLISHERS},
    }
    common = {'scene': str(scene), 'seed': seed}
    commands = _nodes(common, own, tools)
    return [*commands, recorder_command(scene, bag, seed, attempt)]


def simulation_nodes(
    scene: Path, seed: int, checkpoint: Path, tools: Sequence[str] = (), arm: str = ''
) -> list[NodeCommand]:
    """Return commands for a session that waits for its operator, without script and force.

    Args:
        scene: scene file of all nodes.
        seed: seed of all random numbers.
        checkpoint: file of the tissue's state.
        tools: names of the further tools of the scene.
        arm: namespace of a device whose driver runs; '': the emulated arm.
    """
    common = {'scene': str(scene), 'seed': seed}
    own: dict[str, dict[str, object]] = {
        ARM_NODE: {'guided': True},
        BRIDGE_NODE: {'accepted_publishers': SESSION_PUBLISHERS},
        TISSUE_NODE: {'checkpoint': str(checkpoint)},
    }
    nodes = _nodes(common, own, tools)
    if not arm:
        return nodes
    bridge = node_command(BRIDGE_NODE, common, of_device(arm))
    others = [node for node in nodes if node.name != ARM_NODE]
    return [bridge if node.name == BRIDGE_NODE else node for node in others]


def of_device(arm: str) -> dict[str, str]:
    """Return the names of a device's topics, by those in the nodes' code.

    Args:
        arm: namespace of the device, as in /MTML for /MTML/measured_cp; '': that of the code.
    """
    return {f'arm/{topic}': f'{arm}/{topic}' for topic in DEVICE_TOPICS} if arm else {}


def _nodes(
    common: Mapping[str, object], own: Mapping[str, Mapping[str, object]], tools: Sequence[str]
) -> list[NodeCommand]:
    """Return commands for the nodes of a simulation.

    Args:
        common: parameters of all nodes.
        own: further ones by node.
        tools: names of the further tools of the scene.
    """
    commands = [node_command(name, {**common, **own.get(name, {})}) for name in SIMULATION]
    first = [tool_command(t, n, {**common, **own.get(n, {})}) for t in tools for n in OF_A_TOOL]
    return [*first, *commands]


def tool_command(tool: str, name: str, parameters: Mapping[str, object]) -> NodeCommand:
    """Return the command of the arm or bridge of a further tool, which are in its namespace.

    Mesh and E-STOP are those of all tools.

    Args:
        tool: its name.
        name: one of `OF_A_TOOL`.
        parameters: as those of the first tool.
    """
    given = {**parameters, 'tool': tool}
    if accepted := str(given.get('accepted_publishers', '')):
        given['accepted_publishers'] = accepted.replace(f'/{ARM_NODE}', f'/{tool}/{ARM_NODE}')
    shared = {topic: f'/{topic}' for topic in SHARED if name == BRIDGE_NODE}
    command = node_command(name, given, {'__ns': f'/{tool}', **shared})
    return replace(command, name=f'{tool}/{name}')


def bridge_side_nodes(
    scene: Path, bag: Path, seed: int, seconds: float, *, arm: bool
) -> list[NodeCommand]:
    """Return commands for the host with the device: bridge, recorder, and optionally an arm.

    Args:
        scene: scene file of all nodes.
        bag: folder of the new bag.
        seed: seed of all random numbers.
        seconds: duration of the arm's script [s].
        arm: run the emulated arm in the place of a device; else the bridge waits for an operator
            who enables it.
    """
    nodes = session_nodes(scene, bag, seed, seconds)
    if not arm:
        nodes = [n for n in nodes if n.name not in (ARM_NODE, BRIDGE_NODE)]
        nodes.insert(0, node_command(BRIDGE_NODE, {'scene': str(scene), 'seed': seed}))
    return [node for node in nodes if node.name not in SIM_SIDE]


def sim_side_nodes(
    scene: Path, seed: int, checkpoint: Path, mesh_bandwidth: float
) -> list[NodeCommand]:
    """Return commands for the host that computes the tissue.

    Args:
        scene: scene file of both sides.
        seed: seed of all random numbers.
        checkpoint: file of the tissue's state.
        mesh_bandwidth: limit of the outgoing mesh data [bytes/s]; 0: no limit.
    """
    common: dict[str, object] = {'scene': str(scene), 'seed': seed}
    kept = {'checkpoint': str(checkpoint), 'mesh_bandwidth': mesh_bandwidth}
    return [node_command(TISSUE_NODE, common | kept), node_command(CUTTING_NODE, common)]


def viewer_command(
    scene: Path,
    host: str,
    port: int,
    *,
    session: bool,
    allow_host: Sequence[str] = (),
    arm: str = '',
) -> NodeCommand:
    """Return the command of the node that serves the page.

    Args:
        scene: scene file of the session.
        host, port: address and port of the page.
        session: the launcher answers requests of the page.
        allow_host: host names under which the page is served.
        arm: namespace of a device whose driver runs; '': the emulated arm.
    """
    parameters = {'scene': str(scene), 'host': host, 'port': port, 'session': session}
    parameters['allow_host'] = ','.join(allow_host)
    return replace(node_command(VIEWER_NODE, parameters, of_device(arm)), converses=session)


def node_command(
    name: str, parameters: Mapping[str, object], remapped: Mapping[str, str] | None = None
) -> NodeCommand:
    """Return the command of a node.

    Args:
        name: key of `MODULES`.
        parameters: parameters by name.
        remapped: new names of topics and services, by their names in the node's code.
    """
    renamed = [f'{before}:={after}' for before, after in (remapped or {}).items()]
    remaps = tuple(word for rule in renamed for word in ('-r', rule))
    argv = _argv(MODULES[name], parameters) + remaps
    again, stopped = (
        _parameters(given.get(name, {})) for given in (RESTART_PARAMETERS, E_STOP_PARAMETERS)
    )
    return NodeCommand(
        name, argv, restart_arguments=again, e_stop_arguments=stopped, has_heartbeat=True,
        work=WORK.get(name, 'other'),
    )  # fmt: skip


def recorder_command(
    scene: Path | None, bag: Path, seed: int, parameters: Mapping[str, object] | None = None
) -> NodeCommand:
    """Return the command of the recorder, which ends last and has time to close its bag.

    Args:
        scene: scene file, copied into the bag; None: unknown.
        bag: folder of the new bag.
        seed: seed, written into the bag.
        parameters: further parameters of the node, by name.
    """
    own = {'scene': str(scene or ''), 'seed': seed, 'bag': str(bag)}
    command = node_command(RECORDER_NODE, own | dict(parameters or {}))
    return replace(command, records=True, grace=RECORDER_GRACE_S)


def discovery(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that restrict the nodes to this machine unless the shell sets others.

    The profile restricts the range, not the value LOCALHOST: with that, rmw_fastrtps would add
    transports, namely shared memory and sockets on all interfaces (config/dds/localhost.xml).

    Args:
        environ: environment of the shell.
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
    """Return the command of the emulated arm alone."""
    values = {'scene': str(scene), **parameters}
    return NodeCommand(ARM_NODE, _argv(MODULES[ARM_NODE], values), has_heartbeat=True)


def _argv(module: str, parameters: Mapping[str, object]) -> tuple[str, ...]:
    # Output of a node goes to the log in the bag; ROS would keep a copy in ~/.ros/log for ever.
    argv = [sys.executable, '-m', module, '--ros-args', '--disable-external-lib-logs']
    return (*argv, *_parameters(parameters))


def _parameters(values: Mapping[str, object]) -> tuple[str, ...]:
    # The last value of a repeated parameter holds.
    given = [f'{key}:={json.dumps(value, ensure_ascii=False)}' for key, value in values.items()]
    return tuple(word for text in given for word in ('-p', text))


def node_environment(domain: int) -> dict[str, str]:
    """Return the environment of the nodes: that of this process, with a ROS domain.

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
