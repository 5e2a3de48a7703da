"""Figures of viscosity: relaxation, creep and energy against the Prony series' exact answers."""

import time
from collections.abc import Callable

import numpy as np

from bench.accuracy.prony import shear_relaxation, uniaxial_creep
from bench.common.meshes import kuhn_block
from bench.figures.figure import Figure
from cutting_trainer.tissue_sim.contact.coupling import HOLD, Coupling
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

SIDE = 0.03
Series = tuple[tuple[float, float], ...]
SERIES: Series = ((0.3, 0.1), (0.3, 1.0))
PULL = 400.0
"""Acceleration of the weight that lengthens a cube [m/s^2]."""
MODULI = (5400.0, 0.45)
TIMES = 10
FRAMES, SKIPPED = 20, 4
CYCLE_STEPS, CYCLE_SHEAR = 200, 0.12
"""Steps and largest shear of a cycle, in which points change over to the law and back."""
TIMED = 20


def measure() -> list[Figure]:
    """Return the figures of line 6, and the cost of a term."""
    relaxed = max(relaxation(name) for name in MODELS)
    balance = max(cycle(name) for name in MODELS)
    return [
        Figure(6, 'relaxation of shear, off the Prony series', relaxed, 0.02, 'at most', '',
               TIMES * len(MODELS)),
        Figure(6, 'creep, off the Prony series', creep(), 0.02, 'at most', '', FRAMES - SKIPPED),
        Figure(6, 'work of a cycle, less what is stored and lost', balance, 0.01, 'at most', '',
               2 * len(MODELS)),
        cost(),
    ]  # fmt: skip


def block(name: ModelName) -> Dynamics:
    """Return a cube held at its underside."""
    mesh = kuhn_block((3, 3, 3), (SIDE, SIDE, SIDE))
    mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.rest[:, 2] < 1e-9)
    return Dynamics(mesh, Material(*MODULI, 1060.0, 10.0, 5e-4, 6.0, SERIES), name)


def after(dynamics: Dynamics, shear: float, seconds: float) -> np.ndarray:
    """Return the force after some time under a shear [N], shape (n, 3)."""
    assert dynamics.loads is not None
    dynamics.displacement[:, 0] = shear * dynamics.mesh.rest[:, 2]
    everywhere = np.array([[0, dynamics.mesh.node_count]])
    dynamics.loads.advance(dynamics.displacement.ravel(), seconds, everywhere)
    return dynamics.model.force(dynamics.displacement)


def relaxation(name: ModelName) -> float:
    """Return the largest relative error of the force after a step of shear."""
    dynamics = block(name)
    top = dynamics.mesh.rest[:, 2] > SIDE - 1e-9
    first = after(dynamics, 0.02, 0.0)[top, 0].sum()
    times = 0.05 * np.arange(1, TIMES + 1)
    forces = np.array([after(dynamics, 0.02, 0.05)[top, 0].sum() for _ in times])
    exact = first * shear_relaxation(dynamics.material, times)
    return float(np.abs(forces / exact - 1).max())


def pulled(
    name: ModelName, integrator: IntegratorName, series: Series
) -> tuple[Dynamics, Callable[[], float]]:
    """Return a cube under its weight from now on, and a function for its lengthening, relative to
    the first one.

    It is light, and pulled hard: its inertia plays no part.

    Args:
        name: elastic model.
        integrator: name.
        series: g and tau [s] of the terms.
    """
    mesh = kuhn_block((3, 3, 3), (SIDE, SIDE, SIDE))
    material = Material(*MODULI, 10.0, 200.0, 1e-4, 0.0, series)
    stepping = TimeStepping(integrator, max_substeps=5000)
    dynamics = Dynamics(mesh, material, name, stepping, gravity=(0.0, 0.0, PULL))
    dynamics.masses.inverse.reshape(-1, 3)[mesh.rest < 1e-9] = (
        0.0  # planes that slide in themselves
    )
    top = mesh.rest[:, 2] > SIDE - 1e-9
    weight = np.zeros_like(mesh.rest)
    weight[:, 2] = PULL * dynamics.model.mass
    first = solve_static(dynamics.model, dynamics.masses.inverse > 0, weight)[top, 2].mean()
    return dynamics, lambda: float(dynamics.displacement[top, 2].mean() / first)


def creep() -> float:
    """Return the largest relative error of the lengthening under a weight, in frames."""
    dynamics, lengthened = pulled('linear_smoothed', 'symplectic_euler', SERIES)
    found = []
    for _ in range(FRAMES):
        dynamics.advance(Coupling())
        found.append(lengthened())
    exact = uniaxial_creep(dynamics.material, np.arange(1, FRAMES + 1) / 30)
    return float(np.abs(np.array(found) / exact - 1)[SKIPPED:].max())


def cycle(name: ModelName) -> float:
    """Return what a cycle of shear has put in less what is stored and lost, relative to it.

    What is lost must never fall; where it does, the result is infinite.
    """
    dynamics, work, worst = block(name), 0.0, 0.0
    assert dynamics.loads is not None and dynamics.loads.viscosity is not None
    viscosity, force = dynamics.loads.viscosity, np.zeros_like(dynamics.mesh.rest)
    for k in range(1, CYCLE_STEPS + 1):
        before, shear = (
            dynamics.displacement.copy(),
            CYCLE_SHEAR * np.sin(2 * np.pi * k / CYCLE_STEPS),
        )
        moved = after(dynamics, shear, 0.0)  # the viscous stress is that of before
        work += 0.5 * float(np.sum((force + moved) * (dynamics.displacement - before)))
        lost = viscosity.lost
        force = after(dynamics, shear, 0.5 / CYCLE_STEPS)
        if viscosity.lost < lost:
            return np.inf
        if k in (CYCLE_STEPS // 4, CYCLE_STEPS):
            stored = dynamics.model.evaluate(dynamics.displacement)[1] + viscosity.energy
            worst = max(worst, abs(stored + viscosity.lost - work) / max(abs(work), stored))
    return worst


def cost() -> Figure:
    """Measure a substep with one term, as a ratio to one without."""
    times: list[list[float]] = [[], []]
    pressed = []
    for series in ((), SERIES[:1]):
        mesh = kuhn_block((16, 16, 7), (0.08, 0.08, 0.035))
        mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.rest[:, 2] < 1e-9)
        material = Material(*MODULI, 1060.0, 10.0, 5e-4, 0.0, series)
        pressed.append(
            Dynamics(mesh, material, 'linear_smoothed', TimeStepping('symplectic_euler'))
        )
    middle = int(np.argmin(np.square(mesh.rest - [0.04, 0.04, 0.035]).sum(axis=1)))
    held = np.array([middle])
    for k in range(TIMED):
        ends = [mesh.rest[middle] - [0.0, 0.0, 1e-3 * min(k + i, 5)] for i in (0, 1)]
        spring = Coupling(HOLD, held, np.ones(1), *ends, np.zeros(3), 100.0)
        for dynamics, taken in zip(pressed, times, strict=True):
            start = time.thread_time()
            substeps = dynamics.advance(spring).substeps
            taken.append((time.thread_time() - start) / substeps)
    plain, viscous = (float(np.min(taken)) for taken in times)
    return Figure(
        6, 'substep with one term', viscous / plain, 1.25, 'at most', '', TIMED,
        'that of linear_smoothed without', f'{1e6 * viscous:.0f} us',
    )  # fmt: skip
