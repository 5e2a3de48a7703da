"""The tissue from frame to frame: loads, substeps, reaction on the tool, the decision to cut."""

from dataclasses import replace

import numpy as np

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Blade, Resistance, Sweep
from tissue_sim.contact import Command, Frame, State, ToolContact
from tissue_sim.contact_stiffness import ContactStiffness, spring_of
from tissue_sim.coupling import FREE, PUSH, Coupling
from tissue_sim.dynamics import Dynamics, Motion, TimeStepping
from tissue_sim.elasticity import ElasticModel, ModelName
from tissue_sim.guard import TOOL_SPEED
from tissue_sim.locate import distance_to_triangles, locate_points
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh, TopologyDelta, Touched


class TissueSimulation:
    """Owns the tissue: integrates it under the tool, and asks for cuts.

    The same mesh, contacts and cuts, frame by frame, give the same numbers bit for bit.

    Args:
        mesh: the tissue; changed by `apply_cut` only.
        material: its constants.
        resistance: against the blade.
        model: its elasticity.
        stepping: how frames are stepped through.
        active: which nodes move.
        stretch: by how much the fixed nodes are pulled apart along x, y and z before the session
            (0.05: by 5 %): the tissue's own tension, under which a cut opens.

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
    ) -> None:
        self.mesh = mesh
        self.material = material
        self.dynamics = Dynamics(mesh, material, model, stepping, active)
        self.step = 0
        self.state = State.NONE
        self.elements_cut = 0
        self._resistance = resistance
        self._frame_time = 1.0 / self.dynamics.stepping.rate
        self._stiffness = ContactStiffness(self.dynamics)
        self._blade: Blade | None = None
        self._target: np.ndarray | None = None
        self._device: np.ndarray | None = None
        self._moved = np.zeros(3)
        self._outstanding: Command | None = None
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

    def resume(self, displacement: np.ndarray, step: int) -> None:
        """Goes on from a shape and a frame, at rest, with no tool in it.

        Args:
            displacement: [m], shape (n, 3).
            step: frame that the shape is of.
        """
        self.dynamics.resume(displacement)
        self.step = step

    def frame(self, contact: ToolContact | None) -> Frame:
        """Simulates one frame.

        Args:
            contact: the newest word of the haptic bridge, or None.

        Returns:
            The frame; with `command` set it expects `apply_cut` or `cut_failed` later.
        """
        self.step += 1
        jump = self._jump(contact)
        coupling = self._couple(None if jump else contact, self.positions)
        motion = self.dynamics.advance(coupling)
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
        )
        if motion.diverged or jump:
            self._let_go()
            return replace(frame, state=self.state, command=self._next_finish())
        command, sweep = self._decide(contact, coupling)
        force = self._reaction(coupling, motion)
        outside = contact if self._blade is None else None
        return replace(
            frame,
            state=self.state,
            force=force,
            stiffness=self._stiffness.matrix(coupling, outside, self._moved, force),
            resistance=self._blade.limit if self._blade else 0.0,
            command=command,
            sweep=sweep,
        )

    def _jump(self, contact: ToolContact | None) -> str:
        """Why the tool is not believed; empty: it is."""
        before = self._device
        self._device = None if contact is None else contact.device.copy()
        self._moved = np.zeros(3)
        if before is None or contact is None:
            return ''
        self._moved = contact.device - before
        speed = float(np.linalg.norm(self._moved)) / self._frame_time
        if speed <= TOOL_SPEED:
            return ''
        return (
            f'the tool has moved by {1e3 * speed * self._frame_time:.3g} mm within a frame: '
            f'{speed:.3g} m/s are above the {TOOL_SPEED:g} m/s of a hand'
        )

    def _couple(self, contact: ToolContact | None, positions: np.ndarray) -> Coupling:
        if self._blade is not None:
            if contact is None:
                return Coupling()
            return self._blade.couple(
                self.mesh, positions, contact.blade_root, contact.blade_tip, contact.stiffness
            )
        if (
            contact is None
            or contact.state != State.TOUCHING
            or contact.topology != self.mesh.topology
        ):
            self._target = None
            return Coupling()
        coupling = self._pushed_by(contact, positions)
        self._target = contact.device - contact.offset
        return coupling

    def _pushed_by(self, contact: ToolContact, positions: np.ndarray) -> Coupling:
        """The spring of a contact.

        Along the surface it starts relaxed: the tissue sticks to the tool within a frame and slips
        between frames.
        """
        coupling, n = spring_of(contact), contact.normal
        point = coupling.point(positions)
        start = point if self._target is None else self._target
        coupling.start = point + n * float((start - point) @ n)
        coupling.end = point + n * float((coupling.end - point) @ n)
        return coupling

    def _decide(
        self, contact: ToolContact | None, coupling: Coupling
    ) -> tuple[Command | None, Sweep | None]:
        if self._blade is None:
            self.state = State.TOUCHING if coupling.mode == PUSH else State.NONE
            if coupling.mode == PUSH and contact is not None:
                pressed = float(np.linalg.norm(coupling.force(self.positions)))
                if pressed >= self._resistance.threshold:
                    self._let_in(contact, coupling)
            return self._next_finish(), None
        self._blade.yield_after(self.mesh, self.positions)
        if contact is not None and (contact.state == State.NONE or self._clear(contact)):
            self._let_go()
            return self._next_finish(), None
        finish = self._next_finish()  # of the stroke before
        sweep = self._blade.sweep()
        if self._outstanding is not None or sweep is None:
            return finish, None
        self._blade.swept()
        self._outstanding = Command.ADVANCE
        return Command.ADVANCE, sweep

    def _next_finish(self) -> Command | None:
        """FINISH, until it is answered, as soon as no other answer is awaited."""
        if not self._finish_due or self._outstanding is not None:
            return None
        self._finish_due = False
        self._outstanding = Command.FINISH
        return Command.FINISH

    def _let_go(self) -> None:
        self._finish_due |= self._blade is not None
        self._blade = None
        self._target = None
        self.state = State.NONE

    def _clear(self, contact: ToolContact) -> bool:
        """Whether the blade has left, and the tip's sphere touches nothing: nothing jumps then."""
        if self._blade is None or self._blade.immersed > 0.0:
            return False
        positions, mesh = self.positions, self.mesh
        if distance_to_triangles(contact.device, positions, mesh.triangles) <= contact.radius:
            return False
        found = np.empty(1, np.int64)
        tip = contact.device[None]
        locate_points(positions, mesh.tetrahedra, mesh.neighbors, tip, 0, found, np.empty((1, 4)))
        return bool(found[0] < 0)

    def _let_in(self, contact: ToolContact, coupling: Coupling) -> None:
        entry = coupling.point(self.positions)
        hint = int(self.mesh.star(int(coupling.nodes[0]))[0])
        self._blade = Blade(self._resistance, contact.blade_root, contact.blade_tip, entry, hint)
        self.state = State.INSIDE

    def _reaction(self, coupling: Coupling, motion: Motion) -> np.ndarray:
        """Force of the tissue on the tool [N], shape (3,)."""
        if coupling.mode == FREE:
            return np.zeros(3)
        internal = motion.elastic_force[coupling.nodes]
        if self.material.beta:
            viscous = self.model.product(self.velocity, coupling.nodes)
            internal = internal + self.material.beta * viscous
        return np.asarray(-internal.sum(axis=0))

    def apply_cut(self, delta: TopologyDelta) -> Touched:
        """Carries a change of connectivity out; displacement and velocity are interpolated.

        Args:
            delta: the answer of the cutting service to the last command.

        Returns:
            What was written.

        Raises:
            MeshError: the change does not fit the mesh.
        """
        self._outstanding = None
        touched = self.dynamics.apply_cut(delta)
        self.elements_cut += len(delta.removed_tetrahedra)
        return touched

    def cut_done(self) -> None:
        """The cutting service had nothing to change, or will never do what it was asked."""
        self._outstanding = None

    def cut_failed(self) -> None:
        """The cutting service gave no answer, or refused: it is asked again (`Blade.unswept`)."""
        failed, self._outstanding = self._outstanding, None
        if failed == Command.FINISH:
            self._finish_due = True
        elif failed == Command.ADVANCE and self._blade is not None:
            self._blade.unswept()
