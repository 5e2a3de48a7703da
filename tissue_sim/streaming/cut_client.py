"""Client of the service `cutting/cut`: requests cuts and delays frames until they are answered."""

import time
from collections.abc import Callable
from typing import Any

from cutting_trainer_msgs.srv import Cut
from rclpy.node import Node

from cutting_trainer.node_common import ros
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.rejections import MessageError, RejectionStatistics
from cutting_trainer.tissue_sim.contact.tool import CutCommand, CutOutcome, Frame
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction, Resolved
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming import messages

CUT_TIMEOUT_S = 1.0
"""Longest delay of a frame; then the cut counts as lost."""
_POLL_S = 0.0005
"""Between two checks for the answer."""


class CutClient:
    """Client for the cuts of a simulation.

    After a lost cut the service is asked to abort the stroke. Until it confirms that, cuts are lost
    at once, and the tissue can be palpated meanwhile.

    Args:
        node: the client's node.
        simulation: of the tissue.
        rejections: statistics of lost and refused cuts.
    """

    def __init__(
        self, node: Node, simulation: TissueSimulation, rejections: RejectionStatistics
    ) -> None:
        self._client = node.create_client(Cut, ros.CUT)
        self._simulation = simulation
        self._rejections = rejections
        self._transaction = CutTransaction(simulation)
        self._future: Any = None
        self._sent = 0.0
        self._revision = 0
        self._abort: Any = None
        self._waited = self._longest = self._total = 0.0
        self._count = 0

    def follow(self, simulation: TissueSimulation) -> None:
        """Take another simulation, before its first frame; a pending cut is dropped.

        The service drops its stroke when it receives the mesh.
        """
        if self._future is not None:
            self._client.remove_pending_request(self._future)
        self._future, self._waited = None, 0.0
        self._simulation, self._transaction = simulation, CutTransaction(simulation)

    def ask(self, frame: Frame, revision: int) -> None:
        """Request the cut of a frame, if it has one.

        Args:
            frame: the newest.
            revision: of the mesh published for that frame.
        """
        self._revision = revision
        if not self._transaction.ask(frame) or not self._is_heard():
            return
        request = Cut.Request(command=int(frame.command or 0), revision=revision)
        if frame.sweep is not None:
            request.root_from, request.tip_from = frame.sweep.root_from, frame.sweep.tip_from
            request.root_to, request.tip_to = frame.sweep.root_to, frame.sweep.tip_to
        self._future, self._sent = self._client.call_async(request), time.monotonic()

    def request_state(self, revision: int, step: int) -> None:
        """Request the service's state before any further cut.

        Args:
            revision: of the published mesh.
            step: frame that begins from the state.
        """
        if not self._client.service_is_ready():
            self._no_state('the service is not there')
            return
        request = Cut.Request(command=Cut.Request.STATE, revision=revision, step=step)
        self._client.call_async(request).add_done_callback(self._state_answered)

    def _state_answered(self, future: Any) -> None:
        response = future.result()
        if response is not None and not response.success:
            self._no_state(response.error_msg)

    def _no_state(self, why: str) -> None:
        said = f'{why}: cuts in a bag that begins now cannot be re-simulated'
        self._rejections.add(ros.CUT, MessageError('no state', said))

    def wait(self, is_over: Callable[[], bool], meanwhile: Callable[[], None]) -> None:
        """Wait until the next frame can be computed: no cut is due, or it is answered or lost.

        Args:
            is_over: whether the node is to end or to rest.
            meanwhile: called repeatedly.
        """
        future, began = self._future, time.monotonic()
        if future is None or future.done() or not self._transaction.due:
            return
        while not future.done() and not is_over() and not self._is_late():
            meanwhile()
            time.sleep(_POLL_S)
        seconds = time.monotonic() - began
        self._count += 1
        self._waited += seconds
        self._total += seconds
        self._longest = max(self._longest, seconds)

    def take(self) -> Resolved:
        """Apply the outcome of the cut that is due before the next frame."""
        asked = self._transaction.asked
        if asked is None or not self._transaction.due:
            return Resolved()
        waited, self._waited = self._waited, 0.0
        outcome, delta = self._answer(asked)
        touched = None
        try:
            touched = self._transaction.resolve(outcome, delta)
        except MeshError as error:
            self._rejections.add(ros.CUT, error)
            outcome = CutOutcome.LOST
        if outcome is CutOutcome.LOST and self._abort is None and self._client.service_is_ready():
            self._begin_anew()
        return Resolved(outcome, asked.step, waited, touched)

    def values(self) -> dict[str, object]:
        """Return the number of delayed frames and their delay [s]."""
        return {
            'waited_for_cut': self._count,
            'waited_for_cut_seconds': self._total,
            'waited_for_cut_max': self._longest,
        }

    def _is_late(self) -> bool:
        return time.monotonic() - self._sent > CUT_TIMEOUT_S

    def _is_heard(self) -> bool:
        """Return whether the service is there."""
        if not self._client.service_is_ready():
            self._abort = None
            return False
        if self._abort is None or self._abort.done():
            self._abort = None
            return True
        if self._is_late():
            self._client.remove_pending_request(self._abort)
            self._begin_anew()
        return False

    def _begin_anew(self) -> None:
        """Make the service abort the stroke, part of which is lost."""
        request = Cut.Request(command=Cut.Request.ABORT, revision=self._revision)
        self._abort, self._sent = self._client.call_async(request), time.monotonic()

    def _answer(self, asked: Frame) -> tuple[CutOutcome, TopologyDelta | None]:
        future, self._future = self._future, None
        if future is None:
            return self._nobody(asked)
        if not future.done():
            self._client.remove_pending_request(future)
            said = f'no answer within {CUT_TIMEOUT_S:g} s: it is asked for again'
            self._rejections.add(ros.CUT, MessageError('no answer in time', said))
            return CutOutcome.LOST, None
        response = future.result()
        if response.error_code == Cut.Response.INVALID_SWEEP:
            text = f'{response.error_msg}: this sweep stays uncut'
            self._rejections.add(ros.CUT, MessageError('invalid sweep', text))
            return CutOutcome.REFUSED, None
        try:
            delta = self._usable(response)
        except ValueError as error:
            self._rejections.add(ros.CUT, error)
            return CutOutcome.LOST, None
        return (CutOutcome.EMPTY if delta.empty else CutOutcome.APPLIED), delta

    def _nobody(self, asked: Frame) -> tuple[CutOutcome, None]:
        if asked.command is CutCommand.FINISH:
            return CutOutcome.GIVEN_UP, None  # no service is there to remember the stroke
        text = 'the service is not there' if self._abort is None else 'the service is silent'
        self._rejections.add(ros.CUT, MessageError(text))
        return CutOutcome.LOST, None

    def _usable(self, response: Cut.Response) -> TopologyDelta:
        if not response.success:
            raise MessageError('no cut', response.error_msg)
        if response.topology != self._simulation.mesh.topology:
            raise MessageError('another topology', f'it is for topology {response.topology}')
        return messages.delta_from(response)
