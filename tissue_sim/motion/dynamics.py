"""Dynamics of the tissue by frame: model, integrator, step, active region, divergence detector."""

from collections.abc import Sequence

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import (
    FREE,
    Coupling,
    Springs,
    Tool,
    held_nodes,
    springs_of,
)
from cutting_trainer.tissue_sim.contact.cut_contact import NO_CUT_CONTACTS, CutContact, CutContacts
from cutting_trainer.tissue_sim.contact.cut_contact_search import NO_NEAR_FACES, NearFaces
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.adjacency import spans_of
from cutting_trainer.tissue_sim.mesh.checks import EDGES, components
from cutting_trainer.tissue_sim.mesh.pieces import free_parts
from cutting_trainer.tissue_sim.mesh.tetra_mesh import (
    TetMesh,
    TopologyDelta,
    Touched,
    carried_over,
    grown,
)
from cutting_trainer.tissue_sim.motion.active_region import (
    ActiveRegion,
    ActiveSettings,
    Region,
)
from cutting_trainer.tissue_sim.motion.divergence import DivergenceDetector
from cutting_trainer.tissue_sim.motion.elastic_state import ElasticState
from cutting_trainer.tissue_sim.motion.far_field import SHARES, FarField
from cutting_trainer.tissue_sim.motion.frame_motion import FrameMotion
from cutting_trainer.tissue_sim.motion.loads import Loads
from cutting_trainer.tissue_sim.motion.nodal_mass import NodalMass
from cutting_trainer.tissue_sim.motion.parallel_euler import ParallelEuler, make_integrator
from cutting_trainer.tissue_sim.motion.stiffened_mass import SUBSTEPS_BETWEEN
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping, TimeSteps

_AT_REST = 1e-9
"""[m/s] below which an untouched tissue is at rest after `_STILL_FRAMES`."""
_STILL_FRAMES = 10
_DRAG = 10.0
"""Damping of loose pieces in proportion to mass, beside the tissue's own [1/s]: wet tissue sticks
to its bed, which is not simulated, within centimetres."""


class Dynamics:
    """Displacement and velocity of the tissue, and their integration.

    Args:
        mesh: the tissue; changed by `apply_cut` only.
        material: its constants.
        model: its elasticity.
        stepping: time stepping.
        active: selection of the moving nodes.
        gravity: acceleration [m/s^2].
        friction: coefficient between cut faces.
        threads: that compute a frame.

    Attributes:
        cut_contact: of cut faces; with `implicit` they do not meet.
        masses: of the nodes, with which they are integrated.
        time_steps: of a frame.

    Raises:
        ValueError: the integrator has no stable step with this damping.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: Material,
        model: ModelName = 'linear',
        stepping: TimeStepping | None = None,
        active: ActiveSettings | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        friction: float = 0.0,
        threads: int = 1,
    ) -> None:
        self.mesh = mesh
        self.cut_contact = CutContact(mesh, friction)
        self.material = material
        self.model = ElasticModel(mesh, material, model)
        loaded = bool(material.prony) or any(gravity)
        self._falls = any(gravity)
        self.loads = Loads(self.model, gravity) if loaded else None
        self.stepping = stepping or TimeStepping()
        damping = material.alpha, material.beta
        self._integrator = make_integrator(self.stepping.integrator, *damping, threads)
        size = 3 * mesh.node_count
        self._u, self._v = np.zeros(size), np.zeros(size)
        self.masses = NodalMass(self.model, self.stepping.frequency_growth)
        implicit = self.stepping.integrator == 'implicit'
        bounded = not self.model.rotating and not implicit
        self.time_steps = TimeSteps(self.stepping, material, self.masses, bounded=bounded)
        self._still = 0
        self._elastic = ElasticState(self.model)
        self._touched: list[np.ndarray] = []
        self._loose: np.ndarray | None = np.zeros(0, np.int64)  # None: not known since a cut
        self._detector = DivergenceDetector(mesh, material.youngs_modulus)
        active = active or ActiveSettings()
        self._far: FarField | None = None
        if active.mode == 'budget' and active.nodes < mesh.node_count:
            self._far = FarField(self.model, active.nodes)
        self._active = self._far or ActiveRegion(self.model, active, implicit=implicit)

    @property
    def displacement(self) -> np.ndarray:
        """Displacements [m], shape (n, 3); a view."""
        return self._u[: 3 * self.mesh.node_count].reshape(-1, 3)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], shape (n, 3); a view."""
        return self._v[: 3 * self.mesh.node_count].reshape(-1, 3)

    @property
    def positions(self) -> np.ndarray:
        """Current node positions [m], shape (n, 3); a new array."""
        return self.mesh.rest + self.displacement

    @property
    def concession(self) -> int:
        """Steps by which fewer nodes than chosen move on their own."""
        return 0 if self._far is None else self._far.concession

    @property
    def possible_concessions(self) -> int:
        """Number of steps that there are: none without a far field."""
        return 0 if self._far is None else len(SHARES) - 1

    def concede(self, steps: int) -> None:
        """Let fewer nodes of a far field move on their own; see `FarField.concede`."""
        if self._far is not None:
            self._far.concede(steps)

    @property
    def parallel(self) -> bool:
        """Whether several threads compute the steps in which all nodes move."""
        return isinstance(self._integrator, ParallelEuler) and (
            self.mesh.node_count >= self._integrator.min_nodes
        )

    @property
    def threads(self) -> int:
        """Return how many threads compute a step of the nodes that move now."""
        integrator, moving = self._integrator, self._active.count
        return integrator.threads_for(moving) if isinstance(integrator, ParallelEuler) else 1

    @property
    def active_nodes(self) -> int:
        """Number of moving nodes."""
        return self._active.count

    @property
    def inverted(self) -> int:
        """Number of inverted tetrahedra."""
        return self._detector.inverted(self.displacement)

    def stretch(self, stretch: np.ndarray) -> None:
        """Stretch the fixed nodes, and move the others to equilibrium.

        Args:
            stretch: along x, y and z (0.05: by 5 %), shape (3,).
        """
        fixed = self.mesh.fixed == 1
        middle = self.mesh.rest[fixed].mean(axis=0)
        u = self.displacement
        u[:] = (self.mesh.rest - middle) * stretch
        u[:] = equilibrium(self.model, np.zeros_like(u), start=u, tolerance=1e-9)
        self.restart()

    def settle(self) -> None:
        """Move to the shape at rest under weight, relaxed, with the fixed nodes where they are.

        Raises:
            MeshError: there is none.
        """
        if self.loads is not None:
            self.resume(self.loads.at_rest(self.displacement.copy()))

    @np.errstate(over='ignore', invalid='ignore')  # the numbers of a frame that diverges
    def advance(self, *couplings: Coupling, tools: Sequence[Tool] = ()) -> FrameMotion:
        """Integrate a frame; after divergence, retry it with shorter steps.

        A loose piece comes to rest, or falls where there is weight; pushed away, it stops at a
        distance of the tissue's length.

        Args:
            couplings: springs of the tools at the start of the frame.
            tools: give other springs within it; none: the springs stay.
        """
        if self.loads is not None:
            self.loads.refresh(self._u[: 3 * self.mesh.node_count])
        if self._touched or len(self._elastic.force) != self.mesh.node_count:
            self._begin_account()  # a pass over the tissue, which must not slow down a batch
        if self.masses.follows_strain:
            operands = self._far.operands() if self._far else self.model.operands()
            self.masses.begin(self._u[: 3 * self.mesh.node_count], operands)
        substeps, dt = self.time_steps.begin(couplings)
        self._hold_back(_is_free(couplings, tools))
        before = (self._u.copy(), self._v.copy())
        met = self.cut_contact.kept()
        relieved = None if self.loads is None else self.loads.kept()
        trouble = ''
        while True:
            work, contacts, taken = self._integrate(couplings, dt, substeps, tools)
            slow = dt * substeps / self.time_steps.frame_time
            motion = self._motion(slow, taken, trouble, contacts)
            energy = motion.kinetic_energy + motion.elastic_energy
            # Cut faces that begin in one another are moved apart: energy of no unstable step.
            work += self.cut_contact.recovered - met[2]
            found = self._detector.diagnose(self.displacement, energy, work)
            if not found:
                return motion
            if self.loads is not None:
                self.loads.restore(relieved)
            self.cut_contact.restore(met)
            if self._hold_lost(*before):
                trouble = f'{found}: a piece that nothing held, which stays there from now on'
                continue
            trouble = trouble or f'{found}: {self._cause(couplings, dt)}'
            self._u, self._v = before[0].copy(), before[1].copy()
            self._turn_back()
            finer = self.time_steps.refine()
            if not finer:
                break
            self._touched.append(np.arange(self.mesh.node_count))
            substeps, dt = substeps * finer, dt / finer
        self._v[:] = 0.0
        force, elastic = self._elastic.whole(self.displacement)
        self._detector.open(elastic + self._load_energy())
        return FrameMotion(np.zeros_like(force), 0.0, 0.0, substeps, 0.0, trouble, diverged=True)

    def _hold_back(self, free: bool) -> None:
        """Slow the loose pieces, which are looked for after a cut when no tool is in the tissue."""
        if self._falls:
            return
        if self._loose is None and free:
            held = self.mesh.fixed.any()
            self._loose = np.flatnonzero(free_parts(self.mesh)) if held else np.zeros(0, np.int64)
        if self._loose is not None and len(self._loose):
            self.velocity[self._loose] *= np.exp(-_DRAG * self.time_steps.frame_time)

    def _hold_lost(self, u: np.ndarray, v: np.ndarray) -> bool:
        """Return to the start of the frame, with lost pieces held in their shapes at rest.

        Args:
            u, v: displacement [m] and velocity [m/s] at the start; changed at these pieces.

        Returns:
            Whether there were any.
        """
        n = self.mesh.node_count
        lost = self._detector.lost(u[: 3 * n].reshape(-1, 3), self.displacement)
        if len(lost) == 0:
            return False
        shape = u[: 3 * n].reshape(-1, 3)
        piece = components(n, self.mesh.tetrahedra[:, EDGES].reshape(-1, 2))[1]
        for own in (np.flatnonzero(piece == p) for p in np.unique(piece[lost])):
            shape[own] = shape[own].mean(axis=0)  # else it would stay strained for ever
        v[: 3 * n].reshape(-1, 3)[lost] = 0.0
        self.masses.hold(lost)
        self._u, self._v = u.copy(), v.copy()
        self._turn_back()
        self._touched.append(np.arange(n))
        return True

    def _turn_back(self) -> None:
        """Let rotations and force be those of the present displacement."""
        self.model.restart_rotations(self.displacement)
        if self._far is not None:
            self._elastic.whole(self.displacement)

    def _state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return displacement [m] and velocity [m/s] with those of unknowns of the far field."""
        size = 3 * self.mesh.node_count + self._active.extra
        self._u, self._v = grown(self._u, size), grown(self._v, size)
        return self._u[:size], self._v[:size]

    def _choose(self, couplings: Sequence[Coupling], contacts: NearFaces) -> Region:
        u, v = self._state()
        if isinstance(self._active, FarField):
            if _is_free(couplings):
                self._active.relax(u, self._elastic.force, self.masses.inverse, self.masses.omega)
                self._elastic.whole(self.displacement)
            force = self._elastic.force
            return self._active.choose(
                u, v, force, self.masses.inverse, couplings, self.masses.omega
            )
        b = self.material.beta
        some = len(contacts.nodes) and not self._active.whole
        pressed = self.cut_contact.force(contacts, u, v) if some else None
        at = u, v, b, self.masses.inverse
        met = contacts.nodes.ravel(), pressed
        return self._active.choose(*at, held_nodes(couplings), self.time_steps.frame_time, met)

    def _integrate(
        self, couplings: Sequence[Coupling], dt: float, substeps: int, tools: Sequence[Tool]
    ) -> tuple[float, NearFaces, int]:
        """Move the tissue by a frame; return the work of the tools [J], the cut faces in contact,
        and the number of substeps.
        """
        size = 3 * self.mesh.node_count
        moving = self._state()[1][:size]
        calm = self.loads is None or self.loads.settled
        if _is_free(couplings, tools) and calm and float(np.abs(moving).max()) < _AT_REST:
            # Decay would continue into denormal numbers, at a hundred times the cost.
            if self._still >= _STILL_FRAMES:
                moving[:] = 0.0
                return 0.0, NO_NEAR_FACES, substeps
            self._still += 1
        else:
            self._still = 0
        couplings = [tool.restart() for tool in tools] or couplings
        springs = springs_of(couplings, self.mesh.rest)
        work, done, whole = 0.0, 0, np.array([[0, self.mesh.node_count]])
        part, parts = 1, max((tool.parts for tool in tools), default=1)
        region: Region | None = None
        adapt, look, near, contacts = 0, substeps, NO_NEAR_FACES, NO_NEAR_FACES
        faces: CutContacts | None = None
        if self.cut_contact.possible and self.stepping.integrator != 'implicit':
            look = 0
        while done < substeps:
            anew = region is None or not self._active.whole
            if faces is not None and (done >= look or anew):
                self.cut_contact.keep(contacts, faces)
                faces = None
            if done >= look:
                near, known = self.cut_contact.find(self.displacement, self.velocity, dt, substeps)
                look = done + known
            if region is None or anew:
                region = self._choose(couplings, near)
            if faces is None:
                contacts = near.among(self._active.move(near.nodes))
                faces = self._meeting(contacts, region)
            steps = self._active.ahead(
                substeps - done, substeps, self.masses.omega / self.masses.uncut
            )
            if self.masses.follows_strain:
                if done >= adapt:
                    operands = region.operands if self._far else self.model.operands()
                    begun = done == 0 and self._far is None
                    self.masses.adapt(self._u[:size], moving, operands, begun=begun)
                    adapt = done + SUBSTEPS_BETWEEN
                steps = min(steps, adapt - done)
            if self.loads is not None:
                steps = min(steps, self.loads.substeps(dt) or steps)
            steps = min(steps, max(part * substeps // parts - done, 1), max(look - done, 1))
            work += self._steps(region, springs, faces, dt, steps, first=done, total=substeps)
            done += steps
            if self.loads is not None:
                spans = whole if self._active.whole else spans_of(self._active.near)
                self.loads.advance(self._u[:size], dt * steps, spans)
            if tools and done >= part * substeps // parts:
                part += 1
                if self._detector.has_left(self.displacement):
                    break  # a diverged tissue holds no tools: the frame will be taken back
                positions = self.positions
                couplings = [tool.after(done / substeps, positions) for tool in tools]
                springs = springs_of(couplings, self.mesh.rest)
                finer = self.time_steps.parts(couplings, dt)
                if finer > 1:
                    done, substeps, dt = finer * done, finer * substeps, dt / finer
                    look, adapt = finer * look, finer * adapt
                if self._far is not None and not self._far.covers(couplings):
                    self._far.follow(*self._state(), size)
                    self._elastic.whole(self.displacement)
                    region = None
        if self._far is not None:
            self._far.follow(*self._state(), size)
        if faces is not None:
            self.cut_contact.keep(contacts, faces)
        return work, contacts, substeps

    def _meeting(self, contacts: NearFaces, region: Region) -> CutContacts:
        """Return contacts as the operand of the region's kernels."""
        if len(contacts.nodes) == 0:
            return NO_CUT_CONTACTS
        place, (u, v) = region.place, self._state()
        if place is None:
            return self.cut_contact.operand(contacts, contacts.nodes, u, v)
        return self.cut_contact.operand(
            contacts, place.local[contacts.nodes], u[place.at], v[place.at]
        )

    def _steps(
        self,
        region: Region,
        springs: Springs,
        faces: CutContacts,
        dt: float,
        steps: int,
        *,
        first: int,
        total: int,
    ) -> float:
        """Move the nodes of a region by some substeps; return the work of the springs [J]."""
        place = region.place
        at = slice(None) if place is None else place.at
        u, v = (values[at] for values in self._state())
        inverse, diagonal = self.masses.present_inverse, self.model.diagonal
        if self._far is not None:
            inverse = self._far.inverse(inverse)
            if self.stepping.integrator == 'implicit':
                diagonal = self._far.diagonal(diagonal)
        operands = region.operands
        if place is not None and self.loads is not None:
            operands = operands._replace(load=self.model.load[place.at[: 3 * place.moving]])
        inverse = inverse[at]
        faces.inverse[:] = inverse[faces.at]
        work = self._integrator.step(
            operands,
            inverse,
            diagonal[at],
            springs if place is None else place.springs(springs),
            u,
            v,
            dt,
            steps,
            spans=region.spans,
            first=first,
            total=total,
            faces=faces,
        )
        if place is not None:  # else u and v are the tissue's own
            own = 3 * place.moving
            self._u[place.at[:own]], self._v[place.at[:own]] = u[:own], v[:own]
        return work

    def _motion(self, slow: float, substeps: int, trouble: str, contacts: NearFaces) -> FrameMotion:
        force, elastic = self._elastic_now()
        if len(contacts.nodes):
            force = force - self.cut_contact.force(contacts, *self._state())
        elastic += self._load_energy()
        kinetic = self._kinetic_energy()
        strain = self.masses.strain
        return FrameMotion(force, kinetic, elastic, substeps, slow, trouble, strain=strain)

    def _cause(self, couplings: Sequence[Coupling], dt: float) -> str:
        name, bound = self.stepping.integrator, self.time_steps.bound(couplings)
        limit = (
            f'the {1e3 * bound:.3g} ms at which {name} is stable at {self.masses.omega:.4g} rad/s'
        )
        if dt > bound:
            return f'a step of {1e3 * dt:.3g} ms is above {limit}'
        inverted = self.inverted
        if inverted:
            cause = f'{inverted} of {len(self.mesh.tetrahedra)} tetrahedra are inside out'
        else:
            cause = f'the tissue is deformed beyond the range of the {self.model.name} model'
        if np.isinf(bound):
            return f'{cause}; {name} is stable with any step'
        return f'{cause}; the step of {1e3 * dt:.3g} ms is below {limit}'

    def apply_cut(self, delta: TopologyDelta) -> Touched:
        """Apply a change of connectivity; displacement and velocity are interpolated.

        Args:
            delta: the answer of the cutting service.

        Returns:
            The written slots.

        Raises:
            MeshError: the change does not fit the mesh.
        """
        self._still, self._loose = 0, None
        n, total = self.mesh.node_count, self.mesh.node_count + len(delta.node_parents)
        unknowns = self._state()[1][3 * n :].copy()
        touched = self.mesh.apply(delta)
        self.cut_contact.apply_cut(n, delta, touched)
        self._u, self._v = grown(self._u, 3 * total), grown(self._v, 3 * total)
        for values in (self._u, self._v):
            carried_over(values[: 3 * total].reshape(-1, 3), n, delta, touched)
        if self._far is not None:
            self._far.release(touched)
        self.model.update(touched)
        if self.loads is not None:
            self.loads.apply_cut(n, delta, touched)
        self.masses.follow_cut(touched.nodes)
        self._touched.append(touched.nodes)
        self._active.follow_cut(touched)
        velocity = self._state()[1][3 * self.mesh.node_count :]
        velocity[:] = grown(unknowns, len(velocity))[: len(velocity)]
        return touched

    def resume(self, displacement: np.ndarray) -> None:
        """Continue from a shape at rest, relaxed.

        Args:
            displacement: [m], shape (n, 3).
        """
        self.displacement[:] = displacement
        self.velocity[:] = 0.0
        self._loose = None
        self.cut_contact.release()
        if self.loads is not None:
            self.loads.relax(self._u[: 3 * self.mesh.node_count])
        self.restart()

    def restart(self) -> None:
        """Make the present displacement and velocity the start of the next frame.

        The rotations converge, and the energy balance restarts.
        """
        self._active.wake()
        self._begin_account()

    def _begin_account(self) -> None:
        energy = self._elastic_now()[1] + self._load_energy()
        self._detector.open(energy + self._kinetic_energy())
        self._still = 0

    def _elastic_now(self) -> tuple[np.ndarray, float]:
        """Return force [N], shape (n, 3), and energy [J], recomputed where they may have
        changed.
        """
        if not isinstance(self._active, ActiveRegion) or self._active.whole:
            self._touched = []
            return self._elastic.whole(self.displacement)
        n, touched = self.mesh.node_count, self._touched
        self._touched = []
        changed = np.concatenate([self._active.moved(), *touched])
        return self._elastic.renewed(self.displacement, changed[changed < n])

    def _load_energy(self) -> float:
        """Return the energy of weight and viscosity [J]."""
        if self.loads is None:
            return 0.0
        return self.loads.energy(self._u[: 3 * self.mesh.node_count])

    def _kinetic_energy(self) -> float:
        moving = None if self._active.whole else self._active.nodes  # the others are at rest
        return self.masses.kinetic_energy(self.velocity, moving)


def _is_free(couplings: Sequence[Coupling], tools: Sequence[Tool] = ()) -> bool:
    """Return whether no tool acts on the tissue."""
    return not tools and all(coupling.mode == FREE for coupling in couplings)
