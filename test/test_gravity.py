"""Weight: the tissue hangs as the exact solution says, and a session begins at rest under it."""

from pathlib import Path

import numpy as np
import pytest
from meshes import box

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.coupling import FREE, Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

E, DENSITY, G, LENGTH = 5400.0, 1060.0, 0.5, 0.08
Vector = tuple[float, float, float]


def bar(
    name: ModelName = 'linear_smoothed',
    integrator: IntegratorName = 'symplectic_euler',
    *,
    gravity: Vector = (0.0, 0.0, -G),
    prony: tuple[tuple[float, float], ...] = (),
    active: ActiveSettings | None = None,
    growth: float = np.inf,
) -> Dynamics:
    """A bar that hangs from its upper end; without Poisson's ratio it is strained along its axis
    only."""
    nodes, tets = box((2, 2, 8), LENGTH / 8)
    mesh = TetMesh(nodes, tets, nodes[:, 2] > LENGTH - 1e-9)
    stepping = TimeStepping(integrator, frequency_growth=growth)
    material = Material(E, 0.0, DENSITY, 10.0, 5e-4, 0.0, prony)
    return Dynamics(mesh, material, name, stepping, active, gravity)


def elongation(dynamics: Dynamics) -> float:
    return float(-dynamics.displacement[dynamics.mesh.rest[:, 2] < 1e-9, 2].mean())


@pytest.mark.parametrize('name', MODELS)
def test_a_hanging_bar_is_longer_by_half_its_weight_over_stiffness(name: ModelName) -> None:
    dynamics = bar(name)
    dynamics.settle()
    exact = DENSITY * G * LENGTH**2 / (2 * E)
    assert elongation(dynamics) == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize('integrator', INTEGRATORS)
@pytest.mark.parametrize('mode', ['off', 'on'])
def test_it_stays_where_it_has_settled(integrator: IntegratorName, mode: str) -> None:
    dynamics = bar('linear', integrator, active=ActiveSettings('on' if mode == 'on' else 'off'))
    dynamics.settle()
    before = dynamics.displacement.copy()
    for _ in range(20):
        motion = dynamics.advance(Coupling(FREE))
    assert not motion.trouble
    assert np.abs(dynamics.displacement - before).max() < 1e-4 * np.abs(before).max()
    # The forces are in balance: none is left for a tool that touches it.
    free = dynamics.mesh.fixed == 0
    weight = DENSITY * G * LENGTH / 16 * (LENGTH / 4) ** 2
    assert np.abs(motion.elastic_force[free]).max() < 1e-3 * weight


def test_mass_that_is_added_for_the_step_weighs_nothing() -> None:
    found = []
    for growth in (np.inf, 1.0):
        dynamics = bar('linear', growth=growth)
        dynamics.masses._frequency._ceiling *= 1.0 if growth > 1.0 else 0.5
        dynamics.masses.follow_cut(np.arange(dynamics.mesh.node_count))
        dynamics.settle()
        for _ in range(20):
            dynamics.advance(Coupling(FREE))
        found.append(elongation(dynamics))
        heavier = (
            dynamics.masses._inertia[: dynamics.mesh.node_count].sum() / dynamics.model.mass.sum()
        )
    assert heavier > 1.5
    assert found[1] == pytest.approx(found[0], rel=1e-4)


def test_a_viscous_bar_hangs_by_its_long_term_stiffness() -> None:
    # Volume does not relax: with K and G of nu = 0, E is 9 K G' / (3 K + G'), G' = (1 - g) G.
    nodes, tets = box((4, 4, 16), LENGTH / 16)
    found = []
    for prony in ((), ((0.5, 0.3),)):
        mesh = TetMesh(nodes, tets, nodes[:, 2] > LENGTH - 1e-9)
        material = Material(E, 0.0, DENSITY, 10.0, 5e-4, 0.0, prony)
        dynamics = Dynamics(mesh, material, 'linear', gravity=(0.0, 0.0, -G))
        dynamics.settle()
        found.append(elongation(dynamics))
    bulk, shear = E / 3, E / 4
    longer = E / (9 * bulk * shear / (3 * bulk + shear))
    # The held end keeps its width.
    assert found[1] / found[0] == pytest.approx(longer, rel=0.05)


def test_a_piece_that_is_cut_off_falls_freely_and_is_no_divergence() -> None:
    dynamics = bar('corotational', gravity=(0.0, 0.0, -9.81), prony=((0.3, 0.2),))
    rest = dynamics.mesh.rest
    dynamics.displacement[:] = 0.0
    cells = rest[dynamics.mesh.tetrahedra].mean(axis=1)[:, 2]
    layer = np.flatnonzero((cells > LENGTH / 4) & (cells < 3 * LENGTH / 8))
    dynamics.apply_cut(TopologyDelta(removed_tetrahedra=layer))
    dynamics._integrator._damping[:] = 0.0
    lowest = int(np.argmin(dynamics.mesh.rest[:, 2]))
    start = dynamics.positions[lowest, 2]
    for _ in range(3):
        motion = dynamics.advance(Coupling(FREE))
        assert not motion.diverged and not motion.trouble
    assert start - dynamics.positions[lowest, 2] == pytest.approx(9.81 * 0.1**2 / 2, rel=0.05)


def test_tissue_that_nothing_holds_finds_no_rest() -> None:
    dynamics = bar('linear', gravity=(0.0, 0.0, -9.81))
    cells = dynamics.mesh.rest[dynamics.mesh.tetrahedra].mean(axis=1)[:, 2]
    layer = np.flatnonzero((cells > LENGTH / 4) & (cells < 3 * LENGTH / 8))
    dynamics.apply_cut(TopologyDelta(removed_tetrahedra=layer))
    with pytest.raises(MeshError, match='no rest under its weight'):
        dynamics.settle()


@pytest.mark.long
def test_a_session_begins_at_rest(tmp_path: Path) -> None:
    scene = load_scene('block').tissue
    settings = scene.model_copy(update={'gravity': (0.0, 0.0, -9.81)})
    simulation, _ = make_simulation(settings)
    before = simulation.displacement.copy()
    assert np.abs(before).max() > 1e-4
    for _ in range(10):
        simulation.frame(None)
    assert np.abs(simulation.displacement - before).max() < 1e-3 * np.abs(before).max()


def test_without_gravity_there_is_no_load() -> None:
    dynamics = bar(gravity=(0.0, 0.0, 0.0))
    before = dynamics.displacement.copy()
    dynamics.settle()
    assert dynamics.loads is None and len(dynamics.model.load) == 0
    np.testing.assert_array_equal(dynamics.displacement, before)
