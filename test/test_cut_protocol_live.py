"""The running `tissue_sim` under a `cutting` that answers late: frames wait by simulated time."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import Contact, ForceSample, FrameInputs
from cutting_trainer_msgs.srv import Cut, GetMesh
from live import free_domain, node_words, running, wait_for
from rclpy.executors import SingleThreadedExecutor

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.node_common import qos, ros
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.session.node_commands import node_environment
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import CutOutcome

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

ROOT = Path(__file__).parents[1]
CUT = ROOT / 'bags' / 'samples' / 'format_2' / 'straight_cut'
UNDELAYED = 'undelayed'
FIELDS = [
    'sequence',
    'state',
    'topology',
    'nodes',
    'weights',
    'point',
    'proxy',
    'normal',
    'device',
    'coupling_stiffness',
    'proxy_radius',
    'blade_root',
    'blade_tip',
]


class Between:
    """The service `cutting/cut` in the place of the node's own, which it hands requests on to."""

    def __init__(self, context: rclpy.Context) -> None:
        self.node = rclpy.create_node('between', context=context)
        self.delays = np.random.default_rng(3).choice([0.0, 0.005, 0.05, 0.2], 10_000).tolist()
        self._client = self.node.create_client(Cut, UNDELAYED)
        self.server = rclpy.create_node('server', context=context)
        self.server.create_service(Cut, ros.CUT, self._serve)
        self.meshes = self.node.create_client(GetMesh, ros.GET_MESH)
        self.inputs: list[FrameInputs] = []
        self.newest = 0.0
        self.forces: dict[int, ForceSample] = {}
        self.contacts = self.node.create_publisher(Contact, ros.CONTACT, qos.STREAM)
        self.node.create_subscription(FrameInputs, ros.FRAME_INPUTS, self._note, qos.STREAM)
        self.node.create_subscription(ForceSample, ros.FORCE, self._keep, qos.STREAM)

    def _note(self, inputs: FrameInputs) -> None:
        self.newest = time.monotonic()
        self.inputs.append(inputs)

    def _keep(self, sample: ForceSample) -> None:
        self.forces[sample.step] = sample

    def _serve(self, request: Cut.Request, response: Cut.Response) -> Cut.Response:
        time.sleep(self.delays.pop())
        answer, until = self._client.call_async(request), time.monotonic() + 20.0
        while not answer.done() and time.monotonic() < until:
            time.sleep(0.0005)
        return answer.result() if answer.done() else response


def start(stack: ExitStack, module: str, scene: Path, domain: int, *more: str) -> Any:
    command = node_words(module, '-p', f'scene:={scene}', *more)
    return stack.enter_context(running(command, node_environment(domain)))


@pytest.fixture
def session(tmp_path: Path) -> Iterator[tuple[Between, Path, Any]]:
    domain, scene = free_domain(), restore_scene(open_bag(CUT), tmp_path)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    between = Between(context)
    executors = [SingleThreadedExecutor(context=context) for _ in range(2)]
    threads = [threading.Thread(target=executor.spin) for executor in executors]
    for executor, node in zip(executors, (between.node, between.server), strict=True):
        executor.add_node(node)
    for thread in threads:
        thread.start()
    with ExitStack() as stack:
        remapped = ('-r', f'{ros.CUT}:={UNDELAYED}')
        cutting = start(stack, 'cutting_trainer.cutting.node', scene, domain, *remapped)
        tissue = start(stack, 'cutting_trainer.tissue_sim.node', scene, domain)
        for process in (cutting, tissue):
            assert process.stdout.readline().startswith('ready: ')
        yield between, scene, (cutting, tissue)
    rclpy.shutdown(context=context)
    for thread in threads:
        thread.join()


def play(between: Between, until: Any = lambda: False) -> dict[int, Contact]:
    """Plays the recorded contacts, at their pace by frames; those that were sent, by number."""
    sent = {}
    for number, record in enumerate(read_run(open_bag(CUT))[0], 1):
        if record.contact is None:
            continue
        message = Contact()
        for name in FIELDS:
            setattr(message, name, getattr(record.contact, name))
        message.sequence, message.header.frame_id = number, ros.FRAME
        frames = len(between.inputs)
        between.contacts.publish(message)
        sent[number] = message
        wait_for(lambda frames=frames: len(between.inputs) > frames or until(), 'a frame')
        if until():
            break
    return sent


def test_the_frame_after_a_sweep_begins_with_its_answer_however_late_it_is(
    session: tuple[Between, Path, Any],
) -> None:
    between, scene, _ = session
    sent = play(between)
    inputs = between.inputs[:]
    assert [frame.step for frame in inputs] == list(range(inputs[0].step, inputs[-1].step + 1))
    answered = [frame for frame in inputs if frame.answer]
    assert len(answered) > 20 and any(frame.answer == CutOutcome.APPLIED for frame in answered)
    assert all(frame.step == frame.cut_step + 1 for frame in answered)
    assert max(frame.waited for frame in answered) > 0.1
    computed = recomputation(load_scene(str(scene)))
    for _ in range(1, inputs[0].step):  # before anybody listened, and touched the tissue
        computed.frame(None)
    for frame in inputs:
        assert computed.answer() == frame.answer
        contact = sent[frame.contact_sequence] if frame.has_contact else None
        mesh = computed.simulation.mesh
        again = computed.frame(contact and tool_contact(contact, mesh))
        np.testing.assert_array_equal(between.forces[frame.step].force, again.force)


def test_while_it_waits_the_node_gives_its_mesh_and_ends_when_it_is_asked_to(
    session: tuple[Between, Path, Any],
) -> None:
    between, _, (cutting, tissue) = session
    between.delays = [0.0] * 10_000
    play(between, lambda: any(frame.answer == CutOutcome.APPLIED for frame in between.inputs))
    os.kill(cutting.pid, signal.SIGSTOP)
    play(between, lambda: time.monotonic() - between.newest > 0.25)
    frames, mesh = len(between.inputs), between.meshes.call_async(GetMesh.Request())
    wait_for(mesh.done, 'the mesh')
    assert mesh.result().success
    assert len(between.inputs) == frames
    tissue.terminate()
    assert tissue.wait(5.0) == 0
    assert len(between.inputs) == frames
