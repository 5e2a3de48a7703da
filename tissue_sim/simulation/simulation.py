"""Simulation of the tissue frame by frame: loads, substeps, reaction on the tool, cut requests."""

from dataclasses import replace

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import NOT_TURNED, Blade, Resistance, Sweep
from cutting_trainer.tissue_sim.contact.coupling import FREE, PUSH, Coupling
from cutting_trainer.tissue_sim.contact.cut_contact import CUT_FRICTION
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction, GrippingSprings
from cutting_trainer.tissue_sim.contact.tool import ContactState, CutCommand, Frame, ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName, ToolSprings, footprint_force
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.locate import distance_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.divergence import MAX_TOOL_SPEED
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics, TimeStepping
from cutting_trainer.tissue_sim.motion.frame_motion import FrameMotion
from cutting_trainer.tissue_sim.simulation.local_stiffness import (
    ContactStiffness,
    GrippingStiffness,
)
from cutting_trainer.tissue_sim.simulation.within_frame import Dent, ToolInFrame


class TissueSimulation:
    """Integrates the tissue under the tool and requests cuts.

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
    ) -> None:
        self.mesh = mesh
        self.material = material
        self.dynamics = Dynamics(mesh, material, model, stepping, active, gravity, CUT_FRICTION)
        self.step = 0
        self.state = ContactState.NONE
        self.elements_cut = 0
        self._resistance = resistance
        self._frame_time = 1.0 / self.dynamics.stepping.rate
        self._springs = ToolSprings(mesh, material.plane_modulus, contact)
        told = ContactStiffness
        if friction.sliding > 0.0:
            self._springs = GrippingSprings(mesh, material.plane_modulus, contact, friction)
            told = GrippingStiffness
        self._stiffness = told(self.dynamics, self._springs)
        self._pressed = 0.0
        self._dent = Dent()
        self._blade: Blade | None = None
        self._target: np.ndarray | None = None
        self._device: np.ndarray | None = None
        self._edge: np.ndarray | None = None
        self._moved = np.zeros(3)
        self._outstanding: CutCommand | None = None
        self._finish_due = False
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
    def blade(self) -> Blade | None:
        """The blade in the tissue; None: it is outside."""
        return self._blade

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

    def frame(self, contact: ToolContact | None) -> Frame:
        """Simulate one frame.

        Args:
            contact: newest contact of the haptic bridge, or None.

        Returns:
            The frame; with `command` set, an answer must follow (`CutTransaction`).
        """
        self.step += 1
        jump = self._jump(contact)
        tool = self._tool(None if jump else contact)
        coupling = Coupling() if tool is None else tool.coupling
        motion = self.dynamics.advance(coupling, tool)
        if tool is not None:
            self._blade, coupling, self._dent = tool.blade, tool.coupling, tool.dent
        elif contact is None or jump or contact.state != ContactState.TOUCHING:
            self._dent = Dent()
        pressed = self._push_of(coupling)
        self._pressed = footprint_force(self._pressed, pressed)
        self._springs.end_frame(coupling, self.displacement, pressed)
        frame = Frame(
            step=self.step,
            state=self.state,
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
        )
        if motion.diverged or jump:
            self._release_blade()
            return replace(frame, state=self.state, command=self._next_finish())
        command, sweep = self._decide(contact, coupling)
        force = self._reaction(coupling, motion)
        outside = contact if self._blade is None else None
        stiffness = self._stiffness.matrix(coupling, outside, self._moved, force)
        if self._blade is not None:
            self._blade.note_stiffness(stiffness)
        return replace(
            frame,
            state=self.state,
            force=force,
            stiffness=stiffness,
            resistance=self._blade.limit if self._blade else 0.0,
            turning=self._blade.turning if self._blade else NOT_TURNED,
            command=command,
            sweep=sweep,
        )

    def _jump(self, contact: ToolContact | None) -> str:
        """Return why a contact is implausible, or ''."""
        before = self._device
        self._device = None if contact is None else contact.device.copy()
        self._moved = np.zeros(3)
        if before is None or contact is None:
            return ''
        self._moved = contact.device - before
        speed = float(np.linalg.norm(self._moved)) / self._frame_time
        if speed <= MAX_TOOL_SPEED:
            return ''
        return (
            f'the tool has moved by {1e3 * speed * self._frame_time:.3g} mm within a frame: '
            f'{speed:.3g} m/s are above the {MAX_TOOL_SPEED:g} m/s of a hand'
        )

    def _tool(self, contact: ToolContact | None) -> ToolInFrame | None:
        """Return the tool of this frame; None: nothing acts on the tissue."""
        edge, self._edge = self._edge, None
        if contact is None:
            self._target = None
            if self._blade is not None:
                self._blade.let_go()
            return None
        self._edge = np.array([contact.blade_root, contact.blade_tip])
        positions, pushing = self.positions, Coupling()
        if self._blade is not None:
            edge = self._blade.device
        elif contact.state == ContactState.TOUCHING and contact.topology == self.mesh.topology:
            pushing = self._pushed_by(contact, positions)
            self._target = contact.device - contact.offset
        else:
            self._target = None
            return None
        return ToolInFrame(
            self.mesh,
            self._resistance,
            contact,
            self._edge if edge is None else edge,
            pushing,
            self._blade,
            positions,
            self._frame_time,
            self.material.line_compliance,
            self._dent if pushing.mode == PUSH else Dent(),
        )

    def _pushed_by(self, contact: ToolContact, positions: np.ndarray) -> Coupling:
        """Return the spring of a contact.

        Along the surface it starts relaxed: the tissue sticks to the tool within a frame and slips
        between frames, unless there is friction (`GrippingSprings.drag`).
        """
        end, n = contact.device - contact.offset, contact.normal
        start = self._target
        if start is None:
            start = contact.weights @ positions[contact.nodes]
        coupling = self._springs.spring(contact, self._pressed, float((start - end) @ n))
        point = coupling.point(positions)
        start = point if self._target is None else start + (coupling.end - end)
        coupling.start = point + n * float((start - point) @ n)
        coupling.end = point + n * float((coupling.end - point) @ n)
        self._springs.drag(coupling, contact, point)
        return coupling

    def _push_of(self, coupling: Coupling) -> float:
        """Return the normal force of the tool on the surface [N]."""
        if coupling.mode != PUSH:
            return 0.0
        return max(-float(coupling.force(self.positions) @ coupling.normal), 0.0)

    def _decide(
        self, contact: ToolContact | None, coupling: Coupling
    ) -> tuple[CutCommand | None, Sweep | None]:
        if self._blade is None:
            self.state = ContactState.TOUCHING if coupling.mode == PUSH else ContactState.NONE
            return self._next_finish(), None
        self.state = ContactState.INSIDE
        if contact is not None and (contact.state == ContactState.NONE or self._clear(contact)):
            self._release_blade()
            return self._next_finish(), None
        finish = self._next_finish()  # of the stroke before
        sweep = self._blade.sweep()
        if self._outstanding is not None or sweep is None:
            return finish, None
        self._blade.confirm_sweep()
        self._outstanding = CutCommand.ADVANCE
        return CutCommand.ADVANCE, sweep

    def _next_finish(self) -> CutCommand | None:
        """Return FINISH until it is answered, once no other answer is pending."""
        if not self._finish_due or self._outstanding is not None:
            return None
        self._finish_due = False
        self._outstanding = CutCommand.FINISH
        return CutCommand.FINISH

    def _release_blade(self) -> None:
        self._finish_due |= self._blade is not None
        self._blade = None
        self._target = None
        self.state = ContactState.NONE

    def _clear(self, contact: ToolContact) -> bool:
        """Return whether the blade has left and the tip's sphere touches nothing, so that no force
        jumps.
        """
        if self._blade is None or self._blade.immersed > 0.0:
            return False
        positions, mesh = self.positions, self.mesh
        if distance_to_triangles(contact.device, positions, mesh.triangles) <= contact.radius:
            return False
        tip = contact.device[None]
        found, _ = find_tetrahedra(positions, mesh.tetrahedra, mesh.neighbors, tip)
        return bool(found[0] < 0)

    def _reaction(self, coupling: Coupling, motion: FrameMotion) -> np.ndarray:
        """Return the force of the tissue on the tool [N], shape (3,)."""
        if self._blade is not None:
            return -self._blade.force
        if coupling.mode == FREE:
            return np.zeros(3)
        internal = motion.elastic_force[coupling.nodes]
        if self.material.beta:
            viscous = self.model.product(self.velocity, coupling.nodes)
            internal = internal + self.material.beta * viscous
        return np.asarray(-internal.sum(axis=0))

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
        self._springs.apply_cut(count, delta, touched)
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
        elif failed == CutCommand.ADVANCE and self._blade is not None:
            self._blade.retry_sweep()
