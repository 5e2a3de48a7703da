"""What docs/topics.md and docs/integrate.md say, as they say it."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live import free_domain
from rclpy.qos import QoSProfile
from test_docs import made

from bench.reference import topics as topic_reference
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import WrenchStampedCodec
from cutting_trainer.session.node_commands import (
    BRIDGE_NODE,
    CUTTING_NODE,
    TISSUE_NODE,
    node_command,
    node_environment,
)
from cutting_trainer.session.supervisor import Supervisor

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / 'docs' / 'integrate.md').read_text(encoding='utf-8')
PRESS, LARGEST = re.findall(r'```python\n(.*?)```', PAGE, re.DOTALL)
SAMPLES = ROOT / 'bags' / 'samples'


# Topics.

LIFE = {('NODE/change_state', 'ChangeState'), ('NODE/get_state', 'GetState')}
"""Services that rclpy makes."""


def test_reference_of_topics_is_that_of_the_interfaces() -> None:
    text = topic_reference.FILE.read_text(encoding='utf-8')
    tables = text.partition(topic_reference.MARK)[2].strip()
    renew = 'run `python -m bench.reference.topics`'
    assert tables == topic_reference.reference().strip(), renew


def test_reference_names_every_topic_and_service_that_the_nodes_make() -> None:
    types = {(t.name, t.type) for t in topic_reference.TOPICS}
    types |= {(name, kind) for name, kind, _, _ in topic_reference.SERVICES}
    short = {(name.lstrip('/'), kind.rpartition('/')[2]) for name, kind in types}
    # the query of the state has the topic's name, and is counted once there
    assert short - {(n, k) for n, k in short if k == 'TriggerOperatingState'} == made() | LIFE
    for _, kind in types:
        package, folder, name = kind.split('/')
        assert hasattr(importlib.import_module(f'{package}.{folder}'), name)


def test_every_interface_has_a_section_that_shows_its_file() -> None:
    text = topic_reference.reference()
    for file in topic_reference.interface_files():
        kind = file.suffix[1:]
        section = text.partition(f'\n## {kind}/{file.stem}\n')[2].partition('\n## ')[0]
        assert f'--8<-- "msg_defs/{kind}/{file.name}"' in section


def offered() -> dict[str, QoSProfile]:
    """QoS of what the nodes publish, by topic, from the sources."""
    found = {}
    folders = ('node_common', 'tissue_sim', 'haptic_bridge')
    nodes = [path for folder in folders for path in (ROOT / folder).rglob('*.py')]
    others = ('viewer/node.py', 'viewer/operator_commands.py', 'cutting/node.py')
    for path in [*nodes, *(ROOT / name for name in others)]:
        if path.name in ('probe_node.py', 'omni_node.py'):
            continue
        for call in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if getattr(getattr(call, 'func', None), 'attr', '') == 'create_publisher':
                assert isinstance(call, ast.Call)
                _, topic, profile = map(ast.unparse, call.args[:3])
                if path.parent.name == 'viewer' and 'command' in topic:
                    continue  # to others, in the types that they have
                for owner in (ros.ARM, 'haptic_bridge') if 'name' in topic else ('',):
                    device = DeviceSettings(profile='emulated')
                    scope = {
                        'ros': ros,
                        'qos': qos,
                        'name': owner,
                        'device': device,
                        'self': SimpleNamespace(_prefix=''),
                        **vars(ros),
                        **vars(qos),
                    }
                    scope['BRIDGE'] = 'haptic_bridge'
                    found[eval(topic, scope)] = eval(profile, scope)
    return found


def test_reference_says_the_qos_that_is_offered() -> None:
    told = {t.name: t.qos for t in topic_reference.TOPICS}
    of_others = ('/state_command', '/clutch', '/jaw/measured_js')
    asked_for = {name for name in told if name.endswith(of_others)}
    seen = offered()
    assert told.keys() - asked_for <= seen.keys()
    for name in told.keys() - asked_for:
        assert topic_reference.describe(told[name]) == topic_reference.describe(seen[name]), name


# The examples.


def test_example_that_reads_a_bag_finds_the_largest_force(tmp_path: Path) -> None:
    folder = SAMPLES / 'format_7' / 'straight_cut'
    script = tmp_path / 'largest_force.py'
    script.write_text(LARGEST)
    done = subprocess.run(
        [sys.executable, '-I', str(script), str(folder)], capture_output=True, text=True, check=True
    )
    codec = WrenchStampedCodec()
    forces = [
        np.linalg.norm(codec.decode(m.data).values[:3])
        for m in open_bag(folder).messages(['/arm/servo_cf'])
    ]
    assert done.stdout.startswith(f'{max(forces):.3f} N after')
    assert max(forces) > 0.1


@pytest.mark.thorough
def test_example_that_drives_the_tool_presses_and_follows_the_mesh(tmp_path: Path) -> None:
    assert len(PRESS.splitlines()) <= 60
    script = tmp_path / 'press.py'
    script.write_text(PRESS)
    scene = {'scene': str(SAMPLES / 'palpation.yaml')}
    nodes = [
        node_command(BRIDGE_NODE, scene | {'auto_enable': True}),
        node_command(TISSUE_NODE, scene),
        node_command(CUTTING_NODE, scene),
    ]
    environment = node_environment(free_domain())
    with Supervisor(nodes, tmp_path / 'log', environment, lambda event: None) as supervisor:
        assert supervisor.start()
        done = subprocess.run(
            [sys.executable, str(script)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        outcome = supervisor.end()
    assert done.returncode == 0, done.stderr
    assert not outcome.deaths
    said = re.fullmatch(r'revision (\d+): ([\d.]+) mm deep, ([\d.]+) N\n', done.stdout)
    assert said, done.stdout
    revision, deep, force = map(float, said.groups())
    assert revision > 10
    assert 0.2 < deep < 13.5  # it goes 7.5 mm below where it touches, and the proxy holds it
    assert force > 0.02
