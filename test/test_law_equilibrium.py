"""Equilibria of the stiffening law where softening points and large turns defeat full steps."""

import numpy as np
import pytest
from meshes import irregular_box

from bench.accuracy.law_problems import CASES, settled, unstructured_block
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.stiffening_equilibrium import LawEquilibrium
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ('case', 'edge', 'nu'),
    [
        ('twist 90', 0.0067, 0.49),
        ('press 50 %', 0.0067, 0.45),
        ('punch 30 %', 0.0055, 0.45),
        pytest.param('twist 90', 0.0067, 0.45, marks=pytest.mark.thorough),
        pytest.param('press 50 %', 0.0067, 0.49, marks=pytest.mark.thorough),
        pytest.param('punch 30 %', 0.0055, 0.49, marks=pytest.mark.thorough),
    ],
)
def test_a_body_far_from_its_shape_finds_its_equilibrium_and_its_shape_again(
    case: str, edge: float, nu: float
) -> None:
    mesh = unstructured_block(CASES[case], edge, 1)
    model, u, _ = settled(CASES[case], mesh, nu, 6.0)
    force, held = model.force(u), mesh.fixed == 1
    assert np.linalg.norm(force[~held]) < 1e-3 * np.linalg.norm(force[held])
    left = equilibrium(model, np.zeros_like(u), held=held, start=np.where(held[:, None], 0.0, u))
    assert np.abs(left).max() < 1e-5


@pytest.mark.parametrize('size', [0.002, 0.004, 0.008])
def test_a_body_finds_its_shape_again_whatever_is_inside_out(size: float) -> None:
    """Points inside out, or wound twice, can hold each other in a wrong equilibrium."""
    nodes, tets = irregular_box((5, 4, 4), 0.005, 1, 0.2)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    model = ElasticModel(mesh, Material(5400.0, 0.45, 1060.0, stiffening=6.0), 'stiffening')
    for seed in range(8):
        start = np.random.default_rng(seed).normal(size=nodes.shape) * size
        start[mesh.fixed == 1] = 0.0
        left = equilibrium(model, np.zeros_like(start), start=start)
        assert np.abs(left).max() < 1e-5, seed


def test_an_edge_pulled_with_the_force_of_a_tough_cut_finds_its_equilibrium() -> None:
    nodes, tets = irregular_box((8, 8, 4), 0.006, 1, 0.1)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    edge = np.square(nodes[:, :2] - 0.024).sum(axis=1) < 0.002**2
    edge &= nodes[:, 2] > 0.017
    load = np.zeros_like(nodes)
    load[edge, 0] = 0.9 / edge.sum()
    model = ElasticModel(mesh, Material(5400.0, 0.45, 1060.0, stiffening=6.0), 'stiffening')
    u = np.zeros_like(nodes)
    for share in (1 / 3, 2 / 3, 1.0):
        u = equilibrium(model, share * load, start=u, tolerance=1e-5)
    free = mesh.fixed == 0
    assert np.abs(load - model.force(u))[free].max() < 1e-4 * np.abs(load).max()
    assert np.linalg.det(_gradients(mesh, u)).min() > 0.0


def _gradients(mesh: TetMesh, u: np.ndarray) -> np.ndarray:
    tets = mesh.tetrahedra.astype(np.int64)
    rest, now = mesh.rest[tets], (mesh.rest + u)[tets]
    edges = [np.swapaxes(p[:, 1:] - p[:, :1], 1, 2) for p in (now, rest)]
    return np.asarray(edges[0] @ np.linalg.inv(edges[1]))


@pytest.mark.parametrize('tolerance', [0.0, 0.05])
def test_many_elements_at_once_have_the_forces_and_energy_of_the_law_point_by_point(
    tolerance: float,
) -> None:
    nodes, tets = irregular_box((5, 4, 4), 0.005, 1, 0.2)
    model = ElasticModel(
        TetMesh(nodes, tets, nodes[:, 2] < 1e-9), Material(5400.0, 0.45, 1060.0, stiffening=6.0),
        'stiffening', tolerance,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    shares = (1e-4, 3e-4, 2e-3)  # linear, in the blend, and some elements inside out
    for size in shares:
        u = rng.normal(size=nodes.shape) * size
        law = LawEquilibrium(model, np.zeros(len(nodes), bool))
        energy, residual, _ = law._evaluate(u.ravel(), np.zeros(u.size), False)
        force, found = model.evaluate(u)
        np.testing.assert_allclose(force.ravel(), -residual, atol=1e-9 * abs(residual).max())
        assert found == pytest.approx(energy, rel=1e-9)
