"""A session around a driver that runs: checked, driven, recorded, or refused with the reason."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from live import PATIENCE, ROOT, free_domain, onlooker, phase, running, wait_for, write_scene

from cutting_trainer.bags.comparison import compare
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.cli import main as cli
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.qos import EVENTS
from cutting_trainer.node_common.ros import take, take_raw
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    ARM_NODE,
    DEVICE_TOPICS,
    MODULES,
    VIEWER_NODE,
    node_environment,
    simulation_nodes,
    viewer_command,
)
from cutting_trainer.session.scene_loader import load_scene

ARM = '/MTMR'


def test_no_emulated_arm_is_started_beside_a_device_and_its_topics_are_named() -> None:
    nodes = simulation_nodes(Path('/scene.yaml'), 0, Path('/x'), (), ARM)
    assert ARM_NODE not in {node.name for node in nodes}
    (bridge,) = (node for node in nodes if node.name == 'haptic_bridge')
    page = viewer_command(Path('/scene.yaml'), 'localhost', 0, session=True, arm=ARM)
    for words in (bridge.argv, page.argv):
        for topic in DEVICE_TOPICS:
            assert f'arm/{topic}:={ARM}/{topic}' in words
    # The emulated arm's name would make a stranger of the driver.
    assert not any('accepted_publishers' in word for word in bridge.argv)
    plain = viewer_command(Path('/scene.yaml'), 'localhost', 0, session=True)
    assert (plain.name, [word for word in plain.argv if ':=/' in word]) == (VIEWER_NODE, [])


@pytest.mark.parametrize(
    ('words', 'reason'),
    [
        (['--arm', ARM, '--domain', 'free'], 'name that, not --domain free'),
        (['--arm', '/MTM R'], 'give a namespace of ROS'),
        (['--attach', '--record'], './trainer record records others'),
    ],
)
def test_options_that_do_not_fit_are_bad_input(
    words: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main(['view', '--scene', 'block', *words])
    assert stopped.value.code == Status.BAD_INPUT
    assert reason in ' '.join(capsys.readouterr().err.split())


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    points = [(-0.012, -0.008, 0.0190, 1.0)]
    return write_scene(tmp_path, [phase('approach', *points)], 5.0, cut_threshold=100.0)


def driver(scene: Path) -> list[str]:
    """An emulated arm in the namespace of a device, as a driver that runs on its own."""
    parameters = [f'scene:={scene}', 'guided:=true', 'wait_for_bridge:=false']
    words = [sys.executable, '-m', MODULES[ARM_NODE], '--ros-args']
    words += [word for given in parameters for word in ('-p', given)]
    names = [*DEVICE_TOPICS, 'measured_cv', 'measured_cf', 'hand/servo_cp']
    return words + [word for n in names for word in ('-r', f'arm/{n}:={ARM}/{n}')]


@pytest.fixture
def command(scene: Path, tmp_path: Path) -> tuple[list[str], Path]:
    """The command that a user gives, with a bag of its own."""
    bag = tmp_path / 'bag'
    code = (
        'import sys; from pathlib import Path; from cutting_trainer.session import view_command;'
        f'view_command.new_bag = lambda *_: Path({str(bag)!r});'
        'from cutting_trainer.cli.main import main; main(sys.argv[1:])'
    )
    view = ['view', '--arm', ARM, '--scene', str(scene), '--record', '--port', '0']
    return [sys.executable, '-c', code, *view], bag


@pytest.mark.live
@pytest.mark.thorough
def test_a_driver_that_runs_gets_force_and_the_bag_computes_again(
    command: tuple[list[str], Path], scene: Path, tmp_path: Path
) -> None:
    words, bag = command
    domain = free_domain()
    environment = node_environment(domain) | {'COLUMNS': '200'}
    said = tmp_path / 'said'
    with running(driver(scene), environment, f'ready: {ARM_NODE}'), said.open('w') as file:
        session = subprocess.Popen(
            words, cwd=ROOT, env=environment, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            wait_for(
                lambda: session.poll() is not None or 'viewer is ready' in said.read_text(),
                'the session to begin',
            )
            assert session.poll() is None, said.read_text()
            types = crtk_types()
            states, forces = types.operating_state, f'{ARM}/servo_cf'
            with (
                onlooker(domain, states, '/haptic_bridge/operating_state') as state,
                onlooker(domain, topic=forces) as force,
            ):
                enable(domain)
                wait_for(lambda: take_raw(force), 'a force to the device')
                wait_for(lambda: (found := take(state)) and found.state == 'ENABLED', 'the bridge')
                time.sleep(2.0)
            session.send_signal(signal.SIGINT)
            assert session.wait(PATIENCE) == Status.OK, said.read_text()
        finally:
            session.kill()
            session.wait()
    opened = open_bag(bag)
    assert f'{ARM}/measured_cp' in opened.topics()
    assert '/arm/measured_cp' not in opened.topics()
    recorded = load_scene(str(restore_scene(opened, tmp_path)))
    result = compare(opened, recomputation(recorded), pose_check(recorded))
    assert result.identical, result
    assert not result.missing
    assert result.poses > 10


def enable(domain: int) -> None:
    """Enables the bridge, as the page does."""
    import rclpy

    types = crtk_types()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('operator', context=context)
    try:
        for name in (ARM, '/haptic_bridge'):
            publisher = node.create_publisher(types.command, f'{name}/state_command', EVENTS)
            wait_for(publisher.get_subscription_count, f'{name} to listen')
            publisher.publish(types.command(string='enable'))
            time.sleep(0.5)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.live
def test_without_a_driver_nothing_is_started_and_the_reason_is_told(
    command: tuple[list[str], Path],
) -> None:
    words, bag = command
    environment = node_environment(free_domain()) | {'COLUMNS': '400'}
    done = subprocess.run(
        words,
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == Status.BAD_INPUT
    assert f'nobody publishes {ARM}/measured_cp' in done.stderr
    assert not bag.exists()
