"""A session computed again from its bag; no ROS.

A frame depends on the state before it, on the contact that was newest when it began, and on the
answer to a cut that it found. `tissue/frame_inputs` names both for every frame.
"""

import numpy as np

from bags.frames import APPLIED, EMPTY, GIVEN_UP, LOST, NO_ANSWER, REFUSED
from cutting.method import CutMethod, CutResult, SweepError, check_sweep
from tissue_sim.contact import Command, Frame, ToolContact
from tissue_sim.mesh import TetMesh, Touched
from tissue_sim.simulation import TissueSimulation


class Recomputation:
    """The simulation and, beside it, the cutting service with its own mesh, as live.

    Args:
        simulation: of the scene, before its first frame.
        method: of cutting.

    Attributes:
        area: of the incision, one side, at rest [m^2].
        touched: what the last change of connectivity wrote, None before the first.
    """

    def __init__(self, simulation: TissueSimulation, method: CutMethod) -> None:
        self.simulation = simulation
        self.area = 0.0
        self.touched: Touched | None = None
        self._method = method
        self._asked: tuple[Frame, np.ndarray] | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        mesh = self.simulation.mesh
        self._method.abort()
        self._mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.fixed)
        self._mesh.topology = mesh.topology
        self._mesh.set_kinds(mesh.triangles, mesh.triangle_kind)
        self._outdated = False

    def take_answer(self, answer: int) -> str:
        """Does what a frame found of a cut.

        Args:
            answer: as recorded.

        Returns:
            Why that cannot be, '' when all is well.
        """
        if answer == NO_ANSWER:
            return ''
        if self._asked is None:
            return 'a cut was answered that is not asked for now'
        frame, displacement = self._asked
        self._asked = None
        if answer in (REFUSED, LOST, GIVEN_UP):
            self._outdated |= answer != REFUSED
            if answer == LOST:
                self.simulation.cut_failed()
            else:
                self.simulation.cut_done()
            return ''
        try:
            result = self._cut(frame, displacement)
        except SweepError as error:
            return f'the cut of frame {frame.step} was made, and is refused now: {error}'
        if result.delta.empty != (answer == EMPTY):
            done = ('something', 'nothing')[answer == EMPTY]
            return f'the cut of frame {frame.step} changed {done}, and does not so now'
        self._apply(result)
        return ''

    def answer(self) -> int:
        """Cuts what was asked for, if anything was; returns what came of it, as recorded."""
        if self._asked is None:
            return NO_ANSWER
        (frame, displacement), self._asked = self._asked, None
        try:
            result = self._cut(frame, displacement)
        except SweepError:
            self.simulation.cut_done()
            return REFUSED
        self._apply(result)
        return EMPTY if result.delta.empty else APPLIED

    def frame(self, contact: ToolContact | None) -> Frame:
        """Computes a frame."""
        frame = self.simulation.frame(contact)
        if frame.command is not None:
            self._asked = (frame, self.simulation.displacement.copy())
        return frame

    def _cut(self, frame: Frame, displacement: np.ndarray) -> CutResult:
        if self._outdated:
            self._begin_anew()
        positions = self._mesh.rest + displacement
        if frame.command == Command.FINISH:
            return self._method.finish(self._mesh, positions)
        assert frame.sweep is not None
        check_sweep(frame.sweep)
        return self._method.advance(self._mesh, positions, frame.sweep)

    def _apply(self, result: CutResult) -> None:
        self.area += result.report.area
        if result.delta.empty:
            self.simulation.cut_done()
        else:
            self._mesh.apply(result.delta)
            self.touched = self.simulation.apply_cut(result.delta)
