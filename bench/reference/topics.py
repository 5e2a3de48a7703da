"""Writes the tables of docs/topics.md from the interfaces and from what the nodes publish.

Run as `python -m bench.reference.topics` in the checkout after a change of either.
"""

from pathlib import Path
from typing import NamedTuple

from rclpy.qos import DurabilityPolicy, QoSProfile

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.share_folder import PACKAGES

FILE = PACKAGES / 'docs' / 'topics.md'
MARK = '<!-- Below: written by `python -m bench.reference.topics` from the interfaces. -->\n'
OURS = 'cutting_trainer_msgs'


class Topic(NamedTuple):
    """One topic.

    Attributes:
        name: as the nodes give it; relative, so that a namespace goes before it.
        type: in full.
        qos: that it is offered with; a profile of `cutting_trainer.node_common.qos`.
        by: who publishes it.
        when: how often.
        content: content of its messages, with units where the message is not ours.
    """

    name: str
    type: str
    qos: QoSProfile
    by: str
    when: str
    content: str


POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
WRENCH, JOY = 'geometry_msgs/msg/WrenchStamped', 'sensor_msgs/msg/Joy'
STATE, COMMAND = f'{OURS}/msg/OperatingState', f'{OURS}/msg/StringStamped'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
BRIDGE, TISSUE = 'haptic_bridge', 'tissue_sim'

TOPICS = (
    Topic('arm/measured_cp', POSE, qos.STREAM, 'arm', '1 kHz', 'pose of the tool [m]'),
    Topic('arm/measured_cv', TWIST, qos.STREAM, 'arm', '1 kHz', 'its velocity [m/s]'),
    Topic(
        'arm/measured_cf',
        WRENCH,
        qos.STREAM,
        'arm',
        '1 kHz',
        'force it applies [N]; not needed',
    ),
    Topic('arm/button', JOY, qos.EVENTS, 'arm', 'on event', 'buttons[0]: 1 pressed'),
    Topic(
        'arm/clutch',
        JOY,
        qos.EVENTS,
        'arm',
        'on event',
        'buttons[0]: 1 takes the hand off the tool',
    ),
    Topic(
        'arm/jaw/measured_js',
        'sensor_msgs/msg/JointState',
        qos.EVENTS,
        'arm',
        'any rate',
        'angle of the jaws [rad]; not needed',
    ),
    Topic(
        'arm/servo_cf',
        WRENCH,
        qos.STREAM,
        BRIDGE,
        '1 kHz',
        "force on the operator's hand [N]",
    ),
    Topic(
        ros.CONTACT,
        f'{OURS}/msg/Contact',
        qos.STREAM,
        BRIDGE,
        '1 kHz',
        'where the tool is',
    ),
    Topic(
        ros.INDEXING,
        f'{OURS}/msg/Indexing',
        qos.HISTORY,
        BRIDGE,
        'at start, on change',
        'how the hand moves the tool',
    ),
    Topic(
        ros.FORCE,
        f'{OURS}/msg/ForceSample',
        qos.STREAM,
        TISSUE,
        '30 Hz',
        'the reaction on it',
    ),
    Topic(
        ros.FRAME_INPUTS,
        f'{OURS}/msg/FrameInputs',
        qos.STREAM,
        TISSUE,
        '30 Hz',
        'the inputs of the frame',
    ),
    Topic(
        ros.TISSUE_STATE,
        f'{OURS}/msg/State',
        qos.STREAM,
        TISSUE,
        'when somebody begins to listen',
        'all that the frames to come depend on',
    ),
    Topic(
        ros.CUTTING_STATE,
        f'{OURS}/msg/State',
        qos.STREAM,
        'cutting',
        'with tissue/state',
        'the state of a stroke then',
    ),
    Topic(
        ros.MESH,
        f'{OURS}/msg/Mesh',
        qos.LATCHED,
        TISSUE,
        'at start, every 5 s',
        'the whole tissue',
    ),
    Topic(
        ros.MESH_UPDATES,
        f'{OURS}/msg/MeshDelta',
        qos.UPDATES,
        TISSUE,
        '30 Hz',
        'changes',
    ),
    Topic(
        ros.PIECES,
        f'{OURS}/msg/FreePiece',
        qos.HISTORY,
        TISSUE,
        'on event',
        'a piece that has come off',
    ),
    *(
        topic
        for owner, by in ((ros.ARM, 'arm'), (BRIDGE, BRIDGE))
        for topic in (
            Topic(f'{owner}/operating_state', STATE, qos.LATCHED, by, 'on event', 'CRTK state'),
            Topic(
                f'{owner}/state_command',
                COMMAND,
                qos.EVENTS,
                'whoever operates',
                '',
                'CRTK command',
            ),
        )
    ),
    Topic(
        ros.E_STOP,
        'std_msgs/msg/Empty',
        qos.EVENTS,
        'whoever operates',
        'on event',
        'any message presses E-STOP',
    ),
    Topic(
        f'{BRIDGE}/e_stopped',
        'std_msgs/msg/Bool',
        qos.LATCHED,
        BRIDGE,
        'at start, on change',
        'whether E-STOP is pressed',
    ),
    Topic(
        ros.HAND,
        POSE,
        qos.EVENTS,
        'whoever guides',
        'on event',
        "goal of the emulated arm's hand [m]",
    ),
    Topic(
        ros.MARKERS,
        'visualization_msgs/msg/MarkerArray',
        qos.EVENTS,
        'viewer',
        '10 Hz while somebody listens',
        'tissue, tool and force, to draw',
    ),
    Topic(ros.DIAGNOSTICS, DIAGNOSTICS, qos.EVENTS, 'every node', '1 Hz', 'how each node is'),
)

SERVICES = (
    (ros.GET_MESH, f'{OURS}/srv/GetMesh', TISSUE, 'the whole tissue now'),
    *(
        (name, f'{OURS}/srv/GetMesh', name.partition('/')[0], 'the tissue as this node knows it')
        for name in ros.MESH_RECOVERY_SERVICES
    ),
    (ros.CUT, f'{OURS}/srv/Cut', 'cutting', 'sweep the blade; `tissue_sim` calls it'),
    (f'{ros.ARM}/operating_state', f'{OURS}/srv/TriggerOperatingState', 'arm', 'CRTK state'),
    (f'{BRIDGE}/operating_state', f'{OURS}/srv/TriggerOperatingState', BRIDGE, 'CRTK state'),
    (ros.RESET_TISSUE, 'std_srvs/srv/Trigger', TISSUE, 'make the tissue whole again'),
    (f'{BRIDGE}/reset_e_stop', 'std_srvs/srv/Trigger', BRIDGE, 'release E-STOP, into DISABLED'),
    ('NODE/change_state', 'lifecycle_msgs/srv/ChangeState', 'every node', 'its life cycle'),
    ('NODE/get_state', 'lifecycle_msgs/srv/GetState', 'every node', 'where in it the node is'),
)


def reference() -> str:
    """Return all tables."""
    head = '| topic | type | queue | from | content |'
    parts = ['## Topics\n', head, '|---' * 5 + '|']
    for t in TOPICS:
        depth = f'{t.qos.depth}, latched' if _is_latched(t.qos) else f'{t.qos.depth}'
        by = f'{t.by}, {t.when}' if t.when else t.by
        cells = (f'`{t.name}`', _type(t.type), depth, by, t.content)
        parts.append(f'| {" | ".join(cells)} |')
    parts += ['\n## Services\n', '| service | type | content |', '|---' * 3 + '|']
    parts += _services()
    parts.append('')
    parts += [_interface(file) for file in interface_files()]
    return '\n'.join(parts)


def _services() -> list[str]:
    """Return the rows of the services; those that differ by their server only share one."""
    servers: dict[tuple[str, str, str], list[str]] = {}
    for name, kind, by, content in SERVICES:
        alike = (name.removeprefix(f'{by}/'), kind, content)
        servers.setdefault(alike, []).append(f'`{name}`')
    return [
        f'| {", ".join(names)} | {_type(kind)} | {content} |'
        for (_, kind, content), names in servers.items()
    ]


def describe(qos: QoSProfile) -> str:
    """Return a profile in words."""
    latched = 'transient local, ' if _is_latched(qos) else ''
    return f'reliable, {latched}keep last {qos.depth}'


def _is_latched(qos: QoSProfile) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def _type(full: str) -> str:
    """Return a type as a link to its definition where it is ours."""
    package, kind, name = full.split('/')
    return f'[`{name}`](#{kind}{name.lower()})' if package == OURS else f'`{package}/{name}`'


def interface_files() -> list[Path]:
    """Return messages and services of ours, by name."""
    folder = PACKAGES / 'msg_defs'
    return [*sorted(folder.glob('msg/*.msg')), *sorted(folder.glob('srv/*.srv'))]


def _interface(file: Path) -> str:
    """Return the section of one message or service; the site puts the file's text in."""
    name = f'{file.suffix[1:]}/{file.name}'
    place = f'msg_defs/{name}'
    section = f'## {name.removesuffix(file.suffix)}\n\n[{place}](../{place})\n'
    return f'{section}\n```text\n--8<-- "{place}"\n```\n'


def main() -> None:
    """Write the tables into the file."""
    head = FILE.read_text(encoding='utf-8').partition(MARK)[0]
    FILE.write_text(f'{head}{MARK}\n{reference()}', encoding='utf-8')


if __name__ == '__main__':
    main()
