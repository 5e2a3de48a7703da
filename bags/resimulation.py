"""Re-simulation of a session from its bag; no ROS.

A frame depends on the state before it, on the newest contact at its start, and on the answer to a
cut that it received. `tissue/frame_inputs` names both for every frame.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.recorded_frames import FrameRecord
from cutting_trainer.cutting.method_interface import (
    FAILURES,
    CutMethod,
    CutResult,
    SweepError,
    carry_out,
    outcome_of,
)
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import CutOutcome, Frame, ToolContact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, Touched
from cutting_trainer.tissue_sim.simulation.cut_transaction import ANSWER_FRAMES, CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

LACKS_MEMORY = 'the bag lacks the state of the cutting service at its start: no cut can be made'


class Resimulation:
    """The simulation and the cutting service with its own mesh, as in a live session.

    Args:
        simulation: of the scene, before its first frame.
        method: of cutting.

    Attributes:
        area: of the incision, one side, at rest [m^2].
        touched: changes of the last cut, None before the first.
        substeps, diverged: number of substeps of all frames, and of frames that were rolled back.
        lacks_memory: the state of the cutting service is not known: no recorded cut can be made.
        answer_frames: for the number of a frame that requests a cut, the number of frames until
            `answer` applies the answer; another than the default for bags of format 2 alone.
    """

    def __init__(self, simulation: TissueSimulation, method: CutMethod) -> None:
        self.simulation = simulation
        self.area = 0.0
        self.touched: Touched | None = None
        self.substeps = self.diverged = 0
        self.lacks_memory = False
        self.answer_frames: Callable[[int], int] = lambda step: ANSWER_FRAMES
        self._method = method
        self._cut = CutTransaction(simulation)
        self._displacement = simulation.displacement
        self._begin_anew()

    def _begin_anew(self) -> None:
        mesh = self.simulation.mesh
        self._method.abort()
        self._mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.fixed, mesh.regions)
        self._mesh.topology = mesh.topology
        self._mesh.set_kinds(mesh.triangles, mesh.triangle_kind)
        self._outdated = False

    def remember(self, method: CutMethod, mesh: TetMesh) -> None:
        """Set the state of the cutting service: its method in a stroke, and its mesh."""
        self._method, self._mesh = method, mesh

    def take_answer(self, answer: int) -> str:
        """Apply the recorded answer to a cut in its recorded frame, whatever the protocol.

        Args:
            answer: as recorded.

        Returns:
            Why that is not possible, '' when it is.
        """
        outcome, asked = CutOutcome(answer), self._cut.asked
        if outcome is CutOutcome.NO_ANSWER:
            return ''
        if asked is None:
            return 'a cut was answered that is not requested now'
        if outcome not in (CutOutcome.APPLIED, CutOutcome.EMPTY):
            self._resolve(outcome, CutResult.nothing())
            return ''
        if self.lacks_memory:
            return LACKS_MEMORY
        assert asked.command is not None
        mesh, positions = self._as_cutting_has_it()
        try:
            result = carry_out(self._method, mesh, positions, asked.command, asked.sweep)
        except SweepError as error:
            return f'the cut of frame {asked.step} was made, and is rejected now: {error}'
        except FAILURES as error:
            return f'the cut of frame {asked.step} was made, and fails now: {error}'
        if result.delta.empty != (outcome is CutOutcome.EMPTY):
            then, now = ('something', 'nothing') if result.delta.empty else ('nothing', 'something')
            return f'the cut of frame {asked.step} changed {then}, and changes {now} now'
        self._resolve(outcome, result)
        return ''

    def answer(self) -> int:
        """Make the requested cut, if it is due; return its result, as it is recorded."""
        asked = self._cut.asked
        if asked is None or asked.command is None or not self._cut.due:
            return CutOutcome.NO_ANSWER
        mesh, positions = self._as_cutting_has_it()
        outcome, result = outcome_of(self._method, mesh, positions, asked.command, asked.sweep)
        self._resolve(outcome, result)
        return outcome

    def frame(self, *contacts: ToolContact | None, concession: int = 0) -> Frame:
        """Compute a frame under the contacts of the tools; `concession` as of a `Frame`."""
        frame = self.simulation.frame(*contacts, concession=concession)
        self.substeps += frame.substeps
        self.diverged += frame.diverged
        if self._cut.ask(frame, self.answer_frames(frame.step)):
            self._displacement = self.simulation.displacement.copy()
        return frame

    def _as_cutting_has_it(self) -> tuple[TetMesh, np.ndarray]:
        """Return the mesh of the cutting service, and its node positions at the request [m]."""
        if self._outdated:
            self._begin_anew()
        return self._mesh, self._mesh.rest + self._displacement

    def _resolve(self, outcome: CutOutcome, result: CutResult) -> None:
        self.area += result.report.area
        self._outdated |= outcome in (CutOutcome.LOST, CutOutcome.GIVEN_UP)
        if outcome is CutOutcome.APPLIED:
            self._mesh.apply(result.delta)
        touched = self._cut.resolve(outcome, result.delta)
        self.touched = touched or self.touched


def as_recorded(records: Sequence[FrameRecord], computed: Resimulation) -> Iterator[Frame]:
    """Compute frames from their recorded inputs.

    Args:
        records: of the frames, from the first.
        computed: before its first frame.

    Raises:
        BagError: a frame cannot be computed.
    """
    for record in records:
        if record.step != (step := computed.simulation.step + 1):
            raise BagError(f'the bag lacks frame {step}: nothing after it can be computed')
        if what := computed.take_answer(record.answer):
            raise BagError(f'frame {record.step} cannot be computed again: {what}')
        if lacks := lacking_contact(record):
            raise BagError(f'frame {record.step} cannot be computed again: {lacks}')
        contacts = recorded_contacts(record, computed.simulation.mesh)
        yield computed.frame(*contacts, concession=record.concession)


def lacking_contact(record: FrameRecord) -> str:
    """Return why the contacts of a frame are not all known; '' where they are."""
    for number, tool in enumerate(record.by_tool):
        of = f' of tool {number}' if number else ''
        if tool is None:
            return f'the bag lacks the inputs{of}'
        if tool.has_contact and tool.contact is None:
            return f'the bag lacks the contact{of} that loaded this frame'
    return ''


def recorded_contacts(record: FrameRecord, mesh: TetMesh) -> list[ToolContact | None]:
    """Return the contact of each tool with a frame.

    Args:
        record: of the frame, which lacks none of them.
        mesh: before that frame.

    Raises:
        MessageError: a contact is refused now.
    """
    return [
        tool_contact(tool.contact, mesh, number) if tool and tool.contact else None
        for number, tool in enumerate(record.by_tool)
    ]


def answer_frames(records: Sequence[FrameRecord]) -> Callable[[int], int]:
    """Return the delay of a cut's answer in frames, by the protocol of the session.

    Before format 3 answers were applied on arrival: the delay is then the recorded one of the last
    cut requested before.

    Args:
        records: of its frames.

    Returns:
        A function of the number of the requesting frame.
    """
    fixed = max((record.answer_frames for record in records), default=ANSWER_FRAMES)
    answered = [record for record in records if record.cut_step]
    if fixed or not answered:
        return lambda step: fixed or ANSWER_FRAMES
    asked = [record.cut_step for record in answered]
    frames = [record.step - record.cut_step for record in answered]
    return lambda step: frames[max(bisect_right(asked, step) - 1, 0)]
