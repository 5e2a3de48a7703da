"""Subscriber that keeps a replica of the tissue up to date."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from cutting_trainer_msgs.msg import Mesh, MeshDelta
from cutting_trainer_msgs.srv import GetMesh
from rclpy.node import Node

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.parameters import parameter
from cutting_trainer.node_common.rejections import RejectionStatistics, require_frame
from cutting_trainer.node_common.stamps import nanoseconds, newer
from cutting_trainer.tissue_sim.mesh.replica import BYTES_PER_NODE, MAX_NODES, MeshReplica
from cutting_trainer.tissue_sim.streaming.messages import mesh_message

MESH_REPLY_TIMEOUT_S = 1.0
"""Time after which a request for the full mesh is repeated."""
STALE_REVISION_TIMEOUT_S = 0.5
"""Time of nothing but old revisions after which they count as those of a restarted simulation, or
the replica's own revision as invalid."""
MAX_MESSAGES_PER_POLL = 200
"""Messages of a topic taken by one `poll`: it ends even in a flood."""


def max_nodes_parameter(node: Node) -> int:
    """Return the size of the largest accepted mesh, parameter `max_nodes`."""
    text = 'nodes of a mesh that is accepted; of tetrahedra and triangles eight times as many [-]'
    return int(parameter(node, 'max_nodes', MAX_NODES, text, within=(4, 2**28)))


class MeshFollower:
    """A replica that follows `tissue/mesh` and `tissue/mesh_updates`; polled by one thread.

    Args:
        node: for the subscriptions.
        rejections: of that node.

    Attributes:
        replica: of the tissue.
        problem: sentence about the message that the last `poll` rejected, or ''.
        gaps: number of missed revisions, each followed by a request for the full mesh.
        checked: (revision, hash) of the last comparison with the sender's hash, the hash being the
            replica's own; (-1, 0) before the first.
        mismatches: number of comparisons that failed: the full mesh is loaded then.
        stale: number of rejected full meshes of an old revision, received while the present one
            continues.
    """

    def __init__(self, node: Node, rejections: RejectionStatistics) -> None:
        most = max_nodes_parameter(node)
        self.replica = MeshReplica(most)
        self.problem = ''
        self._largest = BYTES_PER_NODE * most
        self._rejections = rejections
        self.gaps = 0
        self.checked = (-1, 0)
        self.mismatches = 0
        self.stale = 0
        self._stamp = 0
        self._accepted = 0.0
        self._mesh = ros.polled(node, Mesh, ros.MESH, qos.LATCHED)
        self._updates = ros.polled(node, MeshDelta, ros.MESH_UPDATES, qos.UPDATES)
        self._client = node.create_client(GetMesh, ros.GET_MESH)
        self._answers: deque[Mesh] = deque(maxlen=2)
        self._asked = 0.0
        self._lock = threading.Lock()
        node.create_service(GetMesh, f'{node.get_name()}/get_mesh', self._serve)

    def _serve(self, _: GetMesh.Request, response: GetMesh.Response) -> GetMesh.Response:
        """Return the last known tissue, for the replacement of a dead `tissue_sim`."""
        with self._lock:
            replica = self.replica
            if replica.revision >= 0:
                response.mesh = mesh_message(
                    replica, replica.displacement, '', replica.revision, replica.step, self._stamp
                )
                response.success = True
        return response

    def poll(self) -> bool:
        """Apply all received messages; request the full mesh after one that does not fit.

        Returns:
            Whether the replica has changed.
        """
        known = self.replica.revision, self.replica.topology
        self.problem = ''
        with self._lock:
            self._take_all(self._mesh, ros.MESH, self._load)
            while self._answers:
                answer = self._answers.popleft()
                self._use(ros.GET_MESH, self._load, answer)
            self._take_updates()
        if self.problem:
            self.ask()
        return (self.replica.revision, self.replica.topology) != known

    def ask(self) -> None:
        """Request the full mesh, unless an answer is pending."""
        now = time.monotonic()
        if now - self._asked < MESH_REPLY_TIMEOUT_S or not self._client.service_is_ready():
            return
        self.gaps += not self._asked  # else the same gap, not answered yet
        self._asked = now
        self._client.call_async(GetMesh.Request()).add_done_callback(self._answered)

    def _take_updates(self) -> None:
        self._take_all(self._updates, ros.MESH_UPDATES, self._apply)

    def _take_all(self, subscription: Any, topic: str, use: Callable[[Any], None]) -> None:
        for _ in range(MAX_MESSAGES_PER_POLL):
            data = ros.take_raw(subscription)
            if data is None:
                return
            self._use(topic, lambda d: use(ros.read(d, subscription.msg_type, self._largest)), data)

    def _use(self, topic: str, use: Callable[[Any], None], given: Any) -> None:
        try:
            use(given)
        except ValueError as error:
            self._rejections.add(topic, error)
            self.problem = str(error)

    def _load(self, mesh: Mesh) -> None:
        require_frame(ros.MESH, mesh.header.frame_id)
        if self.replica.revision >= 0:
            self._take_updates()  # up to the revision of the full mesh, to compare
        # A keyframe can arrive after the deltas that follow it. An older revision with a younger
        # stamp is from a restarted simulation, once the deltas of the previous one have ended.
        # While these continue, it is from a simulation that was replaced without noticing.
        stamp = nanoseconds(mesh.header.stamp)
        younger = newer(mesh.revision, self.replica.revision)
        if mesh.revision == self.replica.revision and stamp >= self._stamp:
            younger = not self._agrees(mesh.state_hash)
            self._stamp = stamp
        elif not younger and stamp > self._stamp and not self._waits_in_vain():
            self.stale += 1
        if younger or self._waits_in_vain():
            self.replica.load(mesh)
            self._stamp, self._accepted = stamp, time.monotonic()

    def _apply(self, delta: MeshDelta) -> None:
        require_frame(ros.MESH_UPDATES, delta.header.frame_id)
        if not newer(delta.revision, self.replica.revision):
            if self._waits_in_vain():
                self.ask()
        elif self.replica.apply(delta):
            self._stamp = max(self._stamp, nanoseconds(delta.header.stamp))
            self._accepted = time.monotonic()
            if delta.state_hash and not self._agrees(delta.state_hash):
                self.ask()
        elif self.replica.revision >= 0:
            self.ask()

    def _agrees(self, state_hash: int) -> bool:
        """Return whether the sender's hash is that of the replica."""
        self.checked = (self.replica.revision, self.replica.hash())
        same = self.checked[1] == state_hash
        self.mismatches += not same
        return same

    def _waits_in_vain(self) -> bool:
        return time.monotonic() - self._accepted > STALE_REVISION_TIMEOUT_S

    def _answered(self, future: Any) -> None:
        response = future.result()
        if response is not None and response.success:
            self._answers.append(response.mesh)
            self._asked = 0.0
