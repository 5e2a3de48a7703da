"""The launcher: what it finds, what it says when something is missing, and what it does once."""

import ast
import fcntl
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]


def load(script: Path) -> ModuleType:
    loader = SourceFileLoader('trainer_launcher', str(script))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec
    module = importlib.util.module_from_spec(spec)
    written, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    loader.exec_module(module)
    sys.dont_write_bytecode = written
    return module


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A clone with all that the launcher itself reads."""
    for name in ('cli', 'session', 'tissue_sim', 'haptic_bridge', 'cutting', 'msg_defs'):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns('__pycache__'))
    shutil.copytree(ROOT / 'cutting_trainer', tmp_path / 'cutting_trainer', symlinks=True)
    for path in [ROOT / 'trainer', *ROOT.glob('requirements*.txt')]:
        shutil.copy(path, tmp_path)
    return tmp_path


@pytest.fixture
def launcher(tree: Path) -> Any:
    return load(tree / 'trainer')


def start(tree: Path, *arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, 'trainer', *arguments],
        cwd=tree,
        env={**os.environ, **environ},
        capture_output=True,
        text=True,
        check=False,
    )


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


def test_help_names_what_there_is_before_anything_is_set_up(tree: Path) -> None:
    done = start(tree, '--help')
    assert done.returncode == 0
    shown = {line.split()[0] for line in done.stdout.splitlines() if line[:2] == '  '}
    assert shown == {'demo', 'setup', 'overlay', 'doctor', 'bench', 'chart', 'validate', 'clean'}
    assert not (tree / '.trainer').exists()


@pytest.mark.parametrize(
    ('arguments', 'module'),
    [
        (['demo', '--scene', 'block'], ['cutting_trainer.cli', 'demo', '--scene', 'block']),
        (['bench', 'force'], ['bench', 'force']),
        (['chart', '-o', 'x'], ['bench', 'chart', '-o', 'x']),
        (['validate', 'sphere'], ['bench', 'validate', 'sphere']),
    ],
)
def test_command_goes_to_the_module_that_has_it(
    launcher: Any, monkeypatch: pytest.MonkeyPatch, arguments: list[str], module: list[str]
) -> None:
    monkeypatch.setattr(launcher, 'prepare', lambda home, command: None)
    monkeypatch.setattr(launcher.os, 'execve', lambda file, words, env: words)
    assert launcher.main(arguments)[1:] == ['-m', *module]


def test_pip_settings_are_passed_on_to_uv_and_the_environment_overrides_files(
    launcher: Any,
) -> None:
    listed = (
        ":env:.index-url='https://a.example/simple'\n:env:.no-input='1'\n"
        "global.index-url='https://b.example/simple'\nglobal.trusted-host='b.example'\n"
        "install.extra-index-url='https://c.example https://d.example'\n"
    )
    assert launcher.uv_settings(listed) == {
        'UV_DEFAULT_INDEX': 'https://a.example/simple',
        'UV_INSECURE_HOST': 'b.example',
        'UV_INDEX': 'https://c.example https://d.example',
    }


def test_lock_has_a_hash_of_every_package_and_names_no_host() -> None:
    for name in ('requirements-lock.txt', 'requirements-uv.txt'):
        text = (ROOT / name).read_text()
        pinned = re.findall(r'^[\w.-]+==.*$', text, re.MULTILINE)
        assert pinned and all(line.endswith('\\') for line in pinned)
        assert '//' not in text and '--index' not in text and '--find' not in text


def test_python_3_6_can_read_the_launcher() -> None:
    ast.parse((ROOT / 'trainer').read_text(), feature_version=(3, 6))


def test_old_python_says_which_ones_are_supported_and_what_to_do(
    launcher: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(launcher, 'found_pythons', lambda path: iter(()))
    with pytest.raises(SystemExit) as stopped:
        launcher.leave_old_python()
    assert stopped.value.code == launcher.NO_PYTHON
    said = capsys.readouterr().err
    assert 'Python 3.11, 3.12 or 3.13' in said
    assert 'apt install' in said


def test_shim_that_leads_nowhere_and_wrong_version_behind_a_name_are_passed_over(
    launcher: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shim = executable(tmp_path / 'shims' / 'python3.13', '#!/bin/sh\nexit 127\n')
    old = '#!/bin/sh\necho \'{"version": [3, 10, 2], "executable": "old"}\'\n'
    executable(tmp_path / 'old' / 'python3.12', old)
    good = '#!/bin/sh\necho \'{"version": [3, 12, 1], "executable": "good"}\'\n'
    executable(tmp_path / 'good' / 'python3.12', good)
    monkeypatch.setattr(launcher.sys, 'executable', str(shim))
    path = os.pathsep.join(str(tmp_path / name) for name in ('shims', 'old', 'missing', 'good'))
    assert [facts['executable'] for facts in launcher.found_pythons(path)] == ['good']


COMPLETE = {
    'version': [3, 12, 1],
    'executable': '/usr/bin/python3.12',
    'venv': True,
    'pip': '/usr/share/python-wheels/pip-24.0-py3-none-any.whl',
    'headers': True,
    'include': '/usr/include/python3.12',
}


@pytest.mark.parametrize(
    ('lack', 'status', 'package'),
    [('venv', 'NO_VENV', 'python3.12-venv'), ('headers', 'NO_HEADERS', 'python3.12-dev')],
)
def test_python_without_a_part_that_debian_splits_off_names_the_package(
    launcher: Any, monkeypatch: pytest.MonkeyPatch, lack: str, status: str, package: str
) -> None:
    home = launcher.find_home({})
    lacking = {**COMPLETE, lack: False}
    monkeypatch.setattr(launcher, 'found_pythons', lambda path: iter([lacking]))
    with pytest.raises(launcher.SetupError, match=package) as refused:
        launcher.choose_python(home)
    assert refused.value.status == getattr(launcher, status)
    monkeypatch.setattr(launcher, 'found_pythons', lambda path: iter([lacking, COMPLETE]))
    assert launcher.choose_python(home) == COMPLETE


def test_no_supported_python_at_all_has_its_own_status(
    launcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, 'found_pythons', lambda path: iter(()))
    with pytest.raises(launcher.SetupError, match=r'3\.11, 3\.12 or 3\.13') as refused:
        launcher.choose_python(launcher.find_home({}))
    assert refused.value.status == launcher.NO_PYTHON


@pytest.mark.parametrize(
    ('there', 'status', 'missing'),
    [
        ((), 14, 'cmake'),
        (('cmake',), 14, 'make'),
        (('cmake', 'make'), 13, r'C\+\+ compiler'),
        (('cmake', 'ninja', 'g++'), 13, 'C compiler'),
    ],
)
def test_missing_build_tool_is_named_before_anything_is_downloaded(
    launcher: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    there: tuple[str, ...],
    status: int,
    missing: str,
) -> None:
    tools = tmp_path / 'tools'
    tools.mkdir()
    for name in there:
        executable(tools / name, '#!/bin/sh\n')
    monkeypatch.setenv('PATH', str(tools))
    monkeypatch.delenv('CXX', raising=False)
    monkeypatch.delenv('CC', raising=False)
    home = launcher.find_home({})
    with pytest.raises(launcher.SetupError, match=missing) as refused:
        launcher.make_environment(home, 0)
    assert refused.value.status == status
    assert 'apt install' in str(refused.value)
    assert not home.folder.exists()


@pytest.mark.parametrize(
    ('step', 'said', 'status', 'todo'),
    [
        ('packages', 'NewConnectionError: [Errno -2]', 15, 'Connect'),
        ('packages', 'OSError: [Errno 28] No space left on device', 16, 'Make room'),
        ('interfaces', 'ninja: build stopped', 17, 'interfaces.log'),
    ],
)
def test_failed_step_shows_its_end_and_says_what_to_do(
    launcher: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    step: str,
    said: str,
    status: int,
    todo: str,
) -> None:
    log = tmp_path / f'{step}.log'
    log.write_text('first line\n' + '...\n' * 100 + said + '\n')
    error = launcher.failure(step, log, 1)
    assert error.status == status
    assert todo in str(error)
    shown = capsys.readouterr().err
    assert said in shown
    assert 'first line' not in shown


def test_too_small_a_disk_is_said_before_anything_is_downloaded(
    launcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, 'NEEDED_SPACE', 10**18)
    monkeypatch.setattr(launcher, 'check_build_tools', lambda: None)
    monkeypatch.setattr(launcher, 'choose_python', lambda home: COMPLETE)
    home = launcher.find_home({})
    with pytest.raises(launcher.SetupError, match='Make room') as refused:
        launcher.make_environment(home, 0)
    assert refused.value.status == launcher.DISK_FULL
    assert not home.folder.exists()


# Which ROS.


@pytest.fixture
def jazzy(tmp_path: Path) -> Path:
    """A prefix as /opt/ros/jazzy, as far as the launcher looks."""
    prefix = tmp_path / 'opt' / 'ros' / 'jazzy'
    executable(prefix / 'share/ament_index/resource_index/packages/rclpy', '')
    return prefix


def test_sourced_jazzy_is_used_where_the_system_python_imports_its_rclpy(
    launcher: Any, jazzy: Path, tmp_path: Path
) -> None:
    imports = executable(tmp_path / 'imports', '#!/bin/sh\nexit 0\n')
    cannot = executable(tmp_path / 'cannot', '#!/bin/sh\nexit 1\n')
    prefixes = os.pathsep.join([str(tmp_path / 'overlay'), str(jazzy)])
    sourced = {'ROS_DISTRO': 'jazzy', 'AMENT_PREFIX_PATH': prefixes}
    assert launcher.sourced_jazzy(sourced, str(imports)) == str(jazzy)
    assert launcher.sourced_jazzy(sourced, str(cannot)) is None
    assert launcher.sourced_jazzy(sourced, str(tmp_path / 'no-python')) is None
    assert launcher.sourced_jazzy({**sourced, 'ROS_DISTRO': 'humble'}, str(imports)) is None
    assert launcher.sourced_jazzy({'ROS_DISTRO': 'jazzy'}, str(imports)) is None
    assert launcher.sourced_jazzy({}, str(imports)) is None


def test_sourced_jazzy_takes_no_wheels_of_ros_and_a_home_of_its_own(
    launcher: Any, jazzy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheels = launcher.find_home({})
    monkeypatch.setattr(launcher, 'sourced_jazzy', lambda environ: str(jazzy))
    sourced = launcher.find_home({})
    assert sourced.folder != wheels.folder
    assert launcher.environment_key(sourced) != launcher.environment_key(wheels)
    names = [path.name for path in launcher.requirement_files(sourced)]
    assert 'requirements-ros.txt' not in names
    assert 'requirements.txt' in names


def test_environment_of_the_wheels_keeps_every_other_ros_out(launcher: Any) -> None:
    foreign = {
        'PATH': '/usr/bin',
        'AMENT_PREFIX_PATH': '/opt/ros/humble',
        'CMAKE_PREFIX_PATH': '/opt/ros/humble',
        'LD_LIBRARY_PATH': '/opt/ros/humble/lib:/opt/mine/lib',
        'PYTHONPATH': '/opt/ros/humble/lib/python3.10/site-packages',
        'PYTHONHOME': '/nowhere',
        'ROS_DISTRO': 'humble',
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        '_ROS_WHEELS_BOOTSTRAP_COMPLETE': '1',
    }
    home = launcher.find_home(foreign)
    env = launcher.node_environment(home, foreign)
    assert not any('humble' in value for value in env.values())
    assert env['ROS_DISTRO'] == 'jazzy'
    assert env['RMW_IMPLEMENTATION'] == 'rmw_fastrtps_cpp'
    assert 'PYTHONHOME' not in env
    # A child that has the guard but not the libraries cannot load rclpy.
    assert env['_ROS_WHEELS_BOOTSTRAP_COMPLETE']
    libraries = env['LD_LIBRARY_PATH'].split(os.pathsep)
    assert libraries[:2] == [str(home.install / 'lib'), str(home.environment / 'lib')]
    assert libraries[-1] == '/opt/mine/lib'
    assert env['PYTHONPATH'].split(os.pathsep)[0] == str(launcher.ROOT)


def test_environment_of_a_sourced_jazzy_adds_to_what_was_sourced(launcher: Any) -> None:
    sourced = {
        'PATH': '/opt/ros/jazzy/bin:/usr/bin',
        'AMENT_PREFIX_PATH': '/ws/install/crtk_msgs:/opt/ros/jazzy',
        'LD_LIBRARY_PATH': '/opt/ros/jazzy/lib',
        'PYTHONPATH': '/opt/ros/jazzy/lib/python3.12/site-packages',
        'ROS_DISTRO': 'jazzy',
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
    }
    home = launcher.Home('/opt/ros/jazzy', launcher.ROOT / '.trainer' / 'sourced')
    env = launcher.node_environment(home, sourced)
    for name in ('PATH', 'AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH', 'PYTHONPATH'):
        assert env[name].endswith(sourced[name])
        assert env[name] != sourced[name]
    assert env['RMW_IMPLEMENTATION'] == 'rmw_cyclonedds_cpp'
    assert '_ROS_WHEELS_BOOTSTRAP_COMPLETE' not in env
    assert env['CMAKE_PREFIX_PATH'] == sourced['AMENT_PREFIX_PATH']


def test_nodes_stay_on_this_machine_unless_the_user_says_otherwise(launcher: Any) -> None:
    home = launcher.find_home({})
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    assert launcher.node_environment(home, {})[name] == 'LOCALHOST'
    assert launcher.node_environment(home, {name: 'SUBNET'})[name] == 'SUBNET'


# Each step once.


KERNELS = {'compile_kernels', 'compile_further_kernels'}
LATER = {'compile_further_kernels', 'install_study_packages'}
ALL = {'make_environment', 'build_interfaces', 'build_overlay'} | KERNELS | LATER


@pytest.fixture
def steps(launcher: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the steps that are done, each only noted here."""
    done: list[str] = []

    def note(name: str) -> Callable[[Any, int], None]:
        def action(home: Any, lock: int) -> None:
            home.python.parent.mkdir(parents=True, exist_ok=True)
            home.python.touch()
            done.append(name)

        return action

    for name in ALL:
        monkeypatch.setattr(launcher, name, note(name))
    return done


def prepared(launcher: Any, steps: list[str]) -> set[str]:
    steps.clear()
    launcher.prepare(launcher.find_home({}))
    assert len(steps) == len(set(steps))
    return set(steps)


def test_second_start_does_nothing(launcher: Any, steps: list[str]) -> None:
    assert prepared(launcher, steps) == ALL
    assert prepared(launcher, steps) == set()


def test_demo_does_not_wait_for_kernels_and_packages_that_only_other_commands_need(
    launcher: Any, steps: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher.os, 'execve', lambda *_: 0)
    launcher.main(['demo'])
    assert set(steps) == ALL - LATER
    steps.clear()
    launcher.main(['bench'])
    assert steps == ['compile_further_kernels']
    steps.clear()
    launcher.main(['study'])
    assert steps == ['install_study_packages']


def test_each_change_redoes_the_steps_that_depend_on_it(
    launcher: Any, steps: list[str], tree: Path
) -> None:
    prepared(launcher, steps)
    with (tree / 'msg_defs' / 'msg' / 'Mesh.msg').open('a') as file:
        file.write('\n# changed\n')
    assert prepared(launcher, steps) == {'build_interfaces'}
    kernel = launcher.kernel_files()[0]
    os.utime(kernel, (1, 1))
    assert prepared(launcher, steps) == KERNELS
    with (tree / 'requirements-study-lock.txt').open('a') as file:
        file.write('\n# changed\n')
    assert prepared(launcher, steps) == {'install_study_packages'}
    with (tree / 'requirements-ros.txt').open('a') as file:
        file.write('\n# changed\n')
    assert prepared(launcher, steps) == ALL


def test_module_from_which_a_kernel_takes_constants_counts_as_a_kernel(
    launcher: Any, tree: Path
) -> None:
    (tree / 'cutting' / 'constants.py').write_text('LIMIT = 1\n')
    kernel = tree / 'cutting' / 'kernel.py'
    kernel.write_text(
        'from cutting_trainer.cutting.constants import LIMIT\n'
        'from cutting_trainer.node_common.kernels import inner\n'
    )
    assert {tree / 'cutting' / 'constants.py', kernel} <= set(launcher.kernel_files())


def test_change_of_a_kernel_recompiles_what_imports_it_and_nothing_else(
    launcher: Any, monkeypatch: pytest.MonkeyPatch, tree: Path
) -> None:
    used = 'from cutting_trainer.node_common.kernels import inner\n'
    texts = {
        'base': used,
        'middle': f'{used}from cutting_trainer.cutting.base import f\n',
        'top': f'{used}from cutting_trainer.cutting import (\n    beside,\n    middle,\n)\n',
        'beside': used,
    }
    for name, text in texts.items():
        (tree / 'cutting' / f'{name}.py').write_text(text)
    home = launcher.find_home({})
    folder = home.numba_cache / 'cutting_0123'
    monkeypatch.setattr(launcher, 'run', lambda *_: None)

    def kept_after_change(name: str) -> set[str]:
        launcher.compile_kernels(home, 0)
        folder.mkdir(parents=True, exist_ok=True)
        for module in texts:
            (folder / f'{module}.f-1.py311.nbi').touch()
        os.utime(tree / 'cutting' / f'{name}.py', (1, 1))
        launcher.compile_kernels(home, 0)
        return {path.name.partition('.')[0] for path in folder.glob('*')}

    assert kept_after_change('middle') == {'base', 'beside'}
    assert kept_after_change('base') == {'beside'}


BEFORE = {
    'make_environment': set(),
    'build_interfaces': {'make_environment'},
    'build_overlay': {'make_environment', 'build_interfaces'},
    'compile_kernels': {'make_environment'},
    'compile_further_kernels': {'make_environment', 'compile_kernels'},
    'install_study_packages': {'make_environment'},
}


@pytest.mark.parametrize('interrupted', sorted(ALL))
def test_interrupted_step_is_done_again_and_the_ones_before_it_are_not(
    launcher: Any, steps: list[str], monkeypatch: pytest.MonkeyPatch, interrupted: str
) -> None:
    whole = getattr(launcher, interrupted)

    def interrupt(home: Any, lock: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(launcher, interrupted, interrupt)
    assert launcher.guarded_main(['setup']) == launcher.INTERRUPTED
    monkeypatch.setattr(launcher, interrupted, whole)
    redone = prepared(launcher, steps)
    assert interrupted in redone and not redone & BEFORE[interrupted]
    assert prepared(launcher, steps) == set()


def test_python_of_an_environment_stands_for_the_one_that_it_was_made_of(
    launcher: Any, tmp_path: Path
) -> None:
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'env'], check=True)
    facts = launcher.probe(str(tmp_path / 'env' / 'bin' / 'python'))
    assert not Path(facts['executable']).is_relative_to(tmp_path)


def test_the_wheel_that_an_interpreter_carries_is_a_pip_that_runs(
    launcher: Any, tmp_path: Path
) -> None:
    wheel = launcher.probe(sys.executable)['pip']
    python = [sys.executable, '-m']
    subprocess.run([*python, 'zipfile', '-e', wheel, tmp_path], check=True)
    environment = os.environ | {'PYTHONPATH': str(tmp_path)}
    said = subprocess.check_output([*python, 'pip', '--version'], env=environment, text=True)
    assert f'from {tmp_path}' in said


def test_messages_are_built_once_for_all_clones(
    launcher: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    home, built = launcher.find_home({}), []

    def build(home: Any, lock: int, step: str, source: Path, prefix: Path) -> None:
        built.append(step)
        executable(prefix / 'lib' / 'messages', 'built')

    monkeypatch.setattr(launcher, 'check_build_tools', lambda: None)
    monkeypatch.setattr(launcher, 'build_package', build)
    (home.environment / 'lib' / 'python3.12').mkdir(parents=True)
    for _ in range(2):
        launcher.build_interfaces(home, 0)
        assert (home.install / 'lib' / 'messages').read_text() == 'built'
        shutil.rmtree(home.install)
    assert built == ['interfaces']
    (home.environment / 'lib' / 'python3.12').rename(home.environment / 'lib' / 'python3.13')
    launcher.build_interfaces(home, 0)
    assert len(built) == 2


def test_second_start_waits_for_the_first(tree: Path) -> None:
    (tree / '.trainer').mkdir()
    with (tree / '.trainer' / 'lock').open('a') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        waiting = subprocess.Popen(
            [sys.executable, 'trainer', 'clean'], cwd=tree, stderr=subprocess.PIPE, text=True
        )
        assert waiting.stderr
        assert 'waiting' in waiting.stderr.readline()
        assert waiting.poll() is None
    with waiting:
        assert waiting.wait(timeout=20) == 0


SETTING_UP = """
import importlib.util, sys
from importlib.machinery import SourceFileLoader
loader = SourceFileLoader('launcher', 'trainer')
launcher = importlib.util.module_from_spec(importlib.util.spec_from_loader('launcher', loader))
loader.exec_module(launcher)
def endless(home, lock):
    run = ['sh', '-c', 'sh -c "echo \\$\\$ > pid; exec sleep 600"; true']
    launcher.run(home, lock, 'environment', [run], launcher.os.environ)
launcher.make_environment = endless
launcher.signal.signal(launcher.signal.SIGTERM, launcher.on_signal)
sys.exit(launcher.guarded_main(['setup']))
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupt_during_setup_ends_the_running_step(tree: Path, number: signal.Signals) -> None:
    environ = {**os.environ, 'PYTHONDONTWRITEBYTECODE': '1'}
    setup = subprocess.Popen(
        [sys.executable, '-c', SETTING_UP], cwd=tree, env=environ, stderr=subprocess.PIPE, text=True
    )
    pid = tree / 'pid'
    deadline = time.monotonic() + 20
    while not (pid.is_file() and pid.read_text().strip()) and time.monotonic() < deadline:
        time.sleep(0.02)
    setup.send_signal(number)
    said = setup.communicate(timeout=20)[1]
    assert setup.returncode == 130
    assert 'Interrupted' in said
    stat = Path(f'/proc/{pid.read_text().strip()}/stat')
    deadline = time.monotonic() + 20
    while runs(stat) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not runs(stat)


def runs(stat: Path) -> bool:
    """Return whether a process runs: one that ended stays listed until its parent looks."""
    try:
        return stat.read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


def test_processes_keep_bytecode_in_the_environment_whatever_the_shell_says(launcher: Any) -> None:
    home = launcher.find_home({})
    environ = launcher.node_environment(home, dict(os.environ, PYTHONDONTWRITEBYTECODE='1'))
    asked = 'import sys; print(sys.dont_write_bytecode, sys.pycache_prefix)'
    command = [sys.executable, '-c', asked]
    said = subprocess.run(command, env=environ, capture_output=True, text=True, check=True).stdout
    assert said.split() == ['False', str(home.folder / 'bytecode')]


def test_clean_leaves_nothing_but_the_lock(tree: Path) -> None:
    (tree / '.trainer' / 'wheels' / 'env').mkdir(parents=True)
    assert start(tree, 'clean').returncode == 0
    assert [path.name for path in (tree / '.trainer').iterdir()] == ['lock']


def test_doctor_examines_a_machine_on_which_nothing_is_set_up(tree: Path) -> None:
    done = start(tree, 'doctor', '--json', PYTHONPATH='')
    told = json.loads(done.stdout)
    found = {check['check']: check for check in told['checks']}
    assert done.returncode == (0 if told['ok'] else 1)
    assert {'python', 'compiler', 'set-up', 'kernel cache', 'dds', 'real time'} <= found.keys()
    assert found['set-up']['level'] == found['dds']['level'] == 'warning'
    assert not (tree / '.trainer').exists()


def test_doctor_names_a_missing_tool_as_setting_up_does(tree: Path, tmp_path: Path) -> None:
    (tmp_path / 'empty').mkdir()
    done = start(tree, 'doctor', PATH=str(tmp_path / 'empty'))
    assert done.returncode == 1
    (wrong,) = [line for line in done.stdout.splitlines() if 'compiler' in line]
    assert wrong.startswith('ERROR') and 'apt install' in wrong
