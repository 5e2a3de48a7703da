"""Whoever follows the tissue has it as it is, whatever the network and other senders do."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import Mesh, MeshDelta
from live import free_domain, wait_for
from meshes import irregular_box
from rclpy.node import Node

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.rejections import RejectionStatistics
from cutting_trainer.node_common.ros import stamp
from cutting_trainer.node_common.stamps import REVISION_MODULUS, nanoseconds, newer
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.streaming.link_budget import LinkBudget
from cutting_trainer.tissue_sim.streaming.mesh_follower import (
    STALE_REVISION_TIMEOUT_S,
    MeshFollower,
)
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder, mesh_message

pytestmark = pytest.mark.long

SECOND = 1_000_000_000
END_OF_32_BITS = 2**31 * SECOND


class Tissue:
    """What `tissue_sim` publishes, by hand."""

    def __init__(self, revision: int = 0, begun: int = 100 * SECOND) -> None:
        nodes, tetrahedra = irregular_box((2, 2, 2), 0.01, 1)
        self.mesh = TetMesh(nodes, tetrahedra)
        self.displacement = np.zeros_like(nodes)
        self.encoder = DeltaEncoder(self.mesh, self.displacement)
        self.encoder.revision = revision
        self.now, self.step = begun, 0

    def keyframe(self) -> Mesh:
        revision = self.encoder.revision
        return mesh_message(self.mesh, self.displacement, '', revision, self.step, self.now)

    def move(self) -> MeshDelta:
        self.step += 1
        self.now += SECOND // 30
        self.displacement = self.displacement + 1e-4
        delta = self.encoder.encode(self.displacement, self.step, self.now, None, 0)
        assert delta is not None
        return delta


class Graph:
    """A follower, and somebody who sends to it."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=free_domain())
        self.node = Node('graph', context=self.context)
        self.meshes = self.node.create_publisher(Mesh, ros.MESH, qos.LATCHED)
        self.updates = self.node.create_publisher(MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self.rejections = RejectionStatistics()
        self.follower = MeshFollower(self.node, self.rejections)
        wait_for(lambda: self.updates.get_subscription_count() == 1, 'the follower')

    def reaches(self, revision: int) -> bool:
        """Whether the follower comes to have a revision."""
        wait_for(lambda: self.follower.poll() or self.follower.replica.revision == revision, '')
        return self.follower.replica.revision == revision

    def polled(self, seconds: float) -> MeshReplica:
        """What the follower has after some time [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.follower.poll()
            time.sleep(0.005)
        return self.follower.replica


@pytest.fixture
def graph() -> Iterator[Graph]:
    made = Graph()
    yield made
    made.node.destroy_node()
    rclpy.shutdown(context=made.context)


def settle(graph: Graph, tissue: Tissue, moves: int = 3) -> None:
    graph.meshes.publish(tissue.keyframe())
    assert graph.reaches(tissue.encoder.revision)
    for _ in range(moves):
        graph.updates.publish(tissue.move())
        assert graph.reaches(tissue.encoder.revision)


def test_a_follower_checks_what_it_has_against_the_sender_s_hash(graph: Graph) -> None:
    tissue = Tissue()
    settle(graph, tissue)
    graph.meshes.publish(tissue.keyframe())
    wait_for(lambda: graph.follower.poll() or graph.follower.checked[0] == 3, 'the comparison')
    assert graph.follower.checked == (3, graph.follower.replica.hash())
    assert graph.follower.mismatches == 0
    graph.follower.replica._displacement[0] += 1e-9
    graph.meshes.publish(tissue.keyframe())
    wait_for(lambda: graph.follower.poll() or graph.follower.mismatches == 1, 'the mismatch')
    assert graph.follower.replica.hash() == tissue.keyframe().state_hash


def test_a_mesh_of_a_simulation_that_was_replaced_is_refused_while_the_new_one_speaks(
    graph: Graph,
) -> None:
    replaced, present = Tissue(), Tissue(revision=100)
    settle(graph, present)
    replaced.now = present.now + 10 * SECOND
    graph.meshes.publish(replaced.keyframe())
    graph.updates.publish(replaced.move())
    for _ in range(5):
        graph.updates.publish(present.move())
        assert graph.reaches(present.encoder.revision)
    assert graph.follower.stale == 1
    assert graph.follower.replica.hash() == present.keyframe().state_hash


def test_a_simulation_that_began_anew_is_followed_when_the_old_one_is_silent(graph: Graph) -> None:
    settle(graph, Tissue(revision=100))
    anew = Tissue(begun=200 * SECOND)
    graph.polled(STALE_REVISION_TIMEOUT_S + 0.1)
    graph.meshes.publish(anew.keyframe())
    assert graph.reaches(0)


def test_what_cannot_be_read_hides_nothing_that_comes_behind_it(graph: Graph) -> None:
    tissue = Tissue()
    settle(graph, tissue)
    for _ in range(3):
        graph.updates.publish(b'\0\1\0\0junk')
    graph.updates.publish(tissue.move())
    assert graph.reaches(4)
    assert graph.rejections.values() == {'refused tissue/mesh_updates: no such message': 3}


def test_revisions_are_followed_over_their_wrap_around(graph: Graph) -> None:
    tissue = Tissue(revision=REVISION_MODULUS - 3)
    settle(graph, tissue, moves=6)
    assert graph.follower.replica.revision == 3
    assert graph.follower.gaps == 0
    assert np.array_equal(graph.follower.replica.displacement, tissue.displacement)


@pytest.mark.parametrize(
    ('time', 'same'),
    [
        (1, True),
        (END_OF_32_BITS - 1, True),
        (END_OF_32_BITS, True),
        (2 * END_OF_32_BITS - 1, True),
        (2 * END_OF_32_BITS, False),
    ],
)
def test_stamps_are_right_until_2106(time: int, same: bool) -> None:
    assert (nanoseconds(stamp(time)) == time) is same


def test_what_is_newer_is_so_across_the_wrap_around() -> None:
    assert newer(0, -1) and newer(1, 0) and newer(2, REVISION_MODULUS - 1)
    assert not newer(0, 0) and not newer(0, 1) and not newer(REVISION_MODULUS - 1, 2)


@pytest.mark.parametrize('count', ['node_count', 'tetrahedron_count', 'triangle_count'])
def test_a_mesh_beyond_the_limit_is_refused_with_limit_and_parameter(count: str) -> None:
    tissue, replica = Tissue(), MeshReplica(max_nodes=100)
    replica.load(tissue.keyframe())
    delta = tissue.move()
    setattr(delta, count, 1_000_000_000)
    with pytest.raises(ValueError, match=r'1000000000 .*this node accepts .*max_nodes'):
        replica.apply(delta)
    assert replica.revision == 0
    with pytest.raises(ValueError, match='27 nodes: this node accepts 20'):
        MeshReplica(max_nodes=20).load(tissue.keyframe())


def test_a_thin_link_gets_what_it_carries_and_the_newest_at_the_end() -> None:
    tissue, link = Tissue(), LinkBudget(20_000)
    replica: Any = MeshReplica()
    replica.load(tissue.keyframe())
    sent, seconds = 0, 20
    for frame in range(30 * seconds):
        tissue.displacement = tissue.displacement + 1e-5
        if link.allows(frame / 30):
            delta = tissue.encoder.encode(tissue.displacement, frame, frame, None, 0)
            assert delta is not None
            link.spend(delta)
            sent += 1
            assert replica.apply(delta)
    assert link.held_back + sent == 30 * seconds
    assert link.sent == pytest.approx(20_000 * seconds, rel=0.1)
    assert np.abs(replica.displacement - tissue.displacement).max() < 1e-5 * 30


def test_a_link_without_a_limit_holds_nothing_back() -> None:
    link = LinkBudget(0.0)
    assert all(link.allows(frame / 30) for frame in range(100))
    assert link.held_back == 0
