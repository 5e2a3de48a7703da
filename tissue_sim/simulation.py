"""The tissue from frame to frame: loads, substeps, reaction on the tool, the decision to cut."""

import enum
from dataclasses import dataclass

import numpy as np

from tissue_sim.blade import Blade, Resistance, Sweep
from tissue_sim.compliance import PointCompliance, solve_static
from tissue_sim.coupling import FREE, PUSH, Coupling
from tissue_sim.integrators import rk4_steps
from tissue_sim.locate import distance_to_triangles, locate_points
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh, TopologyDelta, Touched, grown, interpolated
from tissue_sim.stability import FrequencyBound, rk4_step_bound
from tissue_sim.tensor_mass import TensorMassModel

_AT_REST = 1e-9
"""[m/s] below which a tissue that nothing touches is at rest, when it stays so."""
_STILL_FRAMES = 10


class State(enum.IntEnum):
    """How the tool stands to the tissue; the numbers are those of the `Contact` message."""

    NONE = 0
    TOUCHING = 1
    INSIDE = 2


class Command(enum.IntEnum):
    """What the simulation asks of the cutting service; the numbers are those of `Cut`."""

    ADVANCE = 0
    FINISH = 1


@dataclass(frozen=True)
class ToolContact:
    """What the haptic bridge says about the tool, see `Contact.msg`; tissue frame, [m].

    Attributes:
        nodes, weights: that share the load, each once, shape (c,).
        offset: from the touched point to the proxy's centre [m], shape (3,).
    """

    state: State
    topology: int
    nodes: np.ndarray
    weights: np.ndarray
    device: np.ndarray
    offset: np.ndarray
    normal: np.ndarray
    stiffness: float
    radius: float
    blade_root: np.ndarray
    blade_tip: np.ndarray
    sequence: int = 0


@dataclass(frozen=True)
class Frame:
    """What one frame came to, see `ForceSample.msg`.

    Attributes:
        step: number of the frame, from 1.
        state: how the tool stands to the tissue.
        position: tool tip that the force belongs to [m], shape (3,).
        force: of the tissue on the tool [N], shape (3,).
        stiffness: - d force / d position [N/m], shape (3, 3).
        resistance: largest force that the blade transmits [N].
        kinetic_energy, elastic_energy: [J].
        substeps: how many.
        slow_motion: simulated time over frame time, 1 unless the substeps did not suffice.
        command: what is asked of the cutting service, or None.
        sweep: the blade's sweep with an ADVANCE.
        diverged: a node would have gone farther than the tissue is long, or nowhere finite; the
            frame has been taken back.
    """

    step: int
    state: State
    position: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    resistance: float
    kinetic_energy: float
    elastic_energy: float
    substeps: int
    slow_motion: float
    command: Command | None = None
    sweep: Sweep | None = None
    diverged: bool = False


@dataclass
class TissueState:
    """Displacement [m] and velocity [m/s] by coordinate, with spare room, shape (>= 3 n,)."""

    displacement: np.ndarray
    velocity: np.ndarray


class TissueSimulation:
    """Owns the tissue: integrates it under the tool, and asks for cuts.

    The same mesh, contacts and cuts, frame by frame, give the same numbers bit for bit.

    Args:
        mesh: the tissue; changed by `apply_cut` only.
        material: its constants.
        resistance: against the blade.
        rate: frames a second [Hz].
        safety: share of the stable step that is used.
        max_substeps: of a frame; beyond them the frame simulates less time, stably.
        stretch: by how much the fixed nodes are pulled apart along x, y and z before the session
            (0.05: by 5 %): the tissue's own tension, under which a cut opens.
        frequency_growth: how far cuts may raise the highest frequency before small nodes are
            integrated with more mass (see `FrequencyBound`); infinite: never.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: Material,
        resistance: Resistance,
        *,
        rate: float = 30.0,
        safety: float = 0.8,
        max_substeps: int = 200,
        stretch: tuple[float, float, float] = (0.0, 0.0, 0.0),
        frequency_growth: float = 3.0,
    ) -> None:
        self.mesh = mesh
        self.model = TensorMassModel(mesh, material)
        self.material = material
        self.step = 0
        self.state = State.NONE
        self.elements_cut = 0
        self._resistance = resistance
        self._frame_time = 1.0 / rate
        self._safety = safety
        self._max_substeps = max_substeps
        size = 3 * mesh.node_count
        self._state = TissueState(np.zeros(size), np.zeros(size))
        self._compliance = PointCompliance()
        self._blade: Blade | None = None
        self._target: np.ndarray | None = None
        self._load = Coupling()
        self._outstanding: Command | None = None
        self._finish_due = False
        self._still = 0
        self._step_bounds: dict[float, float] = {}
        self._largest = float(np.linalg.norm(np.ptp(mesh.rest, axis=0)))
        self._inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / self.model.mass), 3)
        self._inertia = self.model.mass.copy()
        self._work = np.zeros((6, size))
        self._frequency = FrequencyBound(self.model, self._inverse, frequency_growth)
        if any(stretch):
            self._stretch(np.array(stretch))

    def _stretch(self, stretch: np.ndarray) -> None:
        """Moves the fixed nodes apart and all others to where they are then in equilibrium."""
        fixed = self.mesh.fixed == 1
        middle = self.mesh.rest[fixed].mean(axis=0)
        u = self.displacement
        u[:] = (self.mesh.rest - middle) * stretch
        u[~fixed] += solve_static(self.model, self._inverse_mass > 0, -self.model.force(u))[~fixed]

    @property
    def displacement(self) -> np.ndarray:
        """Displacements [m], shape (n, 3); a view."""
        return self._state.displacement[: 3 * self.mesh.node_count].reshape(-1, 3)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], shape (n, 3); a view."""
        return self._state.velocity[: 3 * self.mesh.node_count].reshape(-1, 3)

    @property
    def positions(self) -> np.ndarray:
        """Current node positions [m], shape (n, 3); a new array."""
        return self.mesh.rest + self.displacement

    @property
    def omega(self) -> float:
        """Bound of the highest frequency that steps are chosen by [rad/s]."""
        return self._frequency.omega

    def _follow_cut(self, nodes: np.ndarray) -> None:
        """Brings what is kept by node up to date where a cut touched it, nodes of shape (r,)."""
        n = self.mesh.node_count
        if len(self._inertia) < n:
            self._inertia = grown(self._inertia, n)
            self._inverse = grown(self._inverse, 3 * len(self._inertia))
            self._work = np.zeros((6, 3 * len(self._inertia)))
        self._frequency.update(nodes, self._inverse_mass)
        self._inertia[nodes] = self._frequency.inertia(nodes)
        free = self.mesh.fixed[nodes] == 0
        inverse = np.where(free, 1.0 / self._inertia[nodes], 0.0)
        self._inverse_mass.reshape(-1, 3)[nodes] = inverse[:, None]

    @property
    def _inverse_mass(self) -> np.ndarray:
        """By coordinate, 0 where fixed [1/kg], shape (3 n,); a view."""
        return self._inverse[: 3 * self.mesh.node_count]

    def frame(self, contact: ToolContact | None) -> Frame:
        """Simulates one frame.

        Args:
            contact: the newest word of the haptic bridge, or None.

        Returns:
            The frame; with `command` set it expects `apply_cut` or `cut_failed` later.
        """
        self.step += 1
        self._frequency.refine()
        positions = self.positions
        coupling = self._couple(contact, positions)
        substeps, dt = self._substeps(coupling)
        before = (self._state.displacement.copy(), self._state.velocity.copy())
        self._integrate(coupling, dt, substeps)
        if not np.abs(self.displacement).max() < self._largest:  # also false for NaN
            return self._take_back(before, contact, substeps)
        command, sweep = self._decide(contact, coupling)
        force, kinetic, elastic = self._reaction(coupling)
        return Frame(
            step=self.step,
            state=self.state,
            position=np.zeros(3) if contact is None else contact.device,
            force=force,
            stiffness=self._stiffness(coupling),
            resistance=self._blade.limit if self._blade else 0.0,
            kinetic_energy=kinetic,
            elastic_energy=elastic,
            substeps=substeps,
            slow_motion=dt * substeps / self._frame_time,
            command=command,
            sweep=sweep,
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
        self._target = coupling.end
        self._load = coupling
        return coupling

    def _pushed_by(self, contact: ToolContact, positions: np.ndarray) -> Coupling:
        """The spring of a contact, half of it where it was in the last frame.

        A dent may tilt under the load so that the next contact is on its other side: spread over
        two frames, the load finds the middle. Along the surface the spring starts relaxed: the
        tissue sticks to the tool within a frame and slips between frames. Without either a soft
        hill under the tool swings from side to side.
        """
        coupling = Coupling(
            mode=PUSH,
            nodes=contact.nodes,
            weights=contact.weights,
            end=contact.device - contact.offset,
            normal=contact.normal,
            stiffness=contact.stiffness,
        )
        if self._target is None:
            start = coupling.point(positions)
        else:
            start = self._target
            before = coupling.point(positions)
            nodes, slots = np.unique(
                np.concatenate([coupling.nodes, self._load.nodes]), return_inverse=True
            )
            shares = np.concatenate([coupling.weights, self._load.weights]) / 2
            coupling.nodes, coupling.weights = nodes, np.bincount(slots, shares, len(nodes))
            coupling.end = coupling.end + coupling.point(positions) - before
        coupling.start = coupling.end + contact.normal * float(
            (start - coupling.end) @ contact.normal
        )
        return coupling

    def _substeps(self, coupling: Coupling) -> tuple[int, float]:
        square = self._frequency.omega**2
        if coupling.mode != FREE:
            inverse = self._inverse_mass[3 * coupling.nodes]
            square += coupling.stiffness * float(np.sum(coupling.weights**2 * inverse))
        # Rounded up, so that few different bounds are ever computed.
        omega = 1.01 ** np.ceil(np.log(np.sqrt(square)) / np.log(1.01))
        if omega not in self._step_bounds:
            m = self.material
            self._step_bounds[omega] = rk4_step_bound(omega, m.alpha, m.beta)
        dt = self._safety * self._step_bounds[omega]
        substeps = int(np.ceil(self._frame_time / dt))
        if substeps > self._max_substeps:
            return self._max_substeps, dt
        return substeps, self._frame_time / substeps

    def _integrate(self, coupling: Coupling, dt: float, substeps: int) -> None:
        size = 3 * self.mesh.node_count
        moving = self._state.velocity[:size]
        if coupling.mode == FREE and float(np.abs(moving).max()) < _AT_REST:
            # Decay would go on into denormal numbers, at a hundred times the cost.
            if self._still >= _STILL_FRAMES:
                moving[:] = 0.0
                return
            self._still += 1
        else:
            self._still = 0
        rk4_steps(
            self.model.operands,
            self._inverse_mass,
            np.array([self.material.alpha, self.material.beta]),
            coupling.weights @ self.mesh.rest[coupling.nodes],
            self._state.displacement[:size],
            self._state.velocity[:size],
            self._work,
            dt,
            substeps,
            coupling.mode,
            coupling.nodes,
            coupling.weights,
            np.array([coupling.start, coupling.end]),
            coupling.normal,
            np.array([coupling.stiffness, coupling.limit]),
        )

    def _take_back(
        self,
        before: tuple[np.ndarray, np.ndarray],
        contact: ToolContact | None,
        substeps: int,
    ) -> Frame:
        """The frame as if it had not been: the state before it, at rest, and the tool let go."""
        self._state.displacement, self._state.velocity = before[0], np.zeros_like(before[1])
        self._let_go()
        return Frame(
            step=self.step,
            state=self.state,
            position=np.zeros(3) if contact is None else contact.device,
            force=np.zeros(3),
            stiffness=np.zeros((3, 3)),
            resistance=0.0,
            kinetic_energy=0.0,
            elastic_energy=0.0,
            substeps=substeps,
            slow_motion=0.0,
            command=self._next_finish(),
            diverged=True,
        )

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
        self._blade.yield_after(self.positions)
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

    def _reaction(self, coupling: Coupling) -> tuple[np.ndarray, float, float]:
        u, v = self.displacement, self.velocity
        elastic = self.model.force(u)
        kinetic = 0.5 * float(self._inertia[: len(v)] @ np.square(v).sum(axis=1))
        energy = 0.5 * float(np.sum(u * elastic))
        if coupling.mode == FREE:
            return np.zeros(3), kinetic, energy
        viscous = self.model.force(v) if self.material.beta else np.zeros_like(u)
        internal = elastic[coupling.nodes] + self.material.beta * viscous[coupling.nodes]
        return -internal.sum(axis=0), kinetic, energy

    def _stiffness(self, coupling: Coupling) -> np.ndarray:
        if coupling.mode != PUSH:
            return np.zeros((3, 3)) if coupling.mode == FREE else coupling.stiffness * np.eye(3)
        n = coupling.normal
        load = np.outer(coupling.weights, n)
        soft = self._compliance.estimate(self.model, self._inverse_mass > 0, coupling.nodes, load)
        return np.outer(n, n) / (1.0 / coupling.stiffness + soft)

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
        self._still = 0
        n, total = self.mesh.node_count, self.mesh.node_count + len(delta.node_parents)
        touched = self.mesh.apply(delta)
        for name in ('displacement', 'velocity'):
            values = grown(getattr(self._state, name), 3 * total)
            setattr(self._state, name, values)
            rows = values[: 3 * total].reshape(-1, 3)
            new = interpolated(rows, delta.node_parents, delta.node_weights)
            moved = interpolated(rows, delta.moved_parents, delta.moved_weights)
            rows[n:total] = new
            rows[np.asarray(delta.moved_nodes, np.int64)] = moved
            for target, source in touched.renumbered:
                rows[target] = rows[source]
        self.model.update(touched.nodes)
        self._follow_cut(touched.nodes)
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
