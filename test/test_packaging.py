"""The repository as a ROS package, a Python package, and a set of pins."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from cutting_trainer.node_common.share_folder import is_checkout, share_folder
from cutting_trainer.session.domain import RANGE
from cutting_trainer.session.node_commands import MODULES, PROFILES

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
ROOMS = tuple(
    sorted(path.name for path in (ROOT / 'cutting_trainer').iterdir() if path.is_symlink())
)
PUBLISHED_AS = {
    'PIL': 'pillow',
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
    lines = [line for line in (ROOT / name).read_text().splitlines() if line[:1] not in ('', '#')]
    entries = [line.split()[0].lower() for line in lines if not line.startswith(' ')]
    assert all(entry.count('==') == 1 for entry in entries), entries
    pinned = (re.sub(r'\[.*?]', '', entry).split('==') for entry in entries)
    return {package.replace('ruamel-yaml', 'ruamel.yaml'): version for package, version in pinned}


MADE = (
    *('.trainer', '.git', '.mypy_cache', '.ruff_cache', '.pytest_cache', '.hypothesis'),
    *('__pycache__', 'sessions', 'build', 'install', 'node_modules'),
)
LISTS = (
    'requirements.txt',
    'requirements-ros.txt',
    'requirements-mesh.txt',
    'requirements-test.txt',
    'requirements-study.txt',
)


def test_every_file_of_the_page_is_installed_with_its_package(tmp_path: Path) -> None:
    command = [sys.executable, 'setup.py', '-q', 'build_py', '-d', str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    there, here = (
        {path.relative_to(folder) for path in (folder / 'viewer' / 'static').rglob('*')}
        for folder in (tmp_path / 'cutting_trainer', ROOT)
    )
    assert there == here


@pytest.mark.parametrize('name', LISTS)
def test_every_pin_is_locked_to_the_same_version_and_has_its_reason(name: str) -> None:
    lock = 'study-lock' if name == 'requirements-study.txt' else 'lock'
    locked = pins(f'requirements-{lock}.txt')
    reasons = (ROOT / 'docs' / 'dependencies.md').read_text().lower()
    for package, version in pins(name).items():
        assert locked[package] == version
        assert f'`{package}`' in reasons, f'{package} has no reason in docs/dependencies.md'


def test_packages_of_studies_have_the_versions_of_all_others() -> None:
    shared, studies = pins('requirements-lock.txt'), pins('requirements-study-lock.txt')
    assert all(shared.get(name, version) == version for name, version in studies.items())


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
    others = (
        imported - sys.stdlib_module_names - {'cutting_trainer', 'bench', *ours} - NOT_FROM_PYPI
    )
    return {PUBLISHED_AS.get(name, name) for name in others}


@pytest.mark.parametrize('room', ROOMS)
def test_every_library_that_a_room_imports_is_pinned_for_run_time(room: str) -> None:
    # the mesher is an extra: it has no wheels for every machine
    # and Dask, the encoders of films and HDF5 are installed before their first use
    extra = {
        'mesh_import': {'pytetwild'},
        'studies': {'av', 'dask', 'distributed', 'fsspec', 'h5py', 'pillow', 'tornado'},
        'recordings': {'av', 'pillow'},
    }.get(room, set())
    assert imported_by(room) <= pins('requirements.txt').keys() | extra


def test_no_library_is_installed_with_the_product_that_only_the_checkout_needs() -> None:
    indirect = {'lz4', 'zstandard'}
    assert pins('requirements.txt').keys() - indirect <= set().union(*map(imported_by, ROOMS))


@pytest.mark.parametrize('folder', ['test', 'bench'])
def test_every_library_that_tests_and_measurements_import_is_pinned(folder: str) -> None:
    own_lists = {'mujoco', 'newton', 'warp', 'lerobot'}  # optional, of environments of their own
    peers = own_lists if folder == 'bench' else set()
    lists = ('requirements.txt', 'requirements-test.txt', 'requirements-study.txt')
    known = set().union(*map(pins, lists), peers)
    assert imported_by(folder) <= known


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
    text = ''.join(path.read_text() for name in ROOMS for path in (ROOT / name).rglob('*.py'))
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
    'cutting_trainer.tissue_sim.assembly',
    'cutting_trainer.tissue_sim.mesh.replica',
    'cutting_trainer.cutting.method_registry',
    'cutting_trainer.haptic_bridge.force_path',
    'cutting_trainer.haptic_bridge.emulated_arm.arm',
    'cutting_trainer.bags.comparison',
    'cutting_trainer.session.in_process',
    'cutting_trainer.recordings.resimulate_command',
    'cutting_trainer.studies.study_command',
    'bench.trials.chaos_verdict',
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


@pytest.fixture(scope='module')
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout, its links kept, where what building leaves disturbs nobody."""
    folder = tmp_path_factory.mktemp('workspace') / 'src' / 'cutting_trainer'
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*MADE), symlinks=True)
    return folder


def test_installed_trainer_finds_scenes_devices_and_profiles(clone: Path, tmp_path: Path) -> None:
    pip = [sys.executable, '-m', 'pip', 'install', '--no-deps', '--no-build-isolation']
    pip += ['--ignore-installed', '--prefix', str(tmp_path), str(clone)]
    done = subprocess.run(pip, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (site,) = tmp_path.glob('**/site-packages')
    assert {path.name for path in site.iterdir() if path.suffix != '.dist-info'} == {
        'cutting_trainer'
    }
    share = tmp_path / 'share' / 'cutting_trainer'
    code = (
        'from cutting_trainer.session import demo_command, node_commands, scene_loader\n'
        'from pathlib import Path\n'
        'print(scene_loader.load_scene("liver").path)\n'
        'print(node_commands.node_environment(0)["FASTRTPS_DEFAULT_PROFILES_FILE"])\n'
        'print(demo_command.SESSIONS.resolve())\n'
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


@pytest.mark.thorough
@pytest.mark.parametrize('options', [(), ('--symlink-install',)], ids=['copies', 'links'])
def test_plain_colcon_build_of_a_clone_in_a_workspace_gives_both_packages(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    colcon = shutil.which('colcon')
    if colcon is None:
        pytest.skip('colcon is not installed: with a sourced Jazzy, apt install ros-dev-tools')
    clone = tmp_path / 'src' / 'cutting_trainer'
    shutil.copytree(ROOT, clone, ignore=shutil.ignore_patterns(*MADE), symlinks=True)
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
    run(colcon, 'build', *options)
    script = (
        f'from cutting_trainer import {", ".join(ROOMS)}\n'
        'from cutting_trainer.node_common import share_folder\n'
        'from cutting_trainer_msgs.msg import Mesh\n'
        'from cutting_trainer_msgs.srv import Cut\n'
        'print(tissue_sim.__file__, share_folder.SCENES, Mesh.CUT, Cut.Request.ADVANCE)\n'
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
    where, scenes, *constants = shell.stdout.split()
    assert where.startswith(str(tmp_path / 'install'))
    assert not where.startswith(ours)
    assert constants == ['1', '0']
    assert (Path(where).parents[1] / 'viewer' / 'static' / 'index.html').is_file()
    share = tmp_path / 'install' / 'cutting_trainer' / 'share'
    assert scenes == str(share / 'cutting_trainer' / 'config' / 'scenes')
    for package in ('cutting_trainer', 'cutting_trainer_msgs'):
        assert (share / 'ament_index' / 'resource_index' / 'packages' / package).is_file()
    assert (share / 'cutting_trainer' / 'launch' / 'trainer.launch.py').is_file()
    assert list((share / 'cutting_trainer' / 'config' / 'scenes').glob('*.yaml'))
    programs = tmp_path / 'install' / 'cutting_trainer' / 'lib' / 'cutting_trainer'
    assert {path.name for path in programs.iterdir()} == {*MODULES, 'omni_adapter', 'trainer'}
    assert all(os.access(path, os.X_OK) for path in programs.iterdir())
