"""Subscriptions of the bridge to the simulation: forces for the loop, meshes in a thread."""

import threading
import time
from collections.abc import Callable

from cutting_trainer_msgs.msg import ForceSample

from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, StampedMessage
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.rejections import require_frame
from cutting_trainer.node_common.stream_monitor import StreamMonitor
from cutting_trainer.tissue_sim.streaming.mesh_follower import MeshFollower

_POLL_PERIOD_S = 0.003
"""[s] between two polls for a mesh that is due."""
_REVISION = ForceSampleCodec.fields['revision'].start


class SimulationFollower:
    """Follows the simulation: its forces in the fast loop, its meshes in a thread beside it.

    Decoding a mesh therefore delays no force.

    Args:
        node: to subscribe with.
        on_error: called with a sentence for each message that could not be used.

    Attributes:
        surface: the newest complete one; None before the first.
    """

    def __init__(self, node: ManagedNode, on_error: Callable[[str], None]) -> None:
        self.surface: Surface | None = None
        self._on_error = on_error
        self._rejections = node.rejections
        self._follower = MeshFollower(node, node.rejections)
        self._codec = ForceSampleCodec()
        self._watch = StreamMonitor(ros.FORCE, queues=True)
        self._late = 0
        self._revision = -1
        self._awaits_frame = threading.Lock()  # released by a force of another revision
        self._awaits_frame.acquire()
        self._force = ros.polled(node, ForceSample, ros.FORCE, qos.NEWEST_BEST_EFFORT)

    @property
    def report(self) -> dict[str, object]:
        """Return the figures for /diagnostics of the simulation's messages except the mesh's.

        For those of the mesh see `MeshFollower`.
        """
        revision, known = self._follower.checked
        return {
            'late_forces': self._late,
            'revision_gaps': self._follower.gaps,
            'mesh_checked_revision': revision,
            'mesh_checked_hash': f'{known:016x}',
            'mesh_mismatches': self._follower.mismatches,
            'stale_meshes': self._follower.stale,
        }

    @property
    def mesh_is_due(self) -> bool:
        """Return whether the newest force is of another revision than the surface: the mesh of a
        frame is sent just after its force.
        """
        return self.surface is None or self.surface.revision != self._revision

    def wait(self, timeout: float) -> None:
        """Wait until a mesh may have come, for a time at most [s]: each wake-up costs the loop."""
        if self.mesh_is_due:
            time.sleep(min(timeout, _POLL_PERIOD_S))
        else:
            self._awaits_frame.acquire(timeout=timeout)

    def cause(self, now_ns: int) -> str:
        """Return why the forces cannot be trusted at this time [ns]; '' if they can."""
        return self._watch.cause(now_ns)

    def take_force(self, now_ns: int) -> tuple[StampedMessage | None, int]:
        """Return the next force sample and its arrival time [ns], corrected for queueing delay.

        Args:
            now_ns: monotonic clock [ns].
        """
        try:
            taken = ros.take_numbered(self._force)
            if taken is None:
                return None, now_ns
            sample = self._codec.decode(taken[0])
            if sample.values[_REVISION] != self._revision:
                self._revision = sample.values[_REVISION]
                if self._awaits_frame.locked():
                    self._awaits_frame.release()
            require_frame(ros.FORCE, sample.frame_id)
            problem = self._watch.see(taken[1], sample.stamp_ns, now_ns)
        except Exception as error:
            self._refuse(ros.FORCE, error)
            return None, now_ns
        if problem:
            self._on_error(problem)
        if self._watch.late:
            self._late += 1
            return None, now_ns
        return sample, now_ns - self._watch.delay

    def follow_mesh(self) -> None:
        """Process the received meshes and updates."""
        try:
            self._take_surface()
        except Exception as error:
            self._refuse(ros.MESH, error)
            self._follower.ask()

    def _refuse(self, topic: str, error: Exception) -> None:
        self._rejections.add(topic, error)
        self._on_error(f'message of the simulation: {error}')

    def _take_surface(self) -> None:
        if self._follower.poll():
            self._renew()
        if self._follower.problem:
            self._on_error(f'message of the simulation: {self._follower.problem}')

    def _renew(self) -> None:
        replica = self._follower.replica
        self.surface = Surface(
            replica.positions(),
            replica.triangles,
            revision=replica.revision,
            topology=replica.topology,
            previous=self.surface,
        )
