"""Claims about message packages of others: which are taken, how they are built, where they go."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from test_launcher import load

from cutting_trainer.cli.overlay import OverlayError, take_overlay

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
STAND_IN = ROOT / 'test' / 'stand_ins' / 'crtk_msgs'
INDEX = Path('share/ament_index/resource_index')
PYTHON = f'python{sys.version_info.major}.{sys.version_info.minor}'


@pytest.fixture
def launcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The launcher of a clone that has nothing in it."""
    module = load(ROOT / 'trainer')
    monkeypatch.setattr(module, 'ROOT', tmp_path)
    return module


def package(folder: Path, name: str, message: str) -> Path:
    """A package whose own build file asks for what is not there."""
    (folder / name / 'msg').mkdir(parents=True)
    (folder / name / 'package.xml').write_text(
        f'<package format="3"><name>{name}</name><version>1.2.3</version>'
        '<description>Messages.</description><maintainer email="a@b.org">A</maintainer>'
        '<license>BSD</license></package>'
    )
    (folder / name / 'CMakeLists.txt').write_text('find_package(rclcpp REQUIRED)')
    (folder / name / 'msg' / 'Thing.msg').write_text(message)
    return folder / name


def test_packages_are_taken_in_the_order_in_which_they_use_each_other(tmp_path):
    package(tmp_path / 'src', 'a_msgs', 'b_msgs/Thing[] things\n# c_msgs/Thing said\n')
    package(tmp_path / 'src', 'b_msgs', 'std_msgs/Header header\nfloat64 x\n')
    target = tmp_path / 'overlay'
    take_overlay(target, [tmp_path / 'src'], {'std_msgs'})
    assert (target / 'order').read_text().split() == ['b_msgs', 'a_msgs']
    build = (target / 'a_msgs' / 'CMakeLists.txt').read_text()
    assert 'rosidl_interface_packages' in (target / 'a_msgs' / 'package.xml').read_text()
    assert 'DEPENDENCIES b_msgs)' in build and 'rclcpp' not in build and '1.2.3' in build
    take_overlay(target, [], set())
    assert not target.exists()


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        ('other_msgs/Thing thing\n', ['a_msgs', 'other_msgs', 'not there']),
        (None, ['no message package', 'package.xml']),
    ],
)
def test_what_cannot_be_taken_is_one_sentence_and_leaves_the_overlay(tmp_path, message, words):
    target = tmp_path / 'overlay'
    take_overlay(target, [STAND_IN], {'std_msgs'})
    if message:
        package(tmp_path / 'src', 'a_msgs', message)
    with pytest.raises(OverlayError) as refused:
        take_overlay(target, [tmp_path / 'src'], {'std_msgs'})
    assert all(word in str(refused.value) for word in words)
    assert (target / 'order').read_text() == 'crtk_msgs'


def test_packages_that_use_each_other_in_a_circle_are_refused(tmp_path):
    package(tmp_path, 'a_msgs', 'b_msgs/Thing thing\n')
    package(tmp_path, 'b_msgs', 'a_msgs/Thing thing\n')
    with pytest.raises(OverlayError, match='a_msgs and b_msgs'):
        take_overlay(tmp_path / 'overlay', [tmp_path], set())


def prefix(folder: Path, *packages: str, python: str = PYTHON, messages: bool = True) -> Path:
    """A built workspace."""
    for name in packages:
        for kind in ('packages', *(['rosidl_interfaces'] if messages else [])):
            (folder / INDEX / kind).mkdir(parents=True, exist_ok=True)
            (folder / INDEX / kind / name).touch()
        (folder / 'lib' / python / 'site-packages' / name).mkdir(parents=True)
    return folder


def test_a_sourced_workspace_with_messages_is_respected_and_no_other_ros(
    launcher: Any,
    tmp_path: Path,
) -> None:
    home = launcher.find_home({})
    prefix(home.environment, 'rclpy', 'std_msgs')
    fits = prefix(tmp_path / 'ws' / 'crtk_msgs', 'crtk_msgs')
    ros = prefix(tmp_path / 'humble', 'rclpy', 'std_msgs', 'crtk_msgs')
    old = prefix(tmp_path / 'old', 'omni_msgs', python='python3.8')
    tools = prefix(tmp_path / 'tools', 'my_nodes', messages=False)
    sourced = {
        'AMENT_PREFIX_PATH': os.pathsep.join(map(str, (fits, ros, old, tools))),
        'PYTHONPATH': str(ros / 'lib' / PYTHON / 'site-packages'),
        'LD_LIBRARY_PATH': os.pathsep.join([str(fits / 'lib'), str(ros / 'lib')]),
    }
    env = launcher.node_environment(home, sourced)
    for name, below in (
        ('PYTHONPATH', f'lib/{PYTHON}/site-packages'),
        ('LD_LIBRARY_PATH', 'lib'),
        ('AMENT_PREFIX_PATH', ''),
    ):
        paths = env[name].split(os.pathsep)
        assert str(fits / below) in paths
        assert not [p for p in paths for other in (ros, old, tools) if p.startswith(str(other))]
    _, sentences = launcher.matching_workspaces(home, tuple(map(str, (fits, ros, old, tools))))
    (sentence,) = sentences
    assert re.search(f'{old} has omni_msgs, but not for {PYTHON}.*trainer overlay', sentence)


@pytest.mark.thorough
def test_the_launcher_builds_an_overlay_that_the_nodes_then_use(
    launcher: Any,
    tmp_path: Path,
) -> None:
    home = launcher.find_home({})
    home.folder.mkdir(parents=True)
    home.environment.symlink_to(sys.prefix)
    package(tmp_path / 'src', 'crtk_msgs', '')
    for kind in ('msg', 'srv'):
        (tmp_path / 'src' / 'crtk_msgs' / kind).mkdir(exist_ok=True)
        for file in (STAND_IN / kind).iterdir():
            (tmp_path / 'src' / 'crtk_msgs' / kind / file.name).write_bytes(file.read_bytes())
    (tmp_path / 'src' / 'crtk_msgs' / 'msg' / 'Thing.msg').unlink()
    launcher.overlay(home, [str(tmp_path / 'src')])
    with launcher.locked(home) as lock:
        launcher.build_overlay(home, lock)
    module = 'cutting_trainer.node_common.operating_state'
    code = f'from {module} import crtk_types as t; print(t().command)'
    env = launcher.node_environment(home, dict(os.environ))
    env['PYTHONPATH'] += f'{os.pathsep}{ROOT}'  # the clone is an empty one
    done = subprocess.run(
        [sys.executable, '-c', code], env=env, capture_output=True, text=True, check=True
    )
    assert 'crtk_msgs.msg' in done.stdout
