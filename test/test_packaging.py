"""The repository as a ROS package, a Python package, and a set of pins."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import types
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from session.graph import MODULES, PROFILES, RANGE, node_environment, session_nodes
from tissue_sim.share import is_checkout, share_folder

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('tissue_sim', 'haptic_bridge', 'cutting', 'bags', 'viewer', 'session')
PUBLISHED_AS = {
    '_pytest': 'pytest',
    'mpl_toolkits': 'matplotlib',
    'pydantic_core': 'pydantic',
    'ruamel': 'ruamel.yaml',
    'skfem': 'scikit-fem',
    'yaml': 'pyyaml',
}
NOT_FROM_PYPI = {
    'ament_index_python',
    'builtin_interfaces',
    'crtk_msgs',
    'cutting_trainer_msgs',
    'diagnostic_msgs',
    'geometry_msgs',
    'launch',
    'launch_ros',
    'lifecycle_msgs',
    'omni_msgs',
    'rcl_interfaces',
    'rclpy',
    'rosidl_adapter',
    'rosidl_parser',
    'rosidl_pycommon',
    'rosidl_runtime_py',
    'sensor_msgs',
    'service_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_msgs',
    'visualization_msgs',
}


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text().splitlines()
    entries = [re.sub(r'\[.*?]', '', line).lower() for line in lines if line[:1] not in ('', '#')]
    assert all(entry.count('==') == 1 for entry in entries), entries
    return dict(entry.split('==') for entry in entries)


COMPILED = shutil.ignore_patterns('__pycache__', 'sessions')
LISTS = (
    'requirements.txt',
    'requirements-ros.txt',
    'requirements-mesh.txt',
    'requirements-test.txt',
)


@pytest.mark.parametrize('name', LISTS)
def test_every_pin_is_locked_to_the_same_version_and_has_its_reason(name: str) -> None:
    locked = pins('requirements-lock.txt')
    reasons = (ROOT / 'docs' / 'dependencies.md').read_text().lower()
    for package, version in pins(name).items():
        assert locked[package] == version
        assert f'`{package}`' in reasons, f'{package} has no reason in docs/dependencies.md'


def imported_by(folder: str) -> set[str]:
    """Names on PyPI of what the modules of a folder import."""
    imported: set[str] = set()
    ours = {path.stem for path in (ROOT / folder).rglob('*.py')}
    for path in (ROOT / folder).rglob('*.py'):
        if path.name == 'make_organ.py':
            continue  # a recipe, run in an environment of its own
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.split('.')[0])
    others = imported - sys.stdlib_module_names - {*PACKAGES, 'bench', *ours} - NOT_FROM_PYPI
    return {PUBLISHED_AS.get(name, name) for name in others}


@pytest.mark.parametrize('package', PACKAGES)
def test_every_library_that_a_package_imports_is_pinned_for_run_time(package: str) -> None:
    # the mesher is an extra: it has no wheels for every machine
    extra = {'pytetwild'} if package == 'session' else set()
    assert imported_by(package) <= pins('requirements.txt').keys() | extra


def test_every_library_that_the_tests_import_is_pinned() -> None:
    assert imported_by('test') <= {*pins('requirements.txt'), *pins('requirements-test.txt')}


def test_all_manifests_say_the_same_version() -> None:
    versions = {
        ElementTree.parse(ROOT / path).findtext('version')
        for path in ('package.xml', 'msg_defs/package.xml')
    }
    setup = re.search(r"version='(.*)'", (ROOT / 'setup.py').read_text())
    assert setup
    assert versions == {setup[1]}
    assert f'\n{setup[1]} (' in (ROOT / 'CHANGELOG.rst').read_text()


def test_every_ros_package_that_is_imported_is_declared() -> None:
    declared = {
        element.text
        for element in ElementTree.parse(ROOT / 'package.xml').getroot()
        if element.tag.endswith('depend')
    }
    text = ''.join(path.read_text() for name in PACKAGES for path in (ROOT / name).rglob('*.py'))
    # crtk_msgs and omni_msgs are used where they are installed;
    # cutting_trainer_msgs is part of this package
    optional = {'crtk_msgs', 'cutting_trainer_msgs', 'omni_msgs'}
    for package in NOT_FROM_PYPI - optional:
        if re.search(rf'^\s*(from|import) {package}\b', text, re.MULTILINE):
            assert package in declared


WITHOUT_ROS = """
import importlib, sys
class Nowhere:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in sys.argv[1].split():
            raise ImportError(f'{name} is imported')
sys.meta_path.insert(0, Nowhere())
for name in sys.argv[2:]:
    importlib.import_module(name)
"""
CORE = (
    'tissue_sim.assembly',
    'tissue_sim.replica',
    'cutting.methods',
    'haptic_bridge.force_path',
    'haptic_bridge.arm',
    'bags.comparison',
    'session.in_process',
    'session.recordings.resimulate',
    'session.trials.chaos_verdict',
)


def test_the_core_needs_no_ros() -> None:
    command = [sys.executable, '-c', WITHOUT_ROS, ' '.join(NOT_FROM_PYPI), *CORE]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_workflow_and_hooks_run_what_the_readme_says() -> None:
    assert './trainer test' in (ROOT / '.ci' / 'run').read_text().splitlines()
    workflow = yaml.safe_load((ROOT / '.github' / 'workflows' / 'ci.yml').read_text())
    ran = [step.get('run', '') for job in workflow['jobs'].values() for step in job['steps']]
    assert any('bash .ci/run' in command for command in ran)
    hooks = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text())['repos'][0]['hooks']
    assert {'ruff-check', 'ruff-format', 'mypy', 'test'} == {hook['id'] for hook in hooks}
    tomllib.loads((ROOT / 'pyproject.toml').read_text())


# The launch file, with launch and launch_ros (not among the wheels) replaced by what records calls.


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
    monkeypatch.delitem(sys.modules, 'session.launching', raising=False)
    namespace: dict[str, Any] = {'__name__': f'{name}_launch'}
    path = ROOT / 'launch' / f'{name}.launch.py'
    exec(compile(path.read_text(), str(path), 'exec'), namespace)
    (entities,) = namespace['generate_launch_description']().args
    sys.modules.pop('session.launching', None)  # its classes are those recorders
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
        (ROOT / path).read_text() for path in ('haptic_bridge/node.py', 'haptic_bridge/crtk.py')
    )
    named = set(re.findall(r"\{(?:ros\.ARM|name)\}/(\w+)'", text)) - {'state_command'}
    assert {'measured_cp', 'servo_cf', 'operating_state', 'button'} <= named
    assert {f'arm/{topic}' for topic in named} <= remapped


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

    from session.cli import app

    shown = CliRunner().invoke(app, ['replay', '--help'], env={'COLUMNS': '200'}).output
    for process in of_kind(launch_description(monkeypatch, name), 'ExecuteProcess'):
        for word in process.kwargs['cmd'][2:]:
            assert not isinstance(word, str) or word in shown


# Where data lie.


def test_checkout_has_its_data_beside_the_packages() -> None:
    assert share_folder() == ROOT
    assert is_checkout()


@pytest.mark.parametrize('site', ['lib/python3.12/site-packages', 'local/lib/x/dist-packages'])
def test_installation_has_its_data_in_share_whatever_else_is_sourced(
    site: str, tmp_path: Path
) -> None:
    share = tmp_path / 'share' / 'cutting_trainer'
    (share / 'config').mkdir(parents=True)
    assert share_folder(tmp_path / site) == share


def test_packages_without_data_anywhere_look_beside_themselves(tmp_path: Path) -> None:
    assert share_folder(tmp_path / 'lib') == tmp_path / 'lib'


def test_installed_trainer_finds_scenes_devices_and_profiles(tmp_path: Path) -> None:
    site = tmp_path / 'lib' / 'python3.12' / 'site-packages'
    for package in PACKAGES:
        shutil.copytree(ROOT / package, site / package, ignore=COMPILED)
    share = tmp_path / 'share' / 'cutting_trainer'
    shutil.copytree(ROOT / 'config', share / 'config')
    code = (
        'from session import demo, graph, scene\n'
        'from pathlib import Path\n'
        'print(scene.load_scene("liver").path)\n'
        'print(graph.node_environment(0)["FASTRTPS_DEFAULT_PROFILES_FILE"])\n'
        'print(demo.SESSIONS.resolve())\n'
    )
    environ = os.environ | {'PYTHONPATH': str(site)}
    for variable in (RANGE, PROFILES):
        environ.pop(variable, None)
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=tmp_path,
        env=environ,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [
        str(share / 'config' / 'scenes' / 'liver.yaml'),
        str(share / 'config' / 'dds' / 'localhost.xml'),
        str(tmp_path / 'bags' / 'sessions'),
    ]


# A workspace as anybody's.


@pytest.mark.slow
def test_plain_colcon_build_of_a_clone_in_a_workspace_gives_both_packages(tmp_path: Path) -> None:
    colcon = shutil.which('colcon')
    if colcon is None:
        pytest.skip('colcon is not installed: with a sourced Jazzy, apt install ros-dev-tools')
    clone = tmp_path / 'src' / 'cutting_trainer'
    made = ('.trainer', '.git', '__pycache__', '.mypy_cache', 'sessions', 'build', 'install')
    shutil.copytree(ROOT, clone, ignore=shutil.ignore_patterns(*made))
    ours = str(ROOT)
    environ = {key: value for key, value in os.environ.items() if not key.startswith('PYTHON')}
    prefixes = environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    kept = [p for p in prefixes if not Path(p, 'share', 'cutting_trainer_msgs').exists()]
    environ['AMENT_PREFIX_PATH'] = environ['CMAKE_PREFIX_PATH'] = os.pathsep.join(kept)

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert run(colcon, 'list').split() == [
        'cutting_trainer',
        'src/cutting_trainer',
        '(ros.ament_cmake)',
    ]
    run(colcon, 'build')
    script = (
        'import bags, cutting, haptic_bridge, session, tissue_sim, viewer\n'
        'from cutting_trainer_msgs.msg import Mesh\n'
        'from cutting_trainer_msgs.srv import Cut\n'
        'print(tissue_sim.__file__, Mesh.CUT, Cut.Request.ADVANCE)\n'
    )
    sourced = f'. install/setup.sh && exec {sys.executable} -'
    shell = subprocess.run(
        ['sh', '-c', sourced],
        input=script,
        cwd=tmp_path,
        env=environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert shell.returncode == 0, shell.stderr
    where, *constants = shell.stdout.split()
    assert where.startswith(str(tmp_path / 'install'))
    assert not where.startswith(ours)
    assert constants == ['1', '0']
    share = tmp_path / 'install' / 'cutting_trainer' / 'share'
    for package in ('cutting_trainer', 'cutting_trainer_msgs'):
        assert (share / 'ament_index' / 'resource_index' / 'packages' / package).is_file()
    assert (share / 'cutting_trainer' / 'launch' / 'trainer.launch.py').is_file()
    assert list((share / 'cutting_trainer' / 'config' / 'scenes').glob('*.yaml'))
    programs = tmp_path / 'install' / 'cutting_trainer' / 'lib' / 'cutting_trainer'
    assert {path.name for path in programs.iterdir()} == {*MODULES, 'omni_adapter', 'trainer'}
    assert all(os.access(path, os.X_OK) for path in programs.iterdir())
