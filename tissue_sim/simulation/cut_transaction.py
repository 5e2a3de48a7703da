"""A cut, from the frame that requests it to the frame that applies the answer.

The node, re-simulation and single-process sessions share this protocol. It counts frames and knows
no clock: an answer is applied a fixed number of frames after its request, and a late answer is
waited for. A cut therefore does not depend on the load of the machine. Meanwhile the blade's sweeps
add up to one (`TissueSimulation`), so requests follow from frames alone, too.
"""

from dataclasses import dataclass

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.contact.tool import CutOutcome, Frame
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta, Touched
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

ANSWER_FRAMES = 1
"""Frames from the request of a cut to the application of its answer."""


@dataclass(frozen=True)
class Resolved:
    """Resolved cut at the beginning of a frame.

    Attributes:
        outcome: of the cut requested `ANSWER_FRAMES` before.
        cut_step: frame of the request; 0 without an answer.
        waited: delay of the frame by the answer [s].
        touched: changed slots of the mesh, None if it is unchanged.
    """

    outcome: CutOutcome = CutOutcome.NO_ANSWER
    cut_step: int = 0
    waited: float = 0.0
    touched: Touched | None = None


class CutTransaction:
    """The pending cut of a simulation, one at a time.

    Args:
        simulation: the requester.

    Attributes:
        asked: the requesting frame, None if no answer is pending.
    """

    def __init__(self, simulation: TissueSimulation) -> None:
        self._simulation = simulation
        self._due = 0
        self.asked: Frame | None = None

    def ask(self, frame: Frame, answer_frames: int = ANSWER_FRAMES) -> bool:
        """Register the request of a frame, if it has one.

        Args:
            frame: the newest.
            answer_frames: frames until the answer is applied.

        Returns:
            Whether it requests anything.
        """
        if frame.command is None:
            return False
        self.asked = frame
        self._due = frame.step + answer_frames
        return True

    @property
    def due(self) -> bool:
        """Whether `resolve` must come before the next frame."""
        return self.asked is not None and self._simulation.step + 1 >= self._due

    def resolve(self, outcome: CutOutcome, delta: TopologyDelta | None = None) -> Touched | None:
        """Apply the outcome of the cut.

        Args:
            outcome: of the cut.
            delta: the change of connectivity, if APPLIED.

        Returns:
            Changed slots of the mesh, None if it is unchanged.

        Raises:
            MeshError: the change does not fit the mesh; the cut is LOST.
        """
        self.asked = None
        if outcome is CutOutcome.LOST:
            self._simulation.cut_failed()
        elif outcome is not CutOutcome.APPLIED:
            self._simulation.cut_done()
        else:
            assert delta is not None
            try:
                return self._simulation.apply_cut(delta)
            except MeshError:
                self._simulation.cut_failed()
                raise
        return None
