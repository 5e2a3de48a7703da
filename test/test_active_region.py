"""Nodes that nothing moves are not integrated, and that costs little of the answer."""

import numpy as np
import pytest
from meshes import box

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.adjacency import NodeAdjacency
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveRegion, ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

pytestmark = pytest.mark.long

CELLS, SIZE = (16, 6, 3), 0.01


def palpated(
    settings: ActiveSettings, model: ModelName = 'linear', integrator: IntegratorName = 'rk4'
) -> tuple[np.ndarray, np.ndarray, Dynamics]:
    """Displacement by frame and nodes awake, as a slab is pressed near an end and let go."""
    nodes, tets = box(CELLS, SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    stepping = TimeStepping(integrator, min_substeps=4 if integrator == 'implicit' else 1)
    material = Material(5000.0, 0.4, 1000.0, 20.0, 2e-3)
    dynamics = Dynamics(mesh, material, model, stepping, settings)
    top = np.argsort(np.linalg.norm(nodes - [0.03, 0.03, 0.03], axis=1))[:1]
    shapes, awake = [], []
    for k in range(40):
        before, here = (nodes[top[0]] - [0, 0, 5e-4 * min(j, 8)] for j in (max(k - 1, 0), k))
        pressing = Coupling(PUSH, top, np.ones(1), before, here, stiffness=200.0)
        motion = dynamics.advance(pressing if k < 28 else Coupling())
        assert not motion.trouble
        shapes.append(dynamics.displacement.copy())
        awake.append(dynamics.active_nodes)
    return np.array(shapes), np.array(awake), dynamics


@pytest.mark.parametrize(
    ('model', 'integrator', 'tolerance', 'share'),
    [
        ('linear', 'rk4', 1e-4, 0.4),
        ('corotational_smoothed', 'symplectic_euler', 1e-4, 0.4),
        ('linear', 'implicit', 1e-2, 0.9),
    ],
)
def test_a_held_tissue_sleeps_and_differs_little_from_one_that_moves_as_a_whole(
    model: ModelName, integrator: IntegratorName, tolerance: float, share: float
) -> None:
    whole, everything, _ = palpated(ActiveSettings(), model, integrator)
    some, awake, dynamics = palpated(ActiveSettings('on', tolerance=tolerance), model, integrator)
    assert (everything == dynamics.mesh.node_count).all()
    assert awake[27] < share * dynamics.mesh.node_count
    size = np.abs(whole).max()
    assert np.abs(some[:28] - whole[:28]).max() < 0.01 * size
    assert np.abs(some - whole).max() < 0.05 * size
    assert np.abs(some[-1]).max() < 0.01 * size


def test_a_smaller_tolerance_errs_less() -> None:
    whole, _, _ = palpated(ActiveSettings())
    errors = [
        np.abs(palpated(ActiveSettings('on', tolerance=t))[0][:28] - whole[:28]).max()
        for t in (1e-2, 1e-3, 1e-5)
    ]
    assert errors[2] < errors[1] < errors[0]


def test_a_cut_wakes_what_it_touched_and_the_same_frames_give_the_same_bits() -> None:
    ends = []
    for _ in range(2):
        _, _, dynamics = palpated(ActiveSettings('on'))
        dynamics.displacement[:, 0] += 1e-5 * dynamics.mesh.rest[:, 2]
        dynamics.restart()
        dynamics.apply_cut(TopologyDelta(removed_tetrahedra=np.array([100, 101])))
        dynamics.advance(Coupling())
        assert dynamics.active_nodes > 0
        ends.append(dynamics.displacement.tobytes())
    assert ends[0] == ends[1]


@pytest.mark.parametrize('model', ['linear', 'linear_smoothed'])
def test_energy_and_force_that_are_kept_by_node_are_those_of_the_whole_tissue(
    model: ModelName,
) -> None:
    """After sleeping, after a cut, after frames that followed it."""
    _, _, dynamics = palpated(ActiveSettings('on'), model)
    dynamics.apply_cut(TopologyDelta(removed_tetrahedra=np.array([100, 101, 102])))
    for _ in range(3):
        motion = dynamics.advance(Coupling())
        assert dynamics.active_nodes < dynamics.mesh.node_count
        force, energy = dynamics.model.evaluate(dynamics.displacement)
        np.testing.assert_allclose(motion.elastic_force, force, atol=1e-12 * np.abs(force).max())
        assert motion.elastic_energy == pytest.approx(energy, rel=1e-12)


def test_neighbours_follow_cuts_as_if_they_were_found_anew() -> None:
    nodes, tets = box((6, 4, 3), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    model = ElasticModel(mesh, Material(3000.0, 0.4, 1000.0), 'linear')
    assert len(model.neighbours.around(np.array([0]), 0)) == 1
    random = np.random.default_rng(0)
    for _ in range(12):
        gone = random.choice(len(mesh.tetrahedra), 9, replace=False)
        model.update(mesh.apply(TopologyDelta(removed_tetrahedra=gone)))
        anew = NodeAdjacency(mesh)
        for seed in random.choice(mesh.node_count, 5):
            for rings in (1, 2):
                seeds = np.array([seed])
                found = model.neighbours.around(seeds, rings)
                np.testing.assert_array_equal(found, anew.around(seeds, rings))
        ring = anew.around(seeds, 1)
        together = mesh.tetrahedra[(mesh.tetrahedra == seed).any(axis=1)]
        np.testing.assert_array_equal(ring, np.unique(together))


@pytest.mark.parametrize('model', ['linear', 'linear_smoothed', 'corotational_smoothed'])
def test_a_product_at_some_nodes_is_bit_for_bit_that_of_all(model: ModelName) -> None:
    nodes, tets = box((6, 4, 3), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    elastic = ElasticModel(mesh, Material(3000.0, 0.4, 1000.0), model)
    x = np.random.default_rng(0).standard_normal((mesh.node_count, 3))
    some = np.array([3, 40, 41, 77])
    np.testing.assert_array_equal(elastic.product(x, some), elastic.product(x)[some])


def test_a_frame_of_many_substeps_does_not_choose_its_nodes_more_often() -> None:
    nodes, tets = box(CELLS, SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    model = ElasticModel(mesh, Material(5000.0, 0.4, 1000.0, 20.0, 2e-3), 'linear')
    region = ActiveRegion(model, ActiveSettings('on'), implicit=False)
    choices = []
    for substeps in (40, 200, 900):
        done = count = 0
        while done < substeps:
            done += region.ahead(substeps - done, substeps, 1.0)
            count += 1
        choices.append(count)
    assert choices == [3, 3, 3]
