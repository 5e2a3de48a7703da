"""Nodes far from the tool move by a coarse grid, and that costs little of the answer."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.elastic_force import stiffness_product
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.far_field import FarField
from cutting_trainer.tissue_sim.motion.far_relaxation import LENGTHS
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

pytestmark = pytest.mark.long

CELLS, SIZE = (14, 10, 5), 0.006
TISSUE = Material(5000.0, 0.45, 1000.0, 15.0, 1e-4)
NODES = 120


def slab(*, fixed: bool = True) -> TetMesh:
    nodes, tets = box(CELLS, SIZE)
    return TetMesh(nodes, tets, (nodes[:, 2] < 1e-9) & fixed)


def press(mesh: TetMesh, place: tuple[float, float], depth: float, before: float) -> Coupling:
    """A spring on the nodes of the top within 8 mm of a place."""
    top = np.array([*place, CELLS[2] * SIZE])
    near = np.linalg.norm(mesh.rest - top, axis=1) / 0.008
    nodes = np.flatnonzero((near < 1) & (mesh.rest[:, 2] > top[2] - 1e-9))
    weights = (1 - near[nodes] ** 2) / (1 - near[nodes] ** 2).sum()
    here = weights @ mesh.rest[nodes]
    ends = (here - [0, 0, d] for d in (before, depth))
    return Coupling(PUSH, nodes, weights, *ends, stiffness=100.0)


def pressed(
    active: ActiveSettings, model: ModelName = 'linear_smoothed', integrator: IntegratorName = 'rk4'
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and force of a press that goes on along the surface, by frame."""
    steps = TimeStepping(integrator, min_substeps=8 if integrator == 'implicit' else 1)
    dynamics = Dynamics(slab(), TISSUE, model, steps, active)
    shapes, forces = [], []
    for k in range(36):
        x = 0.03 + 0.0012 * max(k - 16, 0)
        spring = press(dynamics.mesh, (x, 0.03), 4e-4 * min(k + 1, 8), 4e-4 * min(k, 8))
        motion = dynamics.advance(spring)
        assert not motion.trouble
        shapes.append(dynamics.displacement.copy())
        forces.append(spring.force(dynamics.positions)[2])
    return np.array(shapes), np.array(forces)


@pytest.mark.parametrize(
    'model', ['linear', 'linear_smoothed', 'corotational', 'corotational_smoothed', 'stiffening']
)
def test_reduced_stiffness_is_galerkins_whatever_was_cut_and_wherever_the_tool_was(
    model: ModelName,
) -> None:
    nodes, tets = box((8, 6, 4), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    elastic = ElasticModel(mesh, TISSUE, model)
    random, n = np.random.default_rng(3), mesh.node_count
    far = FarField(elastic, 40)
    for trial in range(5):
        at = random.integers(mesh.node_count)
        tool = Coupling(PUSH, np.array([at]), np.ones(1), *mesh.rest[[at, at]], stiffness=1.0)
        n = mesh.node_count
        inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / elastic.mass), 3)
        u, v = np.zeros((2, 3 * n + far.extra))
        region = far.choose(u, v, np.zeros((n, 3)), inverse, [tool], 1.0)
        free = np.zeros(n, bool)
        free[far.nodes] = True
        grid = far._grid
        moves = np.zeros((n, grid.count))
        for k in range(8):
            np.add.at(moves, (np.arange(n), grid.columns[:n, k]), grid.weights[:n, k])
        moves[free] = 0.0
        basis = np.kron(np.hstack([np.diag(free.astype(float)), moves]), np.eye(3))
        x = random.standard_normal(len(u)) * np.concatenate(
            [np.repeat(free, 3), np.repeat(far._mass > 0, 3)]
        )
        expected = basis.T @ (elastic.dense() @ (basis @ x))
        product = np.zeros(len(u))
        stiffness_product(region.operands, x.copy(), product)
        moving = x != 0.0
        np.testing.assert_allclose(
            product[moving], expected[moving], atol=1e-11 * np.abs(expected).max()
        )
        gone = random.choice(len(mesh.tetrahedra), 25, replace=False)
        touched = mesh.apply(TopologyDelta(removed_tetrahedra=gone))
        far.release(touched)
        elastic.update(touched)
        far.follow_cut(touched)
        assert trial == 4 or far.extra >= len(u) - 3 * n


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'rk4', 'implicit'])
def test_a_footprint_that_goes_on_meets_nearly_the_resistance_of_all_nodes_moving(
    integrator: IntegratorName,
) -> None:
    shapes, forces = pressed(ActiveSettings(), integrator=integrator)
    some, felt = pressed(ActiveSettings('budget', NODES), integrator=integrator)
    assert np.abs(felt - forces).max() < 0.02 * np.abs(forces).max()
    assert np.abs(some - shapes).max() < 0.04 * np.abs(shapes).max()


def test_under_a_tool_that_stays_the_far_field_finds_the_shape_of_all_nodes() -> None:
    """The grid alone would keep a part of its error for ever."""
    whole, felt = pressed(ActiveSettings())
    some, force = pressed(ActiveSettings('budget', NODES))
    off = np.abs(some[15] - whole[15]).max() / np.abs(whole[15]).max()
    assert off < 0.006
    assert abs(force[15] / felt[15] - 1) < 1e-3


def test_a_relaxation_leaves_a_third_at_most_of_what_it_is_for_and_adds_to_nothing() -> None:
    left = np.abs(np.prod([1 - length * np.linspace(0, 1, 1001) for length in LENGTHS], axis=0))
    assert left.max() <= 1.0
    assert left[50:].max() < 1 / 3


def test_more_nodes_err_less() -> None:
    dent = pressed(ActiveSettings())[0][:16]
    errors = [
        np.abs(pressed(ActiveSettings('budget', k))[0][:16] - dent).max() for k in (60, 200, 600)
    ]
    assert errors[2] < 0.6 * errors[1] < 0.3 * errors[0]


def test_a_dent_that_was_left_behind_fades() -> None:
    dynamics = Dynamics(
        slab(), TISSUE, 'linear_smoothed', TimeStepping('symplectic_euler'),
        ActiveSettings('budget', NODES),
    )  # fmt: skip
    mesh, deep = dynamics.mesh, 4e-3
    for k in range(12):
        dynamics.advance(press(mesh, (0.02, 0.03), deep * min(k + 1, 8) / 8, deep * min(k, 8) / 8))
    dent = np.abs(dynamics.displacement).max()
    dynamics.advance(press(mesh, (0.07, 0.03), -0.02, -0.02))
    energies = []
    for _ in range(90):
        motion = dynamics.advance(Coupling())
        energies.append(motion.kinetic_energy + motion.elastic_energy)
    assert (np.diff(energies) < 1e-3 * energies[0]).all()
    assert np.abs(dynamics.displacement).max() < 0.05 * dent


def test_a_free_body_moves_as_one_under_its_weight() -> None:
    mesh = slab(fixed=False)
    heavy = (0.3, -0.2, -1.0)
    undamped = replace(TISSUE, alpha=0.0)
    dynamics = Dynamics(
        mesh, undamped, 'linear_smoothed', TimeStepping('symplectic_euler'),
        ActiveSettings('budget', NODES), heavy,
    )  # fmt: skip
    for _ in range(10):
        motion = dynamics.advance(Coupling())
    seconds = 10 * motion.slow_motion / 30
    np.testing.assert_allclose(
        dynamics.velocity, np.tile(np.array(heavy) * seconds, (mesh.node_count, 1)), rtol=1e-9
    )
    assert np.ptp(dynamics.displacement, axis=0).max() < 1e-9


@pytest.mark.parametrize('model', ['linear_smoothed', 'stiffening'])
def test_a_region_that_goes_on_makes_no_jump_and_a_body_at_rest_stays_at_rest(
    model: ModelName,
) -> None:
    """The tissue is in equilibrium under a dent that was made elsewhere, with all nodes moving."""
    mesh = slab()
    load = np.zeros_like(mesh.rest)
    spring = press(mesh, (0.05, 0.03), 0.0, 0.0)
    load[spring.nodes, 2] = -0.1 * spring.weights
    dynamics = Dynamics(
        mesh, TISSUE, model, TimeStepping('symplectic_euler'), ActiveSettings('budget', NODES)
    )
    free = dynamics.masses.inverse > 0
    elastic = ElasticModel(slab(), TISSUE, 'linear_smoothed')
    dynamics.resume(solve_static(elastic, free, load))
    dynamics.model.load = load.ravel()
    dynamics.restart()
    before = dynamics.displacement.copy()
    first = dynamics.model.evaluate(before)[0]
    assert model != 'linear_smoothed' or np.abs(first.ravel()[free]).max() < 1e-9
    energies = []
    for k in range(24):
        touching = press(mesh, (0.02 + 0.002 * k, 0.03), -0.02, -0.02)
        motion = dynamics.advance(touching)
        energies.append(motion.kinetic_energy)
    if model == 'linear_smoothed':
        assert np.abs(dynamics.displacement - before).max() < 1e-6 * np.abs(before).max()
    assert max(energies[-4:]) <= max(energies[:4]) + 1e-15


@pytest.mark.parametrize('model', ['linear_smoothed', 'stiffening'])
def test_energy_does_not_grow_without_damping_while_the_region_goes_to_and_fro(
    model: ModelName,
) -> None:
    undamped = replace(TISSUE, alpha=0.0, beta=0.0)
    dynamics = Dynamics(
        slab(), undamped, model, TimeStepping('symplectic_euler', safety=0.4),
        ActiveSettings('budget', NODES),
    )  # fmt: skip
    rest = dynamics.mesh.rest
    free = dynamics.mesh.fixed == 0
    dynamics.velocity[free] = 0.02 * np.sin(60 * rest[free]) * rest[free][:, 2:] / 0.03
    dynamics.restart()
    sums = []
    for k in range(60):
        x = 0.042 + 0.03 * np.sin(0.5 * k)
        motion = dynamics.advance(press(dynamics.mesh, (x, 0.03), -0.05, -0.05))
        assert not motion.trouble
        sums.append(motion.kinetic_energy + motion.elastic_energy)
    assert max(sums) < 1.1 * sums[0]


def cut_across(mesh: TetMesh, cell: int) -> TopologyDelta:
    """Between two layers of bricks, all that crosses a plane of constant x is taken out."""
    x = mesh.rest[mesh.tetrahedra].mean(axis=1)[:, 0]
    low = cell * SIZE
    return TopologyDelta(removed_tetrahedra=np.flatnonzero((x > low) & (x < low + SIZE)))


def test_a_cut_that_separates_a_cell_does_not_bridge() -> None:
    """Beyond the cut nothing moves, though the tool is far, and the cut within coarse cells."""
    nodes, tets = box(CELLS, SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    dynamics = Dynamics(
        mesh, TISSUE, 'linear_smoothed', TimeStepping('symplectic_euler'),
        ActiveSettings('budget', 60),
    )  # fmt: skip
    dynamics.advance(press(mesh, (0.012, 0.03), 1e-4, 0.0))
    before = dynamics._far.extra
    dynamics.apply_cut(cut_across(mesh, 8))
    assert dynamics._far.extra > before
    beyond = mesh.rest[:, 0] > 8.5 * SIZE
    still = dynamics.displacement[beyond].copy()
    dynamics.velocity[:] = 0.0
    dynamics.restart()
    for k in range(8):
        motion = dynamics.advance(press(mesh, (0.012, 0.03), 4e-4 * (k + 1), 4e-4 * k))
        assert not motion.trouble
    moved = np.abs(dynamics.displacement[~beyond]).max()
    drift = dynamics.displacement[beyond] - still
    assert moved > 1e-3
    assert np.abs(drift).max() < np.abs(still).max() + 1e-9


@pytest.mark.parametrize('model', ['stiffening', 'corotational', 'corotational_smoothed'])
def test_what_has_turned_far_from_the_tool_moves_as_if_there_were_no_region(
    model: ModelName,
) -> None:
    """Its linear stiffness would be that of another direction, and blow it up within a frame."""
    nodes, tets = box((10, 3, 2), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 0] < 1e-9)
    heavy, stepping = (0.0, 0.0, -3.0), TimeStepping('symplectic_euler', max_substeps=2000)
    tissue = replace(TISSUE, stiffening=9.2) if model == 'stiffening' else TISSUE
    settling = Dynamics(mesh, replace(tissue, alpha=40.0), model, stepping, None, heavy)
    for _ in range(60):
        settling.advance(Coupling())
    ways = []
    for active in (ActiveSettings(), ActiveSettings('budget', 20)):
        dynamics = Dynamics(mesh, tissue, model, stepping, active, heavy)
        dynamics.resume(settling.displacement)
        dynamics.velocity[:, 2] = 0.1 * nodes[:, 0] / nodes[:, 0].max() * (mesh.fixed == 0)
        dynamics.restart()
        away = Coupling(PUSH, np.array([0]), np.ones(1), *(nodes[[0, 0]] + 1.0), stiffness=1.0)
        for _ in range(12):
            assert not dynamics.advance(away).trouble
        ways.append(dynamics.displacement.copy())
    turned = np.abs(ways[0] - settling.displacement).max()
    assert np.abs(settling.displacement).max() > 3 * SIZE
    assert np.abs(ways[1] - ways[0]).max() < max(0.1 * turned, 0.01 * np.abs(ways[0]).max())


def test_the_same_frames_and_cuts_give_the_same_bits() -> None:
    ends = []
    for _ in range(2):
        dynamics = Dynamics(
            slab(), TISSUE, 'stiffening', TimeStepping('symplectic_euler'),
            ActiveSettings('budget', 60),
        )  # fmt: skip
        for k in range(10):
            x = 0.02 + 0.003 * k
            dynamics.advance(press(dynamics.mesh, (x, 0.03), 3e-4 * (k + 1), 3e-4 * k))
            if k == 5:
                dynamics.apply_cut(cut_across(dynamics.mesh, 7))
        ends.append(dynamics.displacement.tobytes())
    assert ends[0] == ends[1]
