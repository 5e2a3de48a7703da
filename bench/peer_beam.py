"""The beam that `bench.peers` gives to everybody, and what is measured of a solver with it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from session.measure.chart_meshes import beam, end_load
from session.measure.chart_problems import Cantilever, material
from tissue_sim.elasticity import ElasticModel
from tissue_sim.mesh import TetMesh
from tissue_sim.stability import FrequencyBound, step_bound

Floats = NDArray[np.float64]

FORCE = 2e-4
"""Load [N]: the end sinks by 1 % of the beam's length; single precision still sees that well."""
DAMPING = 8.8
"""Of the mass [1/s]: critical for the lowest mode, 4.4 rad/s."""
SETTLED = 2.5
"""[s] after which what is left of the lowest mode is 2e-4 of its deflection."""
_LEAST = 0.02
"""[s] of processor time that a sample of steps takes at least."""
REPEATS = 7


class Solver(Protocol):
    """A beam in somebody's hands, at rest, its load on it from the first step.

    Attributes:
        dt: its step [s].
    """

    dt: float

    def step(self, count: int) -> None:
        """Makes some steps."""

    def slow(self, factor: float) -> None:
        """Multiplies all velocities."""

    def displacement(self) -> Floats:
        """Of the nodes of the mesh, in its order [m], shape (n, 3)."""


@dataclass(frozen=True)
class Beam:
    """The chart's cantilever, meshed.

    Attributes:
        problem: the cantilever.
        mesh: with what is clamped.
        load: at the nodes [N], shape (n, 3).
    """

    problem: Cantilever
    mesh: TetMesh
    load: Floats

    @property
    def exact(self) -> float:
        """Deflection that it should have [m]."""
        return self.problem.reference.value * FORCE / self.problem.force

    @property
    def masses(self) -> Floats:
        """Of the nodes, a quarter of each tetrahedron [kg], shape (n,)."""
        return np.asarray(ElasticModel(self.mesh, material(self.problem.solid), 'linear').mass)

    def deflection(self, u: Floats) -> float:
        """Of the loaded end, for displacements of shape (n, 3) [m]."""
        return float(np.sum(self.load * u)) / FORCE

    def explicit_step(self) -> float:
        """The trainer's step for symplectic Euler and linear tetrahedra [s]."""
        solid = self.problem.solid
        return stable_step(ElasticModel(self.mesh, material(solid), 'linear'), inverse_mass(self))


def inverse_mass(at: Beam) -> Floats:
    """By coordinate, 0 where clamped [1/kg], shape (3 n,)."""
    return np.repeat(np.where(at.mesh.fixed == 1, 0.0, 1.0 / at.masses), 3)


def stable_step(model: ElasticModel, inverse: Floats) -> float:
    """0.8 of the largest stable step of symplectic Euler [s], as in a session."""
    return 0.8 * step_bound('symplectic_euler', FrequencyBound(model, inverse).omega, 0.0, 0.0)


@cache
def cantilever(poissons_ratio: float) -> Cantilever:
    """One of each material: its reference takes a while."""
    return Cantilever(poissons_ratio)


def make_beam(poissons_ratio: float, resolution: int) -> Beam:
    """The beam with so many bricks over its depth, 30 r^3 tetrahedra."""
    problem = cantilever(poissons_ratio)
    mesh = beam(problem.solid, resolution)
    return Beam(problem, mesh, end_load(mesh, problem.solid, FORCE))


@dataclass(frozen=True)
class Result:
    """What was measured.

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
    """Steps a solver until the beam is at rest, then times it.

    Args:
        at: the beam.
        solver: that has it.
        budget: processor time for coming to rest [s].

    Raises:
        ArithmeticError: the displacements grew without bound.
    """
    solver.step(1)  # kernels and caches
    begin, simulated = time.process_time(), 0.0
    while simulated < SETTLED and time.process_time() - begin < budget:
        solver.step(1)
        # After every step: damping by larger pieces drives the modes that they are in time with.
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
        at.deflection(u) if simulated >= SETTLED else None,
    )


def _samples(step: Callable[[int], None]) -> list[float]:
    """Processor time of a step, all threads, some times over [s]."""
    once = max(_spent(step, 1), 1e-7)
    count = max(1, int(np.ceil(_LEAST / once)))
    return [_spent(step, count) / count for _ in range(REPEATS)]


def _spent(step: Callable[[int], None], count: int) -> float:
    start = time.process_time()
    step(count)
    return time.process_time() - start
