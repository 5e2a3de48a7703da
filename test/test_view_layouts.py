"""Claims about the layouts for RViz and Foxglove: what they name is there, of the type they need.

Neither program is needed: names, types, QoS and frames are those of the generated table of topics,
fields those of the message classes.
"""

import json
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from ruamel.yaml import YAML

from bench.reference.topics import TOPICS, Topic
from cutting_trainer.node_common.ros import FRAME
from cutting_trainer.viewer.tf_frames import DEVICE_FRAME

CONFIG = Path(__file__).resolve().parents[1] / 'config'
PUBLISHED = {f'/{topic.name.lstrip("/")}': topic for topic in TOPICS}
FRAMES = {FRAME, DEVICE_FRAME}
DISPLAYS = {
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'Pose': 'geometry_msgs/msg/PoseStamped',
}
"""RViz's classes of displays in use, and what each of them subscribes to."""
DRAWN = {'visualization_msgs/msg/MarkerArray', 'geometry_msgs/msg/PoseStamped'}
"""Of the types of the trainer's topics, those that Foxglove's 3D panel draws."""
MARKERS = {'tissue', 'cut', 'tool', 'proxy', 'force'}


@pytest.fixture(scope='module')
def rviz() -> Any:
    return YAML(typ='safe').load(CONFIG / 'rviz' / 'trainer.rviz')


@pytest.fixture(scope='module')
def foxglove() -> Any:
    return json.loads((CONFIG / 'foxglove' / 'trainer.json').read_text())


def displays(rviz: Any) -> list[tuple[str, Any]]:
    """Kind and settings of each."""
    every = rviz['Visualization Manager']['Displays']
    assert all(display['Class'].startswith('rviz_default_plugins/') for display in every)
    return [(display['Class'].partition('/')[2], display) for display in every]


def test_rviz_shows_topics_that_there_are_by_displays_of_their_type(rviz: Any) -> None:
    for kind, display in displays(rviz):
        if 'Topic' in display:
            assert PUBLISHED[display['Topic']['Value']].type == DISPLAYS[kind]
        else:
            assert kind in ('Grid', 'TF')


def test_rviz_asks_for_no_more_than_is_offered(rviz: Any) -> None:
    for _, display in displays(rviz):
        if 'Topic' in display:
            asked, offered = display['Topic'], PUBLISHED[display['Topic']['Value']].qos
            if asked['Reliability Policy'] == 'Reliable':
                assert offered.reliability == ReliabilityPolicy.RELIABLE
            if asked['Durability Policy'] == 'Transient Local':
                assert offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert asked['History Policy'] == 'Keep Last' and asked['Depth'] > 0


def test_rviz_is_in_frames_that_there_are_and_shows_every_marker(rviz: Any) -> None:
    manager = rviz['Visualization Manager']
    view = manager['Views']['Current']
    named = {manager['Global Options']['Fixed Frame'], view['Target Frame']}
    for kind, display in displays(rviz):
        named |= {display['Reference Frame']} if 'Reference Frame' in display else set()
        if kind == 'MarkerArray':
            assert set(display['Namespaces']) == MARKERS
            assert all(display['Namespaces'].values())
    assert named <= FRAMES
    # Markers are in the fixed frame: they are seen without any transform.
    assert manager['Global Options']['Fixed Frame'] == FRAME


def panels(foxglove: Any, kind: str) -> list[Any]:
    return [panel for name, panel in foxglove['configById'].items() if name.startswith(f'{kind}!')]


def leaves(node: Any) -> list[str]:
    """Panels of a layout tree, of which each part has one direction and two halves."""
    if isinstance(node, str):
        return [node]
    assert node['direction'] in ('row', 'column')
    assert 0 < node.get('splitPercentage', 50) < 100
    return leaves(node['first']) + leaves(node['second'])


def test_foxglove_places_every_panel_that_it_configures_once(foxglove: Any) -> None:
    assert set(foxglove) == {
        'configById',
        'globalVariables',
        'userNodes',
        'playbackConfig',
        'layout',
    }
    assert sorted(leaves(foxglove['layout'])) == sorted(foxglove['configById'])
    kinds = {name.partition('!')[0] for name in foxglove['configById']}
    assert kinds == {'3D', 'Plot', 'DiagnosticSummary'}


def test_foxglove_draws_topics_that_there_are_in_frames_that_there_are(foxglove: Any) -> None:
    (scene,) = panels(foxglove, '3D')
    assert scene['followTf'] in FRAMES
    for name in scene['topics']:
        assert PUBLISHED[name].type in DRAWN
    for name in scene['transforms']:
        assert name.removeprefix('frame:') in FRAMES
    for layer in scene['layers'].values():
        assert layer['frameId'] in FRAMES
    (summary,) = panels(foxglove, 'DiagnosticSummary')
    assert PUBLISHED[summary['topicToRender']].type == 'diagnostic_msgs/msg/DiagnosticArray'


def number_at(topic: Topic, path: str) -> bool:
    """Whether a message path leads to a number, by the fields of the message classes."""
    kind = topic.type
    for step in re.findall(r'[^.]+', path):
        package, _, name = kind.split('/')
        fields = getattr(import_module(f'{package}.msg'), name).get_fields_and_field_types()
        wanted, index = re.fullmatch(r'(\w+)(?:\[(\d+)\])?', step).groups()  # type: ignore[union-attr]
        kind = fields[wanted]
        if index is not None:
            base, length = re.fullmatch(r'(\w+)\[(\d+)\]', kind).groups()  # type: ignore[union-attr]
            assert int(index) < int(length)
            kind = base
        kind = kind if '/' not in kind else kind.replace('/', '/msg/')
    return kind in ('double', 'float')


def test_foxglove_plots_numbers_of_messages_that_there_are(foxglove: Any) -> None:
    paths = [path['value'] for panel in panels(foxglove, 'Plot') for path in panel['paths']]
    assert len(paths) == 6
    for path in paths:
        topic, _, rest = path.partition('.')
        assert number_at(PUBLISHED[topic], rest), path
