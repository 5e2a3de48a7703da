"""Claims about a scene with several tools: its section, its processes, its bag."""

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cutting_trainer.bags.comparison import Comparison
from cutting_trainer.bags.recorded_frames import FrameRecord, ToolRecord
from cutting_trainer.bags.resimulation import lacking_contact
from cutting_trainer.bags.topic_names import further_tools
from cutting_trainer.haptic_bridge import e_stop_topic
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, ToolSettings
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.operating_state import OperatingStateMachine
from cutting_trainer.node_common.ros import FORCE, FRAME_INPUTS
from cutting_trainer.node_common.scene_reader import read_section, tool_names
from cutting_trainer.recordings import resimulate_command
from cutting_trainer.session.e_stop_memory import PRESSED, RELEASED, EStopState
from cutting_trainer.session.node_commands import (
    ARM_NODE,
    BRIDGE_NODE,
    session_nodes,
    simulation_nodes,
)
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.streaming.tool_topics import ToolTopics

SCENE = """\
tool: {radius: 0.004, coupling_stiffness: 300}
device: {profile: emulated}
"""
GRASPER = 'tools:\n  grasper:\n    tool: {mode: open_grasper}\n'


def write(folder: Path, text: str) -> Path:
    path = folder / 'scene.yaml'
    path.write_text(SCENE + text, encoding='utf-8')
    return path


def test_a_further_tool_has_its_own_keys_and_else_those_of_the_first(tmp_path: Path) -> None:
    path = write(tmp_path, GRASPER)
    assert tool_names(path) == ('grasper',)
    first = read_section(path, 'tool', ToolSettings)
    other = read_section(path, 'tool', ToolSettings, 'grasper')
    assert first.mode == 'scalpel'
    assert other == first.model_copy(update={'mode': 'open_grasper'})
    assert read_section(path, 'device', DeviceSettings, 'grasper') == DeviceSettings()


def test_a_scene_without_further_tools_has_none(tmp_path: Path) -> None:
    assert tool_names(write(tmp_path, '')) == tool_names(write(tmp_path, 'tools:\n')) == ()


@pytest.mark.parametrize(
    ('text', 'line', 'said'),
    [
        ('tools: [grasper]\n', 3, 'section tools is a list'),
        ('tools: {Grasper: {}}\n', 3, "has 'Grasper': a tool is named by a ROS namespace"),
        ('tools: {a/b: {}}\n', 3, "has 'a/b': a tool is named by a ROS namespace"),
        ('tools: {tissue: {}}\n', 3, 'tools.tissue: a topic or node has this name'),
        ('tools: {grasper: 4}\n', 3, 'tools.grasper is a single value'),
        ('tools: {grasper: {tol: {}}}\n', 3, 'not a section of a tool: did you mean tool?'),
        ('tools: {grasper: {tissue: {}}}\n', 3, 'known are tool, device, haptics, arm'),
        ('tools: {grasper: {tool: [1]}}\n', 3, 'tools.grasper.tool is a list'),
        ('tools: {a: {}, b: {}, c: {}, d: {}}\n', 3, 'has 4 further tools: at most 3'),
        ('tools: {a: {}, a: {}}\n', 3, 'tools.a is given twice'),
        ('tols: {a: {}}\n', 3, 'tols is not a section: did you mean tools?'),
    ],
)
def test_a_bad_section_gives_one_sentence(tmp_path: Path, text: str, line: int, said: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(SceneError) as error:
        tool_names(path)
    sentence = str(error.value)
    assert sentence.startswith(f'{path}:{line}: ')
    assert said in sentence
    assert '\n' not in sentence


def test_a_bad_key_of_a_further_tool_is_found_in_its_own_line(tmp_path: Path) -> None:
    path = write(tmp_path, GRASPER + '    device: {profil: touch}\n')
    with pytest.raises(SceneError, match=r'scene.yaml:6: device\.profil .*did you mean profile'):
        read_section(path, 'device', DeviceSettings, 'grasper')
    with pytest.raises(SceneError, match=r"tools has no 'saw': known are grasper"):
        read_section(path, 'tool', ToolSettings, 'saw')


def test_the_shipped_scene_has_a_scalpel_and_a_grasper() -> None:
    scene = load_scene('two_tools')
    assert [(tool.label, tool.tool.mode) for tool in scene.tools] == [
        ('', 'scalpel'),
        ('grasper', 'open_grasper'),
    ]
    script = scene.others[0].arm.require_script()
    presses = [phase.button for phase in script.phases]
    assert presses.count(True) == 2  # the jaws close, and open again


def test_each_further_tool_has_arm_and_bridge_in_its_namespace() -> None:
    nodes = session_nodes(Path('/scene.yaml'), Path('/bag'), 3, 20.0, ['grasper'])
    by_name = {node.name: node for node in nodes}
    assert len(by_name) == 7
    for name in (ARM_NODE, BRIDGE_NODE):
        words = by_name[f'grasper/{name}'].argv
        assert '__ns:=/grasper' in words
        assert 'tool:="grasper"' in words
    bridge = by_name[f'grasper/{BRIDGE_NODE}']
    assert {'tissue/mesh:=/tissue/mesh', 'haptic_bridge/e_stop:=/haptic_bridge/e_stop'} <= set(
        bridge.argv
    )
    assert 'accepted_publishers:="/grasper/emulated_arm,/tissue_sim"' in bridge.argv
    assert bridge.restart_arguments
    assert bridge.e_stop_arguments
    alone = session_nodes(Path('/scene.yaml'), Path('/bag'), 3, 20.0)
    assert alone == [node for node in nodes if '/' not in node.name]
    guided = simulation_nodes(Path('/scene.yaml'), 0, Path('/x'), ['grasper'])
    assert {node.name for node in guided} == set(by_name) - {'recorder'}


def test_a_press_is_owed_until_every_bridge_says_that_it_holds() -> None:
    nodes = session_nodes(Path('/scene.yaml'), Path('/bag'), 0, 20.0, ['grasper'])
    first, other = (
        next(node for node in nodes if node.name == name)
        for name in (BRIDGE_NODE, f'grasper/{BRIDGE_NODE}')
    )
    state = EStopState(nodes, keys=False)
    state.ask()
    assert state.interpret(first, PRESSED)
    assert state.is_owed
    state.interpret(other, RELEASED)  # said before it received the request
    assert state.is_owed
    state.interpret(other, PRESSED)
    assert not state.is_owed
    # One that is reset does not release the other: if that dies, it starts pressed.
    state.interpret(first, RELEASED)
    assert state.pressed
    assert state.start_command(first) == first
    assert state.start_command(other).argv == (*other.argv, *other.e_stop_arguments)
    state.watch([node for node in nodes if node.name != other.name])
    assert not state.pressed


def test_a_bridge_that_is_pressed_presses_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    monkeypatch.setattr(e_stop_topic.output, 'announce', lambda line: None)
    monkeypatch.setattr(e_stop_topic.ros, 'polled', lambda *_: None)
    monkeypatch.setattr(e_stop_topic.ros, 'take_raw', lambda _: None)
    monkeypatch.setattr(e_stop_topic.ros, 'introspect', lambda *_: None)
    node: Any = SimpleNamespace(
        create_publisher=lambda kind, topic, _: SimpleNamespace(
            publish=lambda message: sent.append(topic)
        ),
        create_service=lambda *_: None,
    )
    for passes_on in (True, False):
        machine = OperatingStateMachine()
        latch = e_stop_topic.EStop(node, machine, button=-1, passes_on=passes_on)
        sent.clear()
        machine.press()
        for _ in range(3):
            latch.poll(1)
        assert sent.count('haptic_bridge/e_stop') == passes_on


def test_further_tools_of_a_bag_are_those_beside_a_first_one() -> None:
    inputs = '/tissue/frame_inputs'
    assert further_tools([inputs, f'/grasper{inputs}', '/tool/contact']) == ['/grasper']
    assert further_tools([f'/left{inputs}', f'/right{inputs}']) == []


def test_a_frame_cannot_be_computed_without_the_contact_of_each_tool() -> None:
    def record(*others: ToolRecord | None) -> FrameRecord:
        return FrameRecord(1, 0, False, None, None, 0, 0, 1, False, None, others)

    absent, lost = ToolRecord(False, None, None, None), ToolRecord(True, None, None, None)
    assert not lacking_contact(record())
    assert not lacking_contact(record(absent))
    assert lacking_contact(record(lost)) == (
        'the bag lacks the contact of tool 1 that loaded this frame'
    )
    assert lacking_contact(record(None)) == 'the bag lacks the inputs of tool 1'


def test_what_a_bag_lacks_is_in_the_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = Comparison(frames=3, missing=Counter({'poses of the device': 2}))
    for name in ('find_beginning', 'recomputation', 'pose_check', 'recorded_code'):
        monkeypatch.setattr(resimulate_command, name, lambda *_: None)
    monkeypatch.setattr(resimulate_command, 'compare', lambda *_: result)
    bag: Any = SimpleNamespace(custom_data={})
    resimulate_command._verify(bag, cast('Any', None), as_json=True)
    assert json.loads(capsys.readouterr().out)['missing'] == {'poses of the device': 2}


@pytest.mark.parametrize(('inputs', 'forces'), [(1, 0), (0, 1), (1, 1)])
def test_a_tool_is_recorded_once_inputs_and_forces_have_a_listener(
    inputs: int, forces: int
) -> None:
    """Both are made before the tissue is set up; a recorder may find one before the other."""
    counts = {FRAME_INPUTS: inputs, FORCE: forces}

    def publisher(kind: object, topic: str, qos: object) -> SimpleNamespace:
        return SimpleNamespace(get_subscription_count=lambda: counts[topic])

    tool = ToolTopics(cast(ManagedNode, SimpleNamespace(create_publisher=publisher)), 0, '')
    assert tool.is_recorded is bool(inputs and forces)
