"""The tissue's motion from frame to frame: model, integrator, step, active region, guard."""

from dataclasses import dataclass

import numpy as np

from tissue_sim.active_region import ActiveRegion, ActiveSettings, Region
from tissue_sim.compliance import solve_static
from tissue_sim.coupling import FREE, Coupling, Spring
from tissue_sim.elastic_state import ElasticState
from tissue_sim.elasticity import ElasticModel, ModelName
from tissue_sim.guard import Guard
from tissue_sim.integrators import Integrator, IntegratorName
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh, TopologyDelta, Touched, carried_over, grown
from tissue_sim.stability import FrequencyBound, step_bound

_AT_REST = 1e-9
"""[m/s] below which a tissue that nothing touches is at rest, when it stays so."""
_STILL_FRAMES = 10
_FINER, _FINEST = 4, 16
"""By how much shorter steps are in the next attempt, and at most: a frame does no more work than
21 of them, though frame after frame should need shorter steps; than 5 of explicit steps of a model
that does not turn, whose bound holds in any shape: what a quarter does not mend, none does."""
_CAUTIOUS_FRAMES = 30


@dataclass(frozen=True)
class TimeStepping:
    """How frames are stepped through.

    Attributes:
        integrator: which one.
        rate: frames a second [Hz].
        safety: share of the stable step that is used.
        min_substeps, max_substeps: of a frame; when the largest number does not suffice the frame
            simulates less time than it lasts.
        frequency_growth: how far cuts may raise the highest frequency before small nodes are
            integrated with more mass (see `FrequencyBound`); infinite: never.
    """

    integrator: IntegratorName = 'rk4'
    rate: float = 30.0
    safety: float = 0.8
    min_substeps: int = 1
    max_substeps: int = 200
    frequency_growth: float = 3.0


@dataclass(frozen=True)
class Motion:
    """What a frame of motion came to.

    Attributes:
        elastic_force: that resists the displacement [N], shape (n, 3).
        kinetic_energy, elastic_energy: [J].
        substeps: how many.
        slow_motion: simulated time over frame time.
        trouble: what went wrong; empty: nothing.
        diverged: shorter steps did not help, and the frame was taken back.
    """

    elastic_force: np.ndarray
    kinetic_energy: float
    elastic_energy: float
    substeps: int
    slow_motion: float
    trouble: str = ''
    diverged: bool = False


class Dynamics:
    """Displacement and velocity of the tissue, and what moves them.

    Args:
        mesh: the tissue; changed by `apply_cut` only.
        material: its constants.
        model: its elasticity.
        stepping: how frames are stepped through.
        active: which nodes move.

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
    ) -> None:
        self.mesh = mesh
        self.material = material
        self.model = ElasticModel(mesh, material, model)
        self.stepping = stepping or TimeStepping()
        self._frame_time = 1.0 / self.stepping.rate
        self._integrator = Integrator(self.stepping.integrator, material.alpha, material.beta)
        size = 3 * mesh.node_count
        self._u, self._v = np.zeros(size), np.zeros(size)
        self._inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1.0 / self.model.mass), 3)
        self._inertia = self.model.mass.copy()
        self._frequency = FrequencyBound(self.model, self._inverse, self.stepping.frequency_growth)
        self._uncut = self._frequency.omega
        self._bounds: dict[float, float] = {}
        self._still = 0
        self._elastic = ElasticState(self.model)
        self._touched: list[np.ndarray] = []
        self._caution = 1
        self._cautious = 0
        self._guard = Guard(mesh, material.youngs_modulus)
        self._active = ActiveRegion(
            self.model,
            active or ActiveSettings(),
            implicit=self.stepping.integrator == 'implicit',
        )
        if self.bound() == 0.0:
            raise ValueError(
                f'{self.stepping.integrator} has no stable step with damping alpha '
                f'{material.alpha:g} 1/s and beta {material.beta:g} s: damp the tissue, or take '
                'another integrator'
            )

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
    def omega(self) -> float:
        """Bound of the highest frequency that steps are chosen by [rad/s]."""
        return self._frequency.omega

    @property
    def inverse_mass(self) -> np.ndarray:
        """By coordinate, 0 where fixed [1/kg], shape (3 n,); a view."""
        return self._inverse[: 3 * self.mesh.node_count]

    @property
    def active_nodes(self) -> int:
        """How many nodes move at present."""
        return self._active.count

    @property
    def held_to(self) -> np.ndarray | None:
        """The only nodes that can move now, sorted, shape (a,); None: all that are not fixed."""
        return self._active.held_to

    @property
    def inverted(self) -> int:
        """How many tetrahedra are turned inside out."""
        return self._guard.inverted(self.displacement)

    def stretch(self, stretch: np.ndarray) -> None:
        """Moves the fixed nodes apart and all others to where they are then in equilibrium.

        Args:
            stretch: along x, y and z (0.05: by 5 %), shape (3,).
        """
        fixed = self.mesh.fixed == 1
        middle = self.mesh.rest[fixed].mean(axis=0)
        u = self.displacement
        u[:] = (self.mesh.rest - middle) * stretch
        first = 0.0
        for _ in range(50 if self.model.rotating else 1):
            residual = -self.model.force(u)
            size = float(np.linalg.norm(residual[~fixed]))
            first = first or size
            if size < 1e-10 * first:
                break
            u[~fixed] += solve_static(self.model, self.inverse_mass > 0, residual)[~fixed]
        self.restart()

    def bound(self, coupling: Coupling | None = None) -> float:
        """The largest stable step [s], the coupling spring's stiffness included."""
        square = self._frequency.omega**2
        if coupling is not None and coupling.mode != FREE:
            inverse = self.inverse_mass[3 * coupling.nodes]
            square += coupling.stiffness * float(np.sum(coupling.weights**2 * inverse))
        # Rounded up, so that few different bounds are ever computed.
        omega = 1.01 ** np.ceil(np.log(np.sqrt(square)) / np.log(1.01))
        if omega not in self._bounds:
            m = self.material
            self._bounds[omega] = step_bound(self.stepping.integrator, omega, m.alpha, m.beta)
        return self._bounds[omega]

    def _substeps(self, coupling: Coupling) -> tuple[int, float]:
        dt = self.stepping.safety * self.bound(coupling) / self._caution
        substeps = max(int(np.ceil(self._frame_time / dt)), self.stepping.min_substeps)
        substeps = max(substeps, self._caution)
        if substeps > self.stepping.max_substeps * self._caution:
            return self.stepping.max_substeps * self._caution, dt
        return substeps, self._frame_time / substeps

    def advance(self, coupling: Coupling) -> Motion:
        """Moves the tissue by a frame; a frame that diverges is tried again with shorter steps.

        A piece that nothing holds may be pushed away for ever: one that has come as far as the
        tissue is long stays there.

        Args:
            coupling: the tool's spring.
        """
        if self._touched:
            self._begin_account()  # a pass over the tissue, which a batch must not pay for
        self._frequency.refine()
        if self._cautious:
            self._cautious -= 1
            self._caution = self._caution if self._cautious else 1
        substeps, dt = self._substeps(coupling)
        before = (self._u.copy(), self._v.copy())
        trouble = ''
        while True:
            work = self._integrate(coupling, dt, substeps)
            motion = self._motion(dt, substeps, trouble)
            energy = motion.kinetic_energy + motion.elastic_energy
            found = self._guard.trouble(self.displacement, energy, work)
            if not found:
                return motion
            if self._hold_lost(*before):
                trouble = f'{found}: a piece that nothing held, which stays there from now on'
                continue
            trouble = trouble or f'{found}: {self._cause(coupling, dt)}'
            self._u, self._v = before[0].copy(), before[1].copy()
            known = not self.model.rotating and self.stepping.integrator != 'implicit'
            if self._caution * _FINER > (_FINER if known else _FINEST):
                break
            self._touched.append(np.arange(self.mesh.node_count))
            self._caution *= _FINER
            self._cautious = _CAUTIOUS_FRAMES
            substeps, dt = substeps * _FINER, dt / _FINER
        self._v[:] = 0.0
        self._caution = 1
        force, elastic = self._elastic.whole(self.displacement)
        self._guard.open(elastic)
        return Motion(np.zeros_like(force), 0.0, 0.0, substeps, 0.0, trouble, diverged=True)

    def _hold_lost(self, u: np.ndarray, v: np.ndarray) -> bool:
        """Goes back to the start of the frame without the loose pieces that went too far in it.

        Args:
            u, v: displacement [m] and velocity [m/s] at the start; v is changed.

        Returns:
            Whether there were any.
        """
        n = self.mesh.node_count
        lost = self._guard.lost(u[: 3 * n].reshape(-1, 3), self.displacement)
        if len(lost) == 0:
            return False
        v[: 3 * n].reshape(-1, 3)[lost] = 0.0
        self.inverse_mass.reshape(-1, 3)[lost] = 0.0
        self._u, self._v = u.copy(), v.copy()
        self._touched.append(np.arange(n))
        return True

    def _integrate(self, coupling: Coupling, dt: float, substeps: int) -> float:
        size = 3 * self.mesh.node_count
        moving = self._v[:size]
        if coupling.mode == FREE and float(np.abs(moving).max()) < _AT_REST:
            # Decay would go on into denormal numbers, at a hundred times the cost.
            if self._still >= _STILL_FRAMES:
                moving[:] = 0.0
                return 0.0
            self._still += 1
        else:
            self._still = 0
        spring = coupling.spring(self.mesh.rest)
        work, done = 0.0, 0
        while done < substeps:
            region = self._active.choose(
                self._u[:size],
                moving,
                self.material.beta,
                self.inverse_mass,
                coupling,
                self._frame_time,
            )
            steps = self._active.ahead(substeps - done, substeps, self.omega / self._uncut)
            work += self._steps(region, spring, dt, steps, first=done, total=substeps)
            done += steps
        return work

    def _steps(
        self, region: Region, spring: Spring, dt: float, steps: int, *, first: int, total: int
    ) -> float:
        """Moves the nodes of a region by some substeps; returns the work of the spring [J]."""
        size, place = 3 * self.mesh.node_count, region.place
        at = slice(None) if place is None else place.at
        u, v = self._u[:size][at], self._v[:size][at]
        work = self._integrator.step(
            region.operands,
            self.inverse_mass[at],
            self.model.diagonal[at],
            spring if place is None else place.spring(spring),
            u,
            v,
            dt,
            steps,
            spans=region.spans,
            first=first,
            total=total,
        )
        if place is not None:  # else u and v are the tissue's own
            own = 3 * place.moving
            self._u[place.at[:own]], self._v[place.at[:own]] = u[:own], v[:own]
        return work

    def _motion(self, dt: float, substeps: int, trouble: str) -> Motion:
        force, elastic = self._elastic_now()
        kinetic = self._kinetic_energy()
        slow = dt * substeps / self._frame_time
        return Motion(force, kinetic, elastic, substeps, slow, trouble)

    def _cause(self, coupling: Coupling, dt: float) -> str:
        name, bound = self.stepping.integrator, self.bound(coupling)
        limit = f'the {1e3 * bound:.3g} ms at which {name} is stable at {self.omega:.4g} rad/s'
        if dt > bound:
            return f'a step of {1e3 * dt:.3g} ms is above {limit}'
        inverted = self.inverted
        if inverted:
            cause = f'{inverted} of {len(self.mesh.tetrahedra)} tetrahedra are inside out'
        else:
            cause = f'the tissue has been deformed beyond what the {self.model.name} model bears'
        if np.isinf(bound):
            return f'{cause}; {name} is stable with any step'
        return f'{cause}; the step of {1e3 * dt:.3g} ms is below {limit}'

    def apply_cut(self, delta: TopologyDelta) -> Touched:
        """Carries a change of connectivity out; displacement and velocity are interpolated.

        Args:
            delta: the answer of the cutting service.

        Returns:
            What was written.

        Raises:
            MeshError: the change does not fit the mesh.
        """
        self._still = 0
        n, total = self.mesh.node_count, self.mesh.node_count + len(delta.node_parents)
        touched = self.mesh.apply(delta)
        self._u, self._v = grown(self._u, 3 * total), grown(self._v, 3 * total)
        for values in (self._u, self._v):
            carried_over(values[: 3 * total].reshape(-1, 3), n, delta, touched)
        self.model.update(touched)
        self._follow_cut(touched.nodes)
        return touched

    def resume(self, displacement: np.ndarray) -> None:
        """Goes on from a shape, at rest.

        Args:
            displacement: [m], shape (n, 3).
        """
        self.displacement[:] = displacement
        self.velocity[:] = 0.0
        self.restart()

    def restart(self) -> None:
        """Takes displacement and velocity as they are for the state that the next frame starts at.

        Rotations settle in it, and the account of energy begins with it.
        """
        self._active.wake()
        self._begin_account()

    def _begin_account(self) -> None:
        self._guard.open(self._elastic_now()[1] + self._kinetic_energy())
        self._still = 0

    def _elastic_now(self) -> tuple[np.ndarray, float]:
        """Force [N], shape (n, 3), and energy [J], computed where they may have changed."""
        if self._active.whole:
            self._touched = []
            return self._elastic.whole(self.displacement)
        n, touched = self.mesh.node_count, self._touched
        self._touched = []
        changed = np.concatenate([self._active.moved(), *touched])
        return self._elastic.renewed(self.displacement, changed[changed < n])

    def _kinetic_energy(self) -> float:
        v, inertia = self.velocity, self._inertia[: self.mesh.node_count]
        if not self._active.whole:  # the others are at rest
            v, inertia = v[self._active.nodes], inertia[self._active.nodes]
        return 0.5 * float((inertia * np.square(v).sum(axis=1)).sum())

    def _follow_cut(self, nodes: np.ndarray) -> None:
        """Brings what is kept by node up to date where a cut touched it, nodes of shape (r,)."""
        n = self.mesh.node_count
        if len(self._inertia) < n:
            self._inertia = grown(self._inertia, n)
            self._inverse = grown(self._inverse, 3 * len(self._inertia))
        self._frequency.update(nodes, self.inverse_mass)
        self._inertia[nodes] = self._frequency.inertia(nodes)
        free = self.mesh.fixed[nodes] == 0
        inverse = np.where(free, 1.0 / self._inertia[nodes], 0.0)
        self.inverse_mass.reshape(-1, 3)[nodes] = inverse[:, None]
        self._active.follow_cut(nodes)
        self._touched.append(nodes)
