"""Claims about the running node `tissue_sim`, under a tool that this test plays."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import Contact, ForceSample, FrameInputs
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from live import free_domain, two_presses, wait_for, write_scene

from cutting_trainer.node_common import qos, ros
from cutting_trainer.session.node_commands import node_environment
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_task

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]


class Tool:
    """A sphere over the middle of the largest triangle of the top, as the bridge reports it."""

    def __init__(self, scene: Path, domain: int) -> None:
        mesh = make_task(load_scene(str(scene)).tissue).mesh
        corners = mesh.rest[mesh.triangles]
        top = corners[:, :, 2].min(axis=1)
        self._nodes = mesh.triangles[int(top.argmax())]
        self._point = mesh.rest[self._nodes].mean(axis=0)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('tool', context=self._context)
        self._contacts = self._node.create_publisher(Contact, ros.CONTACT, qos.STREAM)
        self._forces = ros.polled(self._node, ForceSample, ros.FORCE, qos.NEWEST_BEST_EFFORT)
        self._status = ros.polled(self._node, DiagnosticArray, ros.DIAGNOSTICS, qos.EVENTS)
        self.sequence = 0

    def at(self, depth: float, stiffness: float = 200.0) -> Any:
        """Says that the tool is so deep [m], on a spring [N/m]; the newest force, or None."""
        self.sequence += 1
        up = np.array([0.0, 0.0, 1.0])
        surface = self._point + 0.004 * up
        message = Contact(state=Contact.TOUCHING, sequence=self.sequence)
        message.header.frame_id = ros.FRAME
        message.nodes = np.array([*self._nodes, *[0] * 6], np.uint32)
        message.weights = np.array([1 / 3] * 3 + [0.0] * 6)
        message.point, message.proxy = self._point, surface
        message.normal, message.device = up, surface - depth * up
        message.coupling_stiffness, message.proxy_radius = stiffness, 0.004
        message.blade_tip, message.blade_root = message.device, message.device + 0.02 * up
        self._contacts.publish(message)
        return ros.take(self._forces)

    def status(self) -> DiagnosticStatus | None:
        """What the node has said of itself since the last time."""
        array = ros.take(self._status)
        return array.status[0] if array else None

    def close(self) -> None:
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


@contextmanager
def running(folder: Path, scene: Path, domain: int) -> Iterator['subprocess.Popen[str]']:
    """The node as a process."""
    with (folder / 'log').open('w') as log:
        process = subprocess.Popen(
            [
                sys.executable,
                '-m',
                'cutting_trainer.tissue_sim.node',
                '--ros-args',
                '-p',
                f'scene:={scene}',
            ],
            cwd=ROOT,
            env=node_environment(domain),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@pytest.fixture
def tool(tmp_path: Path) -> Iterator[Tool]:
    # On one triangle: the spring of a footprint yields, and no tool of a hand's speed breaks it.
    domain = free_domain()
    scene = write_scene(tmp_path, two_presses(), 7.0, 20.0, contact='triangle')
    with running(tmp_path, scene, domain) as process:
        tool = Tool(scene, domain)
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == 'ready: tissue_sim\n'
            yield tool
        finally:
            tool.close()


def test_a_recorder_that_takes_a_moment_to_find_the_node_has_its_first_frame(
    tmp_path: Path,
) -> None:
    domain, scene = free_domain(), write_scene(tmp_path, two_presses(), 7.0, 20.0)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('recorder', context=context)
    try:
        with running(tmp_path, scene, domain):
            topic = f'/{ros.FRAME_INPUTS}'
            wait_for(lambda: topic in dict(node.get_topic_names_and_types()), topic)
            time.sleep(0.2)
            inputs = ros.polled(node, FrameInputs, ros.FRAME_INPUTS, qos.STREAM)
            first = wait_for(lambda: ros.take(inputs), 'a frame')
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert first.step == 1


def wait_until_felt(tool: Tool) -> None:
    def pressed() -> Any:
        sample = tool.at(0.003)
        return sample is not None and sample.force[2] > 0.05

    wait_for(pressed, 'a force')


def test_a_frame_that_shorter_steps_do_not_mend_has_no_force_and_the_log_names_limit_and_cause(
    tool: Tool, tmp_path: Path
) -> None:
    """The tool is driven through the block, no faster than a hand, by a spring that is rigid."""
    wait_until_felt(tool)
    driven = tool.sequence + 1

    def of_it() -> Any:
        sample = tool.at(0.09, stiffness=1e5)
        return sample if sample is not None and sample.contact_sequence >= driven else None

    sample = wait_for(of_it, 'the frame of it')
    assert not any(sample.force) and not any(sample.stiffness)
    assert sample.state == Contact.NONE

    def said() -> str:
        of_it()
        return (tmp_path / 'log').read_text()

    wait_for(lambda: 'farther than the tissue is long, 0.0574 m' in said(), 'the reason')
    line = next(line for line in said().splitlines() if 'farther than' in line)
    assert 'tetrahedra are inside out' in line
    assert 'at which symplectic_euler is stable at' in line and 'rad/s' in line

    def alarm() -> Any:
        of_it()
        status = tool.status()
        return status if status and status.level == DiagnosticStatus.ERROR else None

    assert 'a frame was taken back: a node would have moved' in wait_for(alarm, 'ERROR').message
    wait_until_felt(tool)


def test_a_tool_that_jumps_is_felt_no_more_and_the_log_says_why(tool: Tool, tmp_path: Path) -> None:
    wait_until_felt(tool)
    jump = tool.sequence + 1

    def after_the_jump() -> Any:
        sample = tool.at(0.3)
        return sample if sample is not None and sample.contact_sequence >= jump else None

    assert not wait_for(after_the_jump, 'the frame of the jump').force.any()
    wait_for(
        lambda: 'the tool has moved by 297 mm within a frame' in (tmp_path / 'log').read_text(),
        'the reason',
    )
    wait_until_felt(tool)
