"""Topics of one tool: its contact comes in, the inputs of each frame and its force go out."""

import time
from typing import Any

from cutting_trainer_msgs.msg import Contact, ForceSample, FrameInputs

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.publishers import PublisherMonitor
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import Frame, ToolContact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.cut_transaction import Resolved
from cutting_trainer.tissue_sim.streaming import messages

MAX_CONTACT_AGE_NS = 100_000_000


class ToolTopics:
    """Topics of a tool in the tissue.

    Args:
        node: to make them with.
        number: of the tool, by its place in the list of the scene.
        label: namespace of its topics, below the node's; '': the first tool, which has none.
    """

    def __init__(self, node: ManagedNode, number: int, label: str) -> None:
        self._node, self._number = node, number
        self._prefix = f'{label}/' if label else ''
        self._newest: Contact | None = None
        self._received = 0
        self._used: Contact | None = None
        # First, so that a recorder discovers them while the tissue is set up.
        self._forces = node.create_publisher(ForceSample, f'{self._prefix}{ros.FORCE}', qos.STREAM)
        self._inputs = node.create_publisher(
            FrameInputs, f'{self._prefix}{ros.FRAME_INPUTS}', qos.STREAM
        )

    def connect(self) -> None:
        """Subscribe to the contacts."""
        self._topic = f'{self._prefix}{ros.CONTACT}'
        self._contacts: Any = ros.polled(self._node, Contact, self._topic, qos.NEWEST_BEST_EFFORT)
        self._publishers = PublisherMonitor(self._node, [self._topic])

    @property
    def is_recorded(self) -> bool:
        """Whether somebody listens to the inputs of the frames, and somebody to its forces."""
        return all(p.get_subscription_count() > 0 for p in (self._inputs, self._forces))

    @property
    def cause(self) -> str:
        """Sentence about unexpected publishers of the contact, or ''."""
        return self._publishers.cause

    def contact(self, mesh: TetMesh) -> ToolContact | None:
        """Return the newest contact, None if there is none or it is too old or not valid."""
        self._used = None
        now = time.monotonic_ns()
        try:
            message = ros.take(self._contacts, self._node.max_message)
            if stranger := self._publishers.look(now * 1e-9):
                raise MessageError('more than one publisher', stranger)
            if message is not None:
                self._newest, self._received = message, now
            if self._newest is None or now - self._received > MAX_CONTACT_AGE_NS:
                return None
            contact = tool_contact(self._newest, mesh, self._number)
        except ValueError as error:
            self._node.rejections.add(self._topic, error)
            self._newest = None  # a message is rejected only once
            return None
        self._used = self._newest
        return contact

    def publish_inputs(self, frame: Frame, resolved: Resolved, time_ns: int) -> None:
        """Publish the inputs of a frame.

        Args:
            frame: as this tool feels it.
            resolved: the cut applied at its beginning.
            time_ns: stamp [ns].
        """
        self._inputs.publish(messages.inputs_message(frame, self._used, resolved, time_ns))

    def publish_force(self, frame: Frame, revision: int, topology: int, time_ns: int) -> None:
        """Publish the reaction on the tool.

        Args:
            frame: as this tool feels it.
            revision, topology: of the mesh.
            time_ns: stamp [ns].
        """
        self._forces.publish(messages.force_message(frame, revision, topology, self._used, time_ns))
