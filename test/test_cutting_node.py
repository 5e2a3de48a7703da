"""Claims about the running node `cutting`, between a simulation that this test plays and itself."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import Mesh, MeshDelta
from cutting_trainer_msgs.srv import Cut, GetMesh
from live import free_domain, wait_for
from meshes import box
from rclpy.executors import SingleThreadedExecutor

from cutting_trainer.cutting.cut_invariants import check_mesh, pieces
from cutting_trainer.node_common import qos, ros
from cutting_trainer.session.node_commands import node_environment
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder, delta_from, mesh_message

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
SCENE = 'cutting: {method: combined}\n'


class Tissue:
    """A block at rest that is moved by hand, with the topics and services of `tissue_sim`."""

    def __init__(self, context: rclpy.Context) -> None:
        nodes, tetrahedra = box((6, 4, 3), 0.005)
        self.mesh = TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9)
        self.volume = float(self.mesh.volumes().sum())
        self.displacement = np.zeros_like(self.mesh.rest)
        self.step = 0
        self.node = rclpy.create_node('tissue', context=context)
        self._encoder = DeltaEncoder(self.mesh, self.displacement)
        self._keyframes = self.node.create_publisher(Mesh, ros.MESH, qos.LATCHED)
        self._updates = self.node.create_publisher(MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self._service = self.node.create_service(GetMesh, ros.GET_MESH, self._serve)
        self._client = self.node.create_client(Cut, ros.CUT)
        self._keyframes.publish(self._message())
        self.asked = 0

    @property
    def revision(self) -> int:
        return self._encoder.revision

    def wait_for_cutting(self, known: int = 0) -> None:
        """Returns when the service is there, and its process listens to the deltas."""
        wait_for(self._client.service_is_ready, 'the service')
        wait_for(lambda: self._updates.get_subscription_count() > known, 'a subscriber')

    def next_delta(self, touched: Any = None) -> MeshDelta:
        self.step += 1
        self.displacement = np.full_like(self.mesh.rest, 1e-6 * self.step)
        delta = self._encoder.encode(self.displacement, self.step, 0, touched, self.step)
        assert delta is not None
        return delta

    def publish(self, delta: MeshDelta) -> None:
        self._updates.publish(delta)

    def ask(self, begin: float, end: float, command: int = Cut.Request.ADVANCE) -> Any:
        """A blade through the whole block moves along x [m]; returns the answer to come."""
        request = Cut.Request(command=command, revision=self.revision)
        for name, x in (('from', begin), ('to', end)):
            setattr(request, f'tip_{name}', np.array([x, 0.0118, -0.002]))
            setattr(request, f'root_{name}', np.array([x, 0.0118, 0.017]))
        return self._client.call_async(request)

    def cut(self, begin: float, end: float, command: int = Cut.Request.ADVANCE) -> None:
        """Asks until it is answered, applies what comes, and checks the mesh."""

        def answered() -> Any:
            self.publish(self.next_delta())
            future = self.ask(begin, end, command)
            limit = time.monotonic() + 2.0
            while not future.done() and time.monotonic() < limit:
                time.sleep(0.005)
            response = future.result() if future.done() else None
            return response if response is not None and response.success else None

        delta = delta_from(wait_for(answered, 'an answer'))
        if not delta.empty:
            touched = self.mesh.apply(delta)
            check_mesh(self.mesh, self.volume)
            self.publish(self.next_delta(touched))

    def _message(self) -> Mesh:
        return mesh_message(self.mesh, self.displacement, 'test', self.revision, self.step, 0)

    def _serve(self, _: GetMesh.Request, response: GetMesh.Response) -> GetMesh.Response:
        self.asked += 1
        response.mesh, response.success = self._message(), True
        return response


@pytest.fixture
def domain() -> int:
    return free_domain()


@pytest.fixture
def tissue(domain: int) -> Iterator[Tissue]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    tissue = Tissue(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(tissue.node)
    server = threading.Thread(target=executor.spin)
    server.start()
    yield tissue
    executor.shutdown()
    server.join()
    tissue.node.destroy_node()
    rclpy.shutdown(context=context)


class Cutting:
    """The node in a process of its own, which may be killed and started again."""

    def __init__(self, folder: Path, domain: int) -> None:
        self._scene = folder / 'scene.yaml'
        self._scene.write_text(SCENE)
        self._environment = node_environment(domain)
        self.start()

    def start(self) -> None:
        arguments = ['--ros-args', '-p', f'scene:={self._scene}']
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'cutting_trainer.cutting.node', *arguments],
            cwd=ROOT,
            env=self._environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == 'ready: cutting\n'

    def kill(self) -> None:
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()


@pytest.fixture
def cutting(tmp_path: Path, domain: int) -> Iterator[Cutting]:
    cutting = Cutting(tmp_path, domain)
    yield cutting
    cutting.kill()


def test_request_that_overtakes_its_delta_is_answered_once_the_delta_is_there(
    tissue: Tissue, cutting: Cutting
) -> None:
    tissue.wait_for_cutting()
    tissue.cut(-0.002, 0.002)
    for _ in range(3):
        late = tissue.next_delta()
        future = tissue.ask(0.002, 0.004)
        time.sleep(0.05)
        assert not future.done()
        tissue.publish(late)
        wait_for(future.done, 'the answer')
        assert future.result().success, future.result().error_msg
        assert future.result().revision == tissue.revision
    assert tissue.asked <= 1  # a node that starts late may miss the first delta


def test_request_for_a_revision_that_never_comes_is_refused_in_time_and_says_what_there_is(
    tissue: Tissue, cutting: Cutting
) -> None:
    tissue.wait_for_cutting()
    tissue.cut(-0.002, 0.002)
    there = tissue.revision
    tissue.next_delta()
    future = tissue.ask(0.002, 0.004)
    wait_for(future.done, 'the answer')
    response = future.result()
    assert response.error_code == Cut.Response.WRONG_REVISION
    assert response.error_msg.startswith(f'revision {there + 1} is not at hand; revisions ')
    assert f'to {there} are' in response.error_msg
    tissue.cut(0.002, 0.004)
    assert tissue.asked >= 1  # the delta after the lost one did not fit


def test_killed_in_the_middle_of_a_cut_and_started_again_it_goes_on_and_parts_the_block(
    tissue: Tissue, cutting: Cutting
) -> None:
    tissue.wait_for_cutting()
    ways = np.linspace(-0.002, 0.032, 18)
    for begin, end in pairwise(ways[:9]):
        tissue.cut(begin, end)
    assert tissue.mesh.topology > 0
    assert pieces(tissue.mesh).max() == 0
    cutting.kill()
    cutting.start()
    back = 0.005  # an element: see `Blade.retry_sweep`
    for begin, end in pairwise(ways[8:]):
        tissue.cut(begin - back, end)
        back = 0.0
    tissue.cut(ways[-2], ways[-1], Cut.Request.FINISH)
    assert tissue.asked >= 1
    assert pieces(tissue.mesh).max() == 1
