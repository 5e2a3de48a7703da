"""Keeping a replica of the tissue up to date from the graph."""

import time
from collections import deque
from typing import Any

from cutting_trainer_msgs.msg import Mesh, MeshDelta
from cutting_trainer_msgs.srv import GetMesh
from rclpy.node import Node

from tissue_sim import ros
from tissue_sim.replica import MeshReplica

ANSWER_TIMEOUT = 1.0
"""[s] after which a question for the full mesh is asked again."""
PATIENCE = 0.5
"""[s] of nothing but old revisions after which they are those of a simulation started again, or the
revision here was never one."""


class MeshFollower:
    """A replica that follows `tissue/mesh` and `tissue/mesh_updates`, polled by one thread.

    Args:
        node: to subscribe with.

    Attributes:
        replica: of the tissue.
        gaps: how often a revision was missed, and the full mesh asked for.
    """

    def __init__(self, node: Node) -> None:
        self.replica = MeshReplica()
        self.gaps = 0
        self._stamp = 0
        self._accepted = 0.0
        self._mesh = ros.polled(node, Mesh, ros.MESH, ros.LATCHED)
        self._updates = ros.polled(node, MeshDelta, ros.MESH_UPDATES, ros.UPDATES)
        self._client = node.create_client(GetMesh, ros.GET_MESH)
        self._answers: deque[Mesh] = deque(maxlen=2)
        self._asked = 0.0

    def poll(self) -> bool:
        """Takes what has arrived.

        Returns:
            Whether the replica has changed.

        Raises:
            ValueError: a message does not fit; the replica is as before it.
        """
        known = self.replica.revision, self.replica.topology
        while (mesh := ros.take(self._mesh)) is not None:
            self._load(mesh)
        while self._answers:
            self._load(self._answers.popleft())
        while (delta := ros.take(self._updates)) is not None:
            self._apply(delta)
        return (self.replica.revision, self.replica.topology) != known

    def ask(self) -> None:
        """Asks for the full mesh, unless an answer is on its way."""
        now = time.monotonic()
        if now - self._asked < ANSWER_TIMEOUT or not self._client.service_is_ready():
            return
        self._asked = now
        self.gaps += 1
        self._client.call_async(GetMesh.Request()).add_done_callback(self._answered)

    def _load(self, mesh: Mesh) -> None:
        require_frame(ros.MESH, mesh.header.frame_id)
        # A keyframe can arrive after the deltas that follow it; an older revision of a younger
        # stamp is a simulation that has started again.
        stamp = _nanoseconds(mesh)
        younger = mesh.revision > self.replica.revision or stamp > self._stamp
        if younger or self._waits_in_vain():
            self.replica.load(mesh)
            self._stamp, self._accepted = stamp, time.monotonic()

    def _apply(self, delta: MeshDelta) -> None:
        require_frame(ros.MESH_UPDATES, delta.header.frame_id)
        if delta.revision <= self.replica.revision:
            if self._waits_in_vain():
                self.ask()
        elif self.replica.apply(delta):
            self._stamp = max(self._stamp, _nanoseconds(delta))
            self._accepted = time.monotonic()
        elif self.replica.revision >= 0:
            self.ask()

    def _waits_in_vain(self) -> bool:
        return time.monotonic() - self._accepted > PATIENCE

    def _answered(self, future: Any) -> None:
        response = future.result()
        if response is not None and response.success:
            self._answers.append(response.mesh)
            self._asked = 0.0


def require_frame(topic: str, frame: str) -> None:
    """Refuses what is not in the tissue's frame.

    Raises:
        ValueError: it is in another.
    """
    if frame != ros.FRAME:
        raise ValueError(
            f'{topic} has the frame_id {frame!r}, but forces are felt in {ros.FRAME!r}'
        )


def _nanoseconds(message: Mesh | MeshDelta) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)
