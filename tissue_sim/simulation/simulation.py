"""Simulation of the tissue frame by frame: loads, substeps, reaction on tools, cut requests."""

from dataclasses import replace

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import NOT_TURNED, Blade, Resistance, Sweep
from cutting_trainer.tissue_sim.contact.coupling import Coupling, held_nodes
from cutting_trainer.tissue_sim.contact.cut_contact import CUT_FRICTION
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction
from cutting_trainer.tissue_sim.contact.tool import ContactState, CutCommand, Frame, ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.frame_motion import FrameMotion
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.tool_state import ToolState
from cutting_trainer.tissue_sim.simulation.within_frame import ToolInFrame


class TissueSimulation:
    """Integrates the tissue under the tools and requests cuts.

    The same mesh, contacts and cuts, frame by frame, give the same numbers bit for bit.

    Args:
        mesh: the tissue; changed by `apply_cut` only.
        material: its constants.
        resistance: against the blade.
        model: its elasticity.
        stepping: how frames are stepped through.
        active: which nodes move.
        stretch: relative displacement of the fixed nodes along x, y and z before the session (0.05:
            by 5 %): the pre-tension under which a cut opens.
        contact: how the load of a tool is spread, see `ToolSprings`.
        friction: of the tool on the surface.
        gravity: acceleration [m/s^2]; `Dynamics.settle` finds the shape at rest under it.
        tools: how many there are.
        threads: that compute a frame, see `parallel_euler`.

    Attributes:
        tools: their states.

    Raises:
        ValueError: the integrator has no stable step with the material's damping.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: Material,
        resistance: Resistance,
        *,
        model: ModelName = 'linear',
        stepping: TimeStepping | None = None,
        active: ActiveSettings | None = None,
        stretch: tuple[float, float, float] = (0.0, 0.0, 0.0),
        contact: ContactName = 'footprint',
        friction: Friction = NO_FRICTION,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        tools: int = 1,
        threads: int = 1,
    ) -> None:
        self.mesh = mesh
        self.material = material
        self.dynamics = Dynamics(
            mesh, material, model, stepping, active, gravity, CUT_FRICTION, threads
        )
        self.step = 0
        self.elements_cut = 0
        self.tools = [ToolState(self.dynamics, resistance, contact, friction) for _ in range(tools)]
        self._outstanding: CutCommand | None = None
        self._finish_due = False
        self._left: Blade | None = None
        if any(stretch):
            self.dynamics.stretch(np.array(stretch))

    @property
    def model(self) -> ElasticModel:
        """The elastic model."""
        return self.dynamics.model

    @property
    def displacement(self) -> np.ndarray:
        """Displacements [m], shape (n, 3); a view."""
        return self.dynamics.displacement

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], shape (n, 3); a view."""
        return self.dynamics.velocity

    @property
    def positions(self) -> np.ndarray:
        """Current node positions [m], shape (n, 3); a new array."""
        return self.dynamics.positions

    @property
    def state(self) -> ContactState:
        """State of the first tool's contact."""
        return self.tools[0].state

    @property
    def blade(self) -> Blade | None:
        """The blade in the tissue; None: none is."""
        return next((tool.blade for tool in self.tools if tool.blade is not None), None)

    @property
    def awaits_answer(self) -> bool:
        """Whether a request to the cutting service is pending."""
        return self._outstanding is not None

    def resume(self, displacement: np.ndarray, step: int) -> None:
        """Continue from a shape at rest, without a tool in it.

        Args:
            displacement: [m], shape (n, 3).
            step: frame of the shape.
        """
        self.dynamics.resume(displacement)
        self.step = step

    def frame(self, *contacts: ToolContact | None, concession: int = 0) -> Frame:
        """Simulate one frame.

        Args:
            contacts: newest contact of each tool, or None; missing ones are None.
            concession: steps by which fewer nodes move on their own, see `Dynamics.concede`.

        Returns:
            The frame as the first tool feels it, with those of the others. With `command` set, an
            answer must follow (`CutTransaction`).

        Raises:
            ValueError: there are more contacts than tools.
        """
        if len(contacts) > len(self.tools):
            raise ValueError(f'{len(contacts)} contacts for {len(self.tools)} tools')
        given = [*contacts, *[None] * (len(self.tools) - len(contacts))]
        self.step += 1
        self.dynamics.concede(concession)
        jumps = [tool.jump(contact) for tool, contact in zip(self.tools, given, strict=True)]
        acting: list[ToolInFrame] = []
        in_frame: list[ToolInFrame | None] = []
        for tool, contact, jump in zip(self.tools, given, jumps, strict=True):
            begun = tool.begin(None if jump else contact, lambda: self._may_enter(acting))
            in_frame.append(begun)
            if begun is not None:
                acting.append(begun)
        motion = self.dynamics.advance(*(tool.coupling for tool in acting), tools=acting)
        couplings = [
            tool.end(contact, begun, jumped=bool(jump))
            for tool, contact, begun, jump in zip(self.tools, given, in_frame, jumps, strict=True)
        ]
        if self._left is not None:
            self._left.carry(self.positions)
        frames = [
            self._frame_of(number, contact, motion, couplings, jump)
            for number, (contact, jump) in enumerate(zip(given, jumps, strict=True))
        ]
        command, sweep = self._request()
        return replace(frames[0], command=command, sweep=sweep, others=tuple(frames[1:]))

    def _may_enter(self, acting: list[ToolInFrame]) -> bool:
        """Return whether a blade may go in.

        One at a time is in the tissue: a stroke of the cutting service has one blade. A second one
        presses on the surface until the first is out and its stroke has ended.
        """
        return (
            self._left is None and self.blade is None and all(tool.blade is None for tool in acting)
        )

    def _frame_of(
        self,
        number: int,
        contact: ToolContact | None,
        motion: FrameMotion,
        couplings: list[Coupling],
        jump: str,
    ) -> Frame:
        """Return the frame as a tool feels it."""
        tool, coupling = self.tools[number], couplings[number]
        frame = Frame(
            step=self.step,
            state=tool.state,
            position=np.zeros(3) if contact is None else contact.device,
            force=np.zeros(3),
            stiffness=np.zeros((3, 3)),
            resistance=0.0,
            kinetic_energy=motion.kinetic_energy,
            elastic_energy=motion.elastic_energy,
            substeps=motion.substeps,
            slow_motion=motion.slow_motion,
            diverged=motion.diverged,
            trouble=jump or motion.trouble,
            strain=motion.strain,
            tool=number,
            concession=self.dynamics.concession,
        )
        if motion.diverged or jump:
            self._finish_due |= tool.release() is not None
            return replace(frame, state=tool.state)
        if (left := tool.update(contact, coupling)) is not None:
            left.leave()
            self._left, self._finish_due = left, True
        others = held_nodes(couplings[:number] + couplings[number + 1 :])
        alone = not np.isin(others, coupling.nodes).any()
        force = tool.reaction(motion, coupling, alone=alone)
        blade = tool.blade
        return replace(
            frame,
            state=tool.state,
            force=force,
            stiffness=tool.stiffness(contact, coupling, force),
            resistance=tool.transmits,
            turning=blade.turning if blade else NOT_TURNED,
        )

    def _request(self) -> tuple[CutCommand | None, Sweep | None]:
        """Return what the cutting service is asked for; a stroke ends before the next begins."""
        if self._outstanding is not None:
            return None, None
        blade = self._sweeping
        sweep = None if blade is None else blade.sweep()
        if blade is not None and sweep is not None:
            blade.confirm_sweep()
            self._outstanding = CutCommand.ADVANCE
        elif self._finish_due:
            self._left, self._finish_due, self._outstanding = None, False, CutCommand.FINISH
        elif blade is not None:
            blade.sink()
        return self._outstanding, sweep

    @property
    def _sweeping(self) -> Blade | None:
        """The blade of the stroke: the one that has left, until the stroke ends."""
        return self._left if self._finish_due else self.blade

    def apply_cut(self, delta: TopologyDelta) -> Touched:
        """Apply a change of connectivity; displacement and velocity are interpolated.

        Args:
            delta: the answer of the cutting service to the last command.


        Returns:
            Changed slots of the mesh.

        Raises:
            MeshError: the change does not fit the mesh.
        """
        count = self.mesh.node_count
        touched = self.dynamics.apply_cut(delta)
        for tool in self.tools:
            tool.apply_cut(count, delta, touched)
        if self._left is not None:
            self._left.untie()
        self._outstanding = None
        self.elements_cut += len(delta.removed_tetrahedra)
        return touched

    def cut_done(self) -> None:
        """Confirm the sweep: the cutting service changed nothing, or refused it for good."""
        self._outstanding = None

    def cut_failed(self) -> None:
        """Retry the sweep: the cutting service gave no valid answer (`Blade.retry_sweep`)."""
        failed, self._outstanding = self._outstanding, None
        if failed == CutCommand.FINISH:
            self._finish_due = True
        elif failed == CutCommand.ADVANCE and (blade := self._sweeping) is not None:
            blade.retry_sweep()
