"""Writes the tables of docs/topics.md from the interfaces and from what the nodes publish.

Run as `python -m session.topic_reference` in the checkout after a change of either.
"""

import re
from pathlib import Path
from typing import NamedTuple

from rclpy.qos import DurabilityPolicy, QoSProfile

from tissue_sim import ros
from tissue_sim.share import PACKAGES

FILE = PACKAGES / 'docs' / 'topics.md'
MARK = '<!-- Below: written by `python -m session.topic_reference` from the interfaces. -->\n'
OURS = 'cutting_trainer_msgs'
_FIELD = re.compile(r'^([\w/]+(?:\[\w*\])?) +(\w+) *(?:# *(.*))?$')
_CONSTANT = re.compile(r'^\w+ +(\w+=\S+) *(?:# *(.*))?$')


class Topic(NamedTuple):
    """One topic; of the trainer's vectors the frame is `tissue`, of the arm's the device's own.

    Attributes:
        name: as the nodes give it; relative, so that a namespace goes before it.
        type: in full.
        qos: that it is offered with; a profile of `tissue_sim.ros`.
        by: who publishes it.
        when: how often.
        frame: of its vectors.
        what: it says, with units where the message is not ours.
    """

    name: str
    type: str
    qos: QoSProfile
    by: str
    when: str
    frame: str
    what: str


POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
WRENCH, JOY = 'geometry_msgs/msg/WrenchStamped', 'sensor_msgs/msg/Joy'
STATE, COMMAND = f'{OURS}/msg/OperatingState', f'{OURS}/msg/StringStamped'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
BRIDGE, TISSUE, DEVICE = 'haptic_bridge', 'tissue_sim', 'device'

TOPICS = (
    Topic('arm/measured_cp', POSE, ros.STREAM, 'arm', '1 kHz', DEVICE, 'pose of the tool [m]'),
    Topic('arm/measured_cv', TWIST, ros.STREAM, 'arm', '1 kHz', DEVICE, 'its velocity [m/s]'),
    Topic(
        'arm/measured_cf',
        WRENCH,
        ros.STREAM,
        'arm',
        '1 kHz',
        DEVICE,
        'force it applies [N]; not needed',
    ),
    Topic('arm/button', JOY, ros.EVENTS, 'arm', 'on event', '', 'buttons[0]: 1 pressed'),
    Topic(
        'arm/servo_cf',
        WRENCH,
        ros.STREAM,
        BRIDGE,
        '1 kHz',
        DEVICE,
        "force on the operator's hand [N]",
    ),
    Topic(
        ros.CONTACT,
        f'{OURS}/msg/Contact',
        ros.STREAM,
        BRIDGE,
        '1 kHz',
        ros.FRAME,
        'where the tool is',
    ),
    Topic(
        ros.FORCE,
        f'{OURS}/msg/ForceSample',
        ros.STREAM,
        TISSUE,
        '30 Hz',
        ros.FRAME,
        'the reaction on it',
    ),
    Topic(
        ros.FRAME_INPUTS,
        f'{OURS}/msg/FrameInputs',
        ros.STREAM,
        TISSUE,
        '30 Hz',
        '',
        'what the frame was computed from',
    ),
    Topic(
        ros.MESH,
        f'{OURS}/msg/Mesh',
        ros.LATCHED,
        TISSUE,
        'at start, every 5 s',
        ros.FRAME,
        'the whole tissue',
    ),
    Topic(
        ros.MESH_UPDATES,
        f'{OURS}/msg/MeshDelta',
        ros.UPDATES,
        TISSUE,
        '30 Hz',
        ros.FRAME,
        'what changed',
    ),
    *(
        topic
        for owner, by in ((ros.ARM, 'arm'), (BRIDGE, BRIDGE))
        for topic in (
            Topic(f'{owner}/operating_state', STATE, ros.LATCHED, by, 'on event', '', 'CRTK state'),
            Topic(
                f'{owner}/state_command',
                COMMAND,
                ros.EVENTS,
                'whoever operates',
                '',
                '',
                'CRTK command',
            ),
        )
    ),
    Topic(
        ros.HAND,
        POSE,
        ros.EVENTS,
        'whoever guides',
        'on event',
        ros.FRAME,
        "goal of the emulated arm's hand [m]",
    ),
    Topic(
        ros.MARKERS,
        'visualization_msgs/msg/MarkerArray',
        ros.EVENTS,
        'viewer',
        '10 Hz while somebody listens',
        ros.FRAME,
        'tissue, tool and force, to draw',
    ),
    Topic(ros.DIAGNOSTICS, DIAGNOSTICS, ros.EVENTS, 'every node', '1 Hz', '', 'how each node is'),
)

SERVICES = (
    (ros.GET_MESH, f'{OURS}/srv/GetMesh', TISSUE, 'the whole tissue now'),
    *(
        (name, f'{OURS}/srv/GetMesh', name.partition('/')[0], 'the tissue as this node knows it')
        for name in ros.MESH_KEEPERS
    ),
    (ros.CUT, f'{OURS}/srv/Cut', 'cutting', 'sweep the blade; `tissue_sim` calls it'),
    (f'{ros.ARM}/operating_state', f'{OURS}/srv/TriggerOperatingState', 'arm', 'CRTK state'),
    (f'{BRIDGE}/operating_state', f'{OURS}/srv/TriggerOperatingState', BRIDGE, 'CRTK state'),
    ('NODE/change_state', 'lifecycle_msgs/srv/ChangeState', 'every node', 'its life cycle'),
    ('NODE/get_state', 'lifecycle_msgs/srv/GetState', 'every node', 'where in it the node is'),
)


def reference() -> str:
    """All tables."""
    parts = ['## Topics\n', '| topic | type | QoS | from | when | frame | what |', '|---' * 7 + '|']
    for t in TOPICS:
        frame = f'`{t.frame}`' if t.frame else ''
        cells = (f'`{t.name}`', f'`{t.type}`', describe(t.qos), f'{t.by}', t.when, frame, t.what)
        parts.append(f'| {" | ".join(cells)} |')
    parts += ['\n## Services\n', '| service | type | from | what |', '|---' * 4 + '|']
    parts += [f'| `{name}` | `{kind}` | {by} | {what} |' for name, kind, by, what in SERVICES]
    parts.append('')
    for file in interface_files():
        parts.append(_interface(file))
    return '\n'.join(parts)


def describe(qos: QoSProfile) -> str:
    """A profile in words."""
    latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return f'reliable, {"transient local, " if latched else ""}keep last {qos.depth}'


def interface_files() -> list[Path]:
    """Messages and services of ours, by name."""
    folder = PACKAGES / 'msg_defs'
    return [*sorted(folder.glob('msg/*.msg')), *sorted(folder.glob('srv/*.srv'))]


def _interface(file: Path) -> str:
    """One message or service: what it is for, its fields, its constants."""
    about: list[str] = []
    rows: list[str] = []
    for text in file.read_text(encoding='utf-8').splitlines():
        line = text.strip()
        constant, field = _CONSTANT.match(line), _FIELD.match(line)
        if line == '---':
            rows.append('| **response** | | |')
        elif constant:
            rows.append(f'| `{constant[1]}` | constant | {_cell(constant[2])} |')
        elif field:
            rows.append(f'| `{field[2]}` | `{field[1]}` | {_cell(field[3])} |')
        elif line.startswith('#') and not rows:
            about.append(line.lstrip('# '))
    table = '\n'.join(['| field | type | meaning |', '|---|---|---|', *rows])
    return f'## {file.suffix[1:]}/{file.stem}\n\n{" ".join(about)}\n\n{table}\n'


def _cell(text: str | None) -> str:
    return (text or '').replace('|', '\\|').replace('<', '&lt;')


def main() -> None:
    """Writes the tables into the file."""
    head = FILE.read_text(encoding='utf-8').partition(MARK)[0]
    FILE.write_text(f'{head}{MARK}\n{reference()}', encoding='utf-8')


if __name__ == '__main__':
    main()
