"""Keeping a replica of the tissue up to date from the graph."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from cutting_trainer_msgs.msg import Mesh, MeshDelta
from cutting_trainer_msgs.srv import GetMesh
from rclpy.node import Node

from tissue_sim import ros
from tissue_sim.messages import mesh_message
from tissue_sim.parameters import max_nodes_parameter
from tissue_sim.refusals import Refusals, require_frame
from tissue_sim.replica import BYTES_A_NODE, MeshReplica
from tissue_sim.stamps import nanoseconds, newer

ANSWER_TIMEOUT = 1.0
"""[s] after which a question for the full mesh is asked again."""
PATIENCE = 0.5
"""[s] of nothing but old revisions after which they are those of a simulation started again, or the
revision here was never one."""
MOST_AT_ONCE = 200
"""Messages of a topic that one `poll` takes: in a flood, too, it comes to an end."""


class MeshFollower:
    """A replica that follows `tissue/mesh` and `tissue/mesh_updates`, polled by one thread.

    Args:
        node: to subscribe with.
        refusals: of that node.

    Attributes:
        replica: of the tissue.
        problem: why a message of the last `poll` was refused, as a sentence; '' if none was.
        gaps: how often a revision was missed, and the full mesh asked for.
        checked: (revision, hash) where the sender's hash was compared last, the hash being the
            replica's own; (-1, 0) before the first.
        mismatches: how often the two were not the same: the full mesh is taken then.
        stale: full meshes that were refused: of an old revision, while the present one goes on.
    """

    def __init__(self, node: Node, refusals: Refusals) -> None:
        most = max_nodes_parameter(node)
        self.replica = MeshReplica(most)
        self.problem = ''
        self._largest = BYTES_A_NODE * most
        self._refusals = refusals
        self.gaps = 0
        self.checked = (-1, 0)
        self.mismatches = 0
        self.stale = 0
        self._stamp = 0
        self._accepted = 0.0
        self._mesh = ros.polled(node, Mesh, ros.MESH, ros.LATCHED)
        self._updates = ros.polled(node, MeshDelta, ros.MESH_UPDATES, ros.UPDATES)
        self._client = node.create_client(GetMesh, ros.GET_MESH)
        self._answers: deque[Mesh] = deque(maxlen=2)
        self._asked = 0.0
        self._lock = threading.Lock()
        node.create_service(GetMesh, f'{node.get_name()}/get_mesh', self._serve)

    def _serve(self, _: GetMesh.Request, response: GetMesh.Response) -> GetMesh.Response:
        """The tissue as it was last, for a `tissue_sim` that takes the place of one that died."""
        with self._lock:
            replica = self.replica
            if replica.revision >= 0:
                response.mesh = mesh_message(
                    replica, replica.displacement, '', replica.revision, replica.step, self._stamp
                )
                response.success = True
        return response

    def poll(self) -> bool:
        """Takes what has arrived; of a message that does not fit it takes nothing, and asks.

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
        """Asks for the full mesh, unless an answer is on its way."""
        now = time.monotonic()
        if now - self._asked < ANSWER_TIMEOUT or not self._client.service_is_ready():
            return
        self.gaps += not self._asked  # else the same gap, and no answer yet
        self._asked = now
        self._client.call_async(GetMesh.Request()).add_done_callback(self._answered)

    def _take_updates(self) -> None:
        self._take_all(self._updates, ros.MESH_UPDATES, self._apply)

    def _take_all(self, subscription: Any, topic: str, use: Callable[[Any], None]) -> None:
        for _ in range(MOST_AT_ONCE):
            data = ros.take_raw(subscription)
            if data is None:
                return
            self._use(topic, lambda d: use(ros.read(d, subscription.msg_type, self._largest)), data)

    def _use(self, topic: str, use: Callable[[Any], None], given: Any) -> None:
        try:
            use(given)
        except ValueError as error:
            self._refusals.add(topic, error)
            self.problem = str(error)

    def _load(self, mesh: Mesh) -> None:
        require_frame(ros.MESH, mesh.header.frame_id)
        if self.replica.revision >= 0:
            self._take_updates()  # up to the revision that the full mesh lets us check
        # A keyframe can arrive after the deltas that follow it. An older revision with a younger
        # stamp is a simulation that has started again, once the deltas of the one before have
        # ended; while they come, it is one that was replaced, and does not know it.
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
        """Whether the sender has what is here."""
        self.checked = (self.replica.revision, self.replica.hash())
        same = self.checked[1] == state_hash
        self.mismatches += not same
        return same

    def _waits_in_vain(self) -> bool:
        return time.monotonic() - self._accepted > PATIENCE

    def _answered(self, future: Any) -> None:
        response = future.result()
        if response is not None and response.success:
            self._answers.append(response.mesh)
            self._asked = 0.0
