"""The launch files, with launch and launch_ros (not among the wheels) replaced by what records."""

import re
import sys
import types
from pathlib import Path
from typing import Any, get_args

import pytest

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.session.domain import RANGE
from cutting_trainer.session.node_commands import (
    MODULES,
    PROFILES,
    node_environment,
    session_nodes,
)

ROOT = Path(__file__).resolve().parents[1]


class Recorded:
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


def launch_description(monkeypatch: pytest.MonkeyPatch, name: str = 'trainer') -> Any:
    modules = {
        'launch': ['LaunchDescription'],
        'launch.actions': ['DeclareLaunchArgument', 'ExecuteProcess', 'SetEnvironmentVariable'],
        'launch.conditions': ['IfCondition', 'UnlessCondition'],
        'launch.substitutions': ['LaunchConfiguration', 'PathJoinSubstitution'],
        'launch_ros': [],
        'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterValue'],
        'launch_ros.substitutions': ['FindPackagePrefix', 'FindPackageShare'],
    }
    for module_name, classes in modules.items():
        module = types.ModuleType(module_name)
        for each in classes:
            setattr(module, each, type(each, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)
    monkeypatch.delitem(sys.modules, 'cutting_trainer.session.launching', raising=False)
    namespace: dict[str, Any] = {'__name__': f'{name}_launch'}
    path = ROOT / 'launch' / f'{name}.launch.py'
    exec(compile(path.read_text(), str(path), 'exec'), namespace)
    (entities,) = namespace['generate_launch_description']().args
    sys.modules.pop('cutting_trainer.session.launching', None)  # its classes are those recorders
    return entities


def of_kind(entities: list[Any], kind: str) -> list[Any]:
    return [entity for entity in entities if type(entity).__name__ == kind]


LAUNCH_FILES = sorted(p.name.partition('.')[0] for p in (ROOT / 'launch').glob('*.launch.py'))


def test_launch_file_starts_the_nodes_of_a_session_with_the_same_parameters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entities = launch_description(monkeypatch)
    nodes = {e.kwargs['name']: e.kwargs for e in of_kind(entities, 'Node')}
    commands = session_nodes(Path('/scene.yaml'), Path('/bag'), 0, 20.0)
    assert nodes.keys() == {command.name for command in commands}
    for command in commands:
        given = {a.partition(':=')[0] for a in command.argv if ':=' in a}
        (parameters,) = nodes[command.name]['parameters']
        assert parameters.keys() == given


def test_the_bridge_finds_all_of_a_device_in_its_namespace(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (bridge,) = of_kind(launch_description(monkeypatch, 'bridge'), 'Node')
    remapped = {topic for topic, _ in bridge.kwargs['remappings']}
    text = ''.join(
        (ROOT / path).read_text() for path in ('haptic_bridge/node.py', 'node_common/crtk.py')
    )
    named = set(re.findall(r"\{(?:ros\.ARM|name)\}/(\w+)'", text)) - {'state_command'}
    assert {'measured_cp', 'operating_state', 'button'} <= named
    forces = get_args(DeviceSettings.model_fields['force_topic'].annotation)
    assert {'servo_cf', 'body/servo_cf', 'spatial/servo_cf'} == set(forces)
    assert {f'arm/{topic}' for topic in (*named, *forces)} <= remapped


@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_every_value_that_a_launch_file_uses_is_an_argument_of_it_with_a_description(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    entities = launch_description(monkeypatch, name)
    arguments = {e.args[0]: e.kwargs for e in of_kind(entities, 'DeclareLaunchArgument')}
    used = set()

    def look(value: Any) -> None:
        if type(value).__name__ == 'LaunchConfiguration':
            used.add(value.args[0])
        elif isinstance(value, Recorded):
            look([*value.args, *value.kwargs.values()])
        elif isinstance(value, dict):
            look(list(value.values()))
        elif isinstance(value, list | tuple):
            for each in value:
                look(each)

    look([e for e in entities if type(e).__name__ != 'DeclareLaunchArgument'])
    assert used == arguments.keys()
    assert all(kwargs['description'] for kwargs in arguments.values())
    for node in of_kind(entities, 'Node'):
        for value in node.kwargs['parameters'][0].values():
            assert value.kwargs['value_type'] in (str, int, float, bool)


@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_launch_file_gives_the_nodes_the_environment_of_a_session_unless_the_shell_has_another(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    for shell in ({}, {RANGE: 'SUBNET'}, {PROFILES: '/own.xml'}):
        for variable in (RANGE, PROFILES):
            monkeypatch.delenv(variable, raising=False)
        for variable, value in shell.items():
            monkeypatch.setenv(variable, value)
        entities = launch_description(monkeypatch, name)
        variables = [e.args for e in of_kind(entities, 'SetEnvironmentVariable')]
        assert dict(variables).items() <= node_environment(0).items()
        assert {variable for variable, _ in variables} == {RANGE, PROFILES}


@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_launch_file_starts_executables_that_are_installed(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    entities = launch_description(monkeypatch, name)
    cmake = (ROOT / 'CMakeLists.txt').read_text()
    installed = dict(re.findall(r'^install_executable\((\w+) ([\w.]+)\)', cmake, re.MULTILINE))
    assert of_kind(entities, 'Node') or of_kind(entities, 'ExecuteProcess')
    for entity in of_kind(entities, 'Node'):
        executable = entity.kwargs['executable']
        assert entity.kwargs['package'] == 'cutting_trainer'
        assert installed[executable] == MODULES[executable]
    for entity in of_kind(entities, 'ExecuteProcess'):
        (path,) = entity.kwargs['cmd'][0].args
        assert path[1:] == ['lib', 'cutting_trainer', 'trainer']
        assert entity.kwargs['cmd'][1] == 'replay'
    for module in installed.values():
        assert (ROOT / (module.replace('.', '/') + '.py')).is_file(), module


def test_bridge_and_simulation_side_make_one_graph_without_the_arm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sides = [launch_description(monkeypatch, name) for name in ('bridge', 'sim')]
    bridge, sim = ({e.kwargs['name'] for e in of_kind(side, 'Node')} for side in sides)
    assert not bridge & sim
    assert bridge | sim == MODULES.keys() & {'haptic_bridge', 'tissue_sim', 'cutting', 'recorder'}
    (node,) = of_kind(sides[0], 'Node')
    remapped = dict(node.kwargs['remappings'])
    assert {'arm/measured_cp', 'arm/servo_cf'} <= remapped.keys()
    device, *chosen = remapped.pop('arm/servo_cf')
    assert device.args == ('arm',) and chosen[0] == '/' and chosen[1].args == ('force_topic',)
    for before, (device, after) in remapped.items():
        assert device.args == ('arm',) and before == f'arm{after}'
    defaults = {
        e.args[0]: e.kwargs['default_value'] for e in of_kind(sides[0], 'DeclareLaunchArgument')
    }
    assert defaults['auto_enable'] == 'false'  # no force on a real arm by a start alone


def test_two_arms_share_no_name_and_one_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = of_kind(launch_description(monkeypatch, 'two_arms'), 'Node')
    names = [(node.kwargs['namespace'], node.kwargs['name']) for node in nodes]
    assert len(set(names)) == len(names) == 9
    assert [namespace for namespace, name in names if name == 'recorder'] == ['']
    for node in nodes:
        scene = node.kwargs['parameters'][0]['scene'].args[0].args[0]
        assert scene == f'{node.kwargs["namespace"] or "left"}_scene'


@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_replay_passes_options_that_the_command_has(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    from typer.testing import CliRunner

    from cutting_trainer.cli.main import app

    shown = CliRunner().invoke(app, ['replay', '--help'], env={'COLUMNS': '200'}).output
    for process in of_kind(launch_description(monkeypatch, name), 'ExecuteProcess'):
        for word in process.kwargs['cmd'][2:]:
            assert not isinstance(word, str) or word in shown
