"""The beam of all peers, and the measurement of a solver with it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.problems import Cantilever, material
from bench.common.meshes import beam, end_load
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound, step_bound

Floats = NDArray[np.float64]

LOAD_N = 2e-4
"""Load [N]: the end sinks by 1 % of the beam's length; single precision still sees that well."""
DAMPING = 8.8
"""Mass damping [1/s]: critical for the lowest mode, 4.4 rad/s."""
SETTLING_TIME_S = 2.5
"""Time after which the lowest mode has decayed to 2e-4 of its deflection."""
_MIN_SAMPLE_S = 0.02
"""Shortest processor time of a sample of steps."""
REPEATS = 7


class Solver(Protocol):
    """Beam in a solver, at rest, loaded from the first step on.

    Attributes:
        dt: its step [s].
    """

    dt: float

    def step(self, count: int) -> None:
        """Make some steps."""

    def slow(self, factor: float) -> None:
        """Multiply all velocities."""

    def displacement(self) -> Floats:
        """Return the displacements of the nodes, in the order of the mesh [m], shape (n, 3)."""


@dataclass(frozen=True)
class Beam:
    """The chart's cantilever, meshed.

    Attributes:
        problem: the cantilever.
        mesh: mesh with the clamped nodes.
        load: at the nodes [N], shape (n, 3).
    """

    problem: Cantilever
    mesh: TetMesh
    load: Floats

    @property
    def exact(self) -> float:
        """Reference deflection [m]."""
        return self.problem.reference.value * LOAD_N / self.problem.force

    @property
    def masses(self) -> Floats:
        """Nodal masses, a quarter of each tetrahedron [kg], shape (n,)."""
        return np.asarray(ElasticModel(self.mesh, material(self.problem.solid), 'linear').mass)

    def deflection(self, u: Floats) -> float:
        """Return the deflection of the loaded end for displacements of shape (n, 3) [m]."""
        return float(np.sum(self.load * u)) / LOAD_N

    def explicit_step(self) -> float:
        """Return the trainer's step for symplectic Euler and linear tetrahedra [s]."""
        solid = self.problem.solid
        return stable_step(ElasticModel(self.mesh, material(solid), 'linear'), inverse_mass(self))


def inverse_mass(at: Beam) -> Floats:
    """Return the inverse masses by coordinate, 0 where clamped [1/kg], shape (3 n,)."""
    return np.repeat(np.where(at.mesh.fixed == 1, 0.0, 1.0 / at.masses), 3)


def stable_step(model: ElasticModel, inverse: Floats) -> float:
    """Return 0.8 of the largest stable step of symplectic Euler [s], as in a session."""
    return 0.8 * step_bound('symplectic_euler', FrequencyBound(model, inverse).omega, 0.0, 0.0)


@cache
def cantilever(poissons_ratio: float) -> Cantilever:
    """Return one of each material: its reference takes a while."""
    return Cantilever(poissons_ratio)


def make_beam(poissons_ratio: float, resolution: int) -> Beam:
    """Return the beam with so many bricks over its depth, 30 r^3 tetrahedra."""
    problem = cantilever(poissons_ratio)
    mesh = beam(problem.solid, resolution)
    return Beam(problem, mesh, end_load(mesh, problem.solid, LOAD_N))


@dataclass(frozen=True)
class Result:
    """Measurement of a solver.

    Attributes:
        tetrahedra: of the mesh.
        dt: the step [s].
        cost: processor time of all threads by tetrahedron and step [ns]: median, tenth and
            ninetieth percentile.
        real_time: processor time by simulated second [s].
        deflection: of the end [m]; None: it did not come to rest within the budget.
    """

    tetrahedra: int
    dt: float
    cost: tuple[float, float, float]
    real_time: float
    deflection: float | None


def measure(at: Beam, solver: Solver, budget: float) -> Result:
    """Step a solver until the beam is at rest, then time it.

    Args:
        at: the beam.
        solver: that has it.
        budget: processor time for coming to rest [s].

    Raises:
        ArithmeticError: the displacements grew without bound.
    """
    solver.step(1)  # kernels and caches
    begin, simulated = time.process_time(), 0.0
    while simulated < SETTLING_TIME_S and time.process_time() - begin < budget:
        solver.step(1)
        # After every step: damping at a lower rate would excite modes of that rate.
        solver.slow(float(np.exp(-DAMPING * solver.dt)))
        simulated += solver.dt
    u = solver.displacement()
    length = at.problem.solid.size[0]
    if not np.isfinite(u).all() or abs(u).max() > length:
        raise ArithmeticError(f'it flies apart at a step of {1e3 * solver.dt:.3g} ms')
    spent = np.array(_samples(solver.step))
    low, median, high = np.percentile(1e9 * spent / len(at.mesh.tetrahedra), [10, 50, 90])
    return Result(
        len(at.mesh.tetrahedra),
        solver.dt,
        (float(median), float(low), float(high)),
        float(np.median(spent)) / solver.dt,
        at.deflection(u) if simulated >= SETTLING_TIME_S else None,
    )


def _samples(step: Callable[[int], None]) -> list[float]:
    """Return processor time of a step, all threads, some times over [s]."""
    once = max(_spent(step, 1), 1e-7)
    count = max(1, int(np.ceil(_MIN_SAMPLE_S / once)))
    return [_spent(step, count) / count for _ in range(REPEATS)]


def _spent(step: Callable[[int], None], count: int) -> float:
    start = time.process_time()
    step(count)
    return time.process_time() - start
