"""Viscosity against the exact answers of its Prony series, and what it must not do."""

from itertools import pairwise

import numpy as np
import pytest
from meshes import irregular_box

from bench.accuracy.prony import shear_relaxation, uniaxial_creep, uniaxial_relaxation
from bench.cuts.random_strokes import random_stroke
from bench.cuts.strokes import results_along
from bench.figures.tissue_relaxation import cycle
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.coupling import FREE, HOLD, Coupling
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.viscosity import Viscosity
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

E, NU, DENSITY, SIDE = 5400.0, 0.45, 1060.0, 0.03
ONE, TWO = ((0.5, 0.2),), ((0.3, 0.1), (0.3, 1.0))
every_model = pytest.mark.parametrize('name', MODELS)


def block(
    name: ModelName = 'linear_smoothed',
    prony: tuple[tuple[float, float], ...] = ONE,
    *,
    alpha: float = 10.0,
    beta: float = 5e-4,
    integrator: IntegratorName = 'symplectic_euler',
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    active: ActiveSettings | None = None,
    density: float = DENSITY,
    stepping: TimeStepping | None = None,
    cells: int = 3,
) -> Dynamics:
    """A cube held at its underside."""
    nodes, tets = irregular_box((cells, cells, cells), SIDE / cells, 2, 0.15)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    material = Material(E, NU, density, alpha, beta, 6.0, prony)
    stepping = stepping or TimeStepping(integrator, max_substeps=5000, min_substeps=8)
    return Dynamics(mesh, material, name, stepping, active, gravity)


def viscosity_of(dynamics: Dynamics) -> Viscosity:
    assert dynamics.loads is not None
    viscosity = dynamics.loads.viscosity
    assert viscosity is not None
    return viscosity


def waited(dynamics: Dynamics, seconds: float, steps: int) -> np.ndarray:
    """Wait in the present shape; return the force against it [N]."""
    spans = np.array([[0, dynamics.mesh.node_count]])
    for _ in range(steps):
        assert dynamics.loads is not None
        dynamics.loads.advance(dynamics.displacement.ravel(), seconds / steps, spans)
    return dynamics.model.force(dynamics.displacement)


@every_model
def test_nodes_relax_alone_as_with_others(name: ModelName) -> None:
    # Some fill chunks, and others a part of one.
    together, alone = (block(name, TWO, cells=4) for _ in range(2))
    n = together.mesh.node_count
    assert n % LANES and n > LANES
    moved = 1e-3 * np.random.default_rng(1).standard_normal((n, 3))
    for dynamics, ends in ((together, [0, n]), (alone, range(n + 1))):
        dynamics.displacement[:] = moved
        for spans in pairwise(ends):
            viscosity_of(dynamics).advance(
                dynamics.displacement.ravel(), 0.1, np.array([spans]), dynamics.model.load
            )
            viscosity_of(dynamics)._time -= 0.1
    load = together.model.load
    assert np.abs(load).max() > 0
    assert alone.model.load == pytest.approx(load, rel=1e-6, abs=1e-9 * np.abs(load).max())
    assert viscosity_of(alone).energy == pytest.approx(viscosity_of(together).energy, rel=1e-6)


@every_model
@pytest.mark.parametrize('prony', [ONE, TWO], ids=['one', 'two'])
def test_a_sheared_block_relaxes_as_the_series_says(
    name: ModelName, prony: tuple[tuple[float, float], ...]
) -> None:
    dynamics = block(name, prony)
    rest = dynamics.mesh.rest
    dynamics.displacement[:, 0] = 0.02 * rest[:, 2]
    top = rest[:, 2] > SIDE - 1e-9
    first = dynamics.model.force(dynamics.displacement)[top, 0].sum()
    for k in range(1, 11):
        now = waited(dynamics, 0.05, 1)[top, 0].sum()
        exact = shear_relaxation(dynamics.material, np.array(0.05 * k))
        assert now / first == pytest.approx(float(exact), rel=0.005)


def rollers(dynamics: Dynamics) -> None:
    """Let each plane through the origin slide in itself, and hold nothing else."""
    rest, inverse = dynamics.mesh.rest, dynamics.masses.inverse.reshape(-1, 3)
    inverse[:] = 1.0 / dynamics.model.mass[:, None]
    inverse[rest < 1e-9] = 0.0


@pytest.mark.parametrize('prony', [ONE, TWO], ids=['one', 'two'])
@pytest.mark.parametrize('name', ['linear', 'linear_smoothed', 'corotational', 'stiffening'])
def test_a_stretched_block_relaxes_as_the_series_says(
    name: ModelName, prony: tuple[tuple[float, float], ...]
) -> None:
    dynamics = block(name, prony, alpha=100.0, beta=1e-3)
    rollers(dynamics)
    rest, strain = dynamics.mesh.rest, 0.005
    top = rest[:, 2] > SIDE - 1e-9
    dynamics.masses.inverse.reshape(-1, 3)[top, 2] = 0.0
    dynamics.displacement[:] = rest * np.array([-NU, -NU, 1.0]) * strain
    dynamics.restart()
    times, forces = np.arange(1, 16) / 30, []
    for _ in times:
        forces.append(dynamics.advance(Coupling()).elastic_force[top, 2].sum())
    exact = E * strain * SIDE**2 * uniaxial_relaxation(dynamics.material, times)
    np.testing.assert_allclose(forces, exact, rtol=0.02)


@pytest.mark.parametrize('integrator', INTEGRATORS)
def test_a_block_that_is_loaded_creeps_as_the_series_says(integrator: IntegratorName) -> None:
    # Its weight, from one moment on: the mean strain is rho g L / (2 E).
    # A light body is hardly delayed by its mass and its own damping.
    density, pull = 10.0, (0.0, 0.0, 400.0)
    dynamics = block(alpha=200.0, beta=1e-4, gravity=pull, integrator=integrator, density=density)
    rollers(dynamics)
    rest = dynamics.mesh.rest
    top = rest[:, 2] > SIDE - 1e-9
    found = []
    for _ in range(30):
        dynamics.advance(Coupling())
        found.append(dynamics.displacement[top, 2].mean())
    times = np.arange(1, 31) / 30
    load = (dynamics.model.mass[:, None] * pull).reshape(-1, 3)
    first = solve_static(dynamics.model, dynamics.masses.inverse > 0, load)[top, 2].mean()
    assert first == pytest.approx(density * pull[2] * SIDE**2 / (2 * E), rel=0.04)
    exact = first * uniaxial_creep(dynamics.material, times)
    # First comes a damped fall.
    late = times > 0.1
    np.testing.assert_allclose(np.array(found)[late], exact[late], rtol=0.02)


@every_model
def test_work_of_a_cycle_is_what_is_stored_and_lost(name: ModelName) -> None:
    dynamics = block(name, TWO)
    rest, viscosity = dynamics.mesh.rest, viscosity_of(dynamics)
    steps, omega, size = 400, 2 * np.pi / 0.5, 0.03
    work, force = 0.0, np.zeros_like(rest)
    for k in range(1, 2 * steps + 1):
        time = 0.5 * k / steps
        u = np.zeros_like(rest)
        u[:, 0] = size * np.sin(omega * time) * rest[:, 2]
        before = dynamics.displacement.copy()
        dynamics.displacement[:] = u
        moved = dynamics.model.force(u)  # the viscous stress is that of before
        work += 0.5 * float(np.sum((force + moved) * (u - before)))
        force = waited(dynamics, 0.5 / steps, 1)
        if k in (steps // 4, steps, 2 * steps):
            stored = dynamics.model.evaluate(u)[1] + viscosity.energy
            scale = max(abs(work), stored)
            assert stored + viscosity.lost == pytest.approx(work, abs=0.01 * scale), k
    # In the steady state a cycle loses pi G'' strain^2 by volume.
    start = viscosity.lost
    for k in range(1, steps + 1):
        dynamics.displacement[:, 0] = size * np.sin(omega * 0.5 * k / steps) * rest[:, 2]
        waited(dynamics, 0.5 / steps, 1)
    shear = E / (2 * (1 + NU))
    loss = sum(g * omega * tau / (1 + (omega * tau) ** 2) for g, tau in TWO)
    exact = np.pi * shear * loss * size**2 * SIDE**3
    # The terms have not all come to the steady state: exp(-1) of the slow one is left.
    assert viscosity.lost - start == pytest.approx(exact, rel=0.03)


@every_model
def test_work_of_a_large_cycle_is_accounted_for_while_points_change_over(name: ModelName) -> None:
    assert cycle(name) < 0.01


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'rk4'])
def test_a_vibrating_block_loses_what_viscosity_takes(integrator: IntegratorName) -> None:
    stepping = TimeStepping(integrator, safety=0.1, max_substeps=5000)
    dynamics = block(alpha=0.0, beta=0.0, stepping=stepping)
    rest = dynamics.mesh.rest
    dynamics.displacement[:, 0] = 0.05 * rest[:, 2] ** 2 / SIDE
    dynamics.restart()
    start = dynamics.model.evaluate(dynamics.displacement)[1]
    energies = [start]
    for _ in range(20):
        motion = dynamics.advance(Coupling())
        energies.append(motion.kinetic_energy + motion.elastic_energy)
        total = energies[-1] + viscosity_of(dynamics).lost
        # Symplectic steps swing by O(dt) around their energy.
        assert total == pytest.approx(start, rel=0.01 if integrator == 'rk4' else 0.05)
    assert energies[-1] < 0.7 * start


@pytest.mark.parametrize('name', ['corotational', 'corotational_smoothed', 'stiffening'])
def test_a_turning_block_feels_no_viscosity(name: ModelName) -> None:
    dynamics = block(name, TWO)
    rest, steps = dynamics.mesh.rest, 40
    for k in range(1, steps + 1):
        angle = np.pi / 2 * k / steps
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        dynamics.displacement[:] = rest @ turn.T - rest + 0.1 * k / steps
        waited(dynamics, 0.2 / steps, 1)
        assert np.abs(dynamics.model.load).max() < 1e-12 * E * SIDE**2


@pytest.mark.parametrize('name', ['corotational', 'corotational_smoothed', 'stiffening'])
def test_a_relaxing_block_that_is_turned_has_its_viscous_force_turned(name: ModelName) -> None:
    angle = 1.0
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    loads = []
    for frame in (np.eye(3), turn):
        dynamics = block(name, ONE)
        rest = dynamics.mesh.rest
        strained = rest * np.array([0.9, 1.1, 1.0])
        dynamics.displacement[:] = strained - rest
        waited(dynamics, 0.1, 4)
        dynamics.displacement[:] = strained @ frame.T - rest
        waited(dynamics, 0.1, 4)
        loads.append(dynamics.model.load.reshape(-1, 3).copy())
    np.testing.assert_allclose(loads[1], loads[0] @ turn.T, atol=1e-9 * np.abs(loads[0]).max())


@every_model
def test_no_volume_relaxes(name: ModelName) -> None:
    dynamics = block(name, ONE)
    dynamics.displacement[:] = 0.02 * dynamics.mesh.rest
    first = dynamics.model.force(dynamics.displacement)
    later = waited(dynamics, 10.0, 5)
    np.testing.assert_allclose(later, first, atol=1e-9 * np.abs(first).max())


def cut_through(dynamics: Dynamics, seed: int) -> list[np.ndarray]:
    """Cut a block by a random stroke; return the load that must be, after each change."""
    rng = np.random.default_rng(seed)
    mesh, method = dynamics.mesh, make_method(CuttingSettings())
    path = random_stroke('plane', mesh.rest, SIDE / 3, rng)
    loads = []
    for result in results_along(method, mesh, path, lambda: dynamics.positions):
        if not result.delta.empty:
            dynamics.apply_cut(result.delta)
            assert dynamics.loads is not None
            dynamics.loads.refresh(dynamics.displacement.ravel())
            loads.append(dynamics.model.load.copy())
    return loads


@every_model
def test_a_cut_in_a_stressed_block_keeps_the_state(name: ModelName) -> None:
    dynamics = block(name, ONE)
    strain = np.diag([0.03, -0.02, 0.01])
    dynamics.displacement[:] = dynamics.mesh.rest @ strain
    waited(dynamics, 0.1, 1)
    terms = viscosity_of(dynamics).nodes.terms[0].copy()
    assert np.abs(terms[:6]).max() > 10.0
    assert cut_through(dynamics, 1)
    n = dynamics.mesh.node_count
    assert dynamics.mesh.topology > 0 and len(dynamics.model.load) == 3 * n
    # The strain is homogeneous: each node, new or old, has the stress of all; so have cut faces.
    np.testing.assert_allclose(
        viscosity_of(dynamics).nodes.terms[:n], np.tile(terms, (n, 1)), rtol=1e-9, atol=1e-6
    )
    fresh = block(name, ONE)
    fresh.displacement[:] = fresh.mesh.rest @ strain
    waited(fresh, 0.1, 1)
    assert dynamics.model.load.reshape(-1, 3).sum(axis=0) == pytest.approx(0.0, abs=1e-12)
    work = float(dynamics.model.load @ dynamics.displacement.ravel())
    assert work == pytest.approx(float(fresh.model.load @ fresh.displacement.ravel()), rel=1e-6)


@pytest.mark.parametrize('active', [ActiveSettings('on'), ActiveSettings('budget', 40)])
def test_sleeping_nodes_have_relaxed_once_they_move(active: ActiveSettings) -> None:
    found = []
    for choice in (ActiveSettings(), active):
        dynamics = block('linear', ONE, alpha=50.0, active=choice)
        top = int(np.argmin(np.square(dynamics.mesh.rest - SIDE).sum(axis=1)))
        here = dynamics.mesh.rest[top]
        for k in range(40):
            down = 0.002 * min(k / 5, 1.0)
            spring = Coupling(
                HOLD, np.array([top]), np.ones(1), here - down, here - down, np.zeros(3), 50.0
            )
            motion = dynamics.advance(spring)
        found.append(float(np.linalg.norm(motion.elastic_force[top])))
        assert len(dynamics.model.load) == 3 * dynamics.mesh.node_count
    assert found[1] == pytest.approx(found[0], rel=0.02 if active.mode == 'on' else 0.3)


@every_model
def test_a_frame_that_is_taken_back_takes_the_viscous_state_back(name: ModelName) -> None:
    dynamics = block(name, ONE)
    dynamics.displacement[:, 0] = 0.02 * dynamics.mesh.rest[:, 2]
    waited(dynamics, 0.1, 1)
    dynamics.restart()
    before = viscosity_of(dynamics).kept(), dynamics.model.load.copy()
    # No tool: a node with this speed leaves its place at any step.
    dynamics.velocity[-1] = 1e6
    motion = dynamics.advance(Coupling())
    assert motion.diverged
    after = viscosity_of(dynamics).kept()
    for old, new in zip(before[0][0], after[0], strict=True):
        np.testing.assert_array_equal(new, old)
    np.testing.assert_array_equal(dynamics.model.load, before[1])


def test_without_a_series_there_is_no_load_and_no_state() -> None:
    dynamics = block(prony=())
    assert dynamics.loads is None and len(dynamics.model.load) == 0


@every_model
def test_a_relaxed_block_is_at_rest(name: ModelName) -> None:
    dynamics = block(name, ONE, gravity=(0.0, 0.0, -9.81))
    dynamics.settle()
    start = dynamics.displacement.copy()
    for _ in range(10):
        dynamics.advance(Coupling(FREE))
    drop = np.abs(dynamics.displacement - start).max()
    assert drop < 1e-3 * np.abs(start).max()
