"""Linear elasticity by node and edge tensors, its bound of the frequency, a pressed block."""

from itertools import pairwise

import numpy as np
import pytest
from meshes import box, irregular_box
from strokes import method_named, straight

from bench.cuts.comparison import highest_frequency
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling, springs_of
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import Integrator
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound, step_bound
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

pytestmark = pytest.mark.long

LIVER = Material(642.55, 0.47, 1050.0, 0.0, 0.0)


def model_of(nodes: np.ndarray, tets: np.ndarray, material: Material = LIVER) -> ElasticModel:
    return ElasticModel(TetMesh(nodes, tets), material)


def test_translation_and_small_rotation_give_no_force() -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 2)
    model = model_of(nodes, tets)
    reference = np.abs(model.force(0.01 * nodes)).max()
    assert np.abs(model.force(np.full_like(nodes, 0.01))).max() < 1e-11 * reference
    spin = np.array([[0, -1, 2], [1, 0, -3], [-2, 3, 0]]) * 1e-3
    assert np.abs(model.force(nodes @ spin.T)).max() < 1e-11 * reference


def test_the_kernel_multiplies_by_the_dense_matrix() -> None:
    nodes, tets = irregular_box((4, 3, 2), 0.01, 4)
    model = model_of(nodes, tets)
    u = np.random.default_rng(4).normal(size=nodes.shape)
    expected = (model.dense() @ u.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(model.force(u), expected, atol=1e-13 * np.abs(expected).max())


def test_the_tensor_of_one_element_equals_the_b_matrix_of_textbooks() -> None:
    nodes = np.array([[0.0, 0, 0], [1.1, 0.1, 0], [0.2, 0.9, 0.1], [0.1, 0.3, 1.2]]) * 0.01
    edges = (nodes[1:] - nodes[0]).T
    volume = np.linalg.det(edges) / 6
    gradients = np.vstack([-np.linalg.inv(edges).sum(axis=0), np.linalg.inv(edges)])
    b = np.zeros((6, 12))
    for a, (x, y, z) in enumerate(gradients):
        b[:, 3 * a : 3 * a + 3] = [
            [x, 0, 0],
            [0, y, 0],
            [0, 0, z],
            [y, x, 0],
            [0, z, y],
            [z, 0, x],
        ]
    lam, mu = LIVER.lame_lambda, LIVER.lame_mu
    elasticity = np.diag([2 * mu] * 3 + [mu] * 3)
    elasticity[:3, :3] += lam
    expected = volume * b.T @ elasticity @ b
    stiffness = model_of(nodes, np.array([[0, 1, 2, 3]])).dense()
    np.testing.assert_allclose(stiffness, expected, atol=1e-12 * np.abs(expected).max())


def test_the_lumped_masses_add_up_to_density_times_volume() -> None:
    nodes, tets = irregular_box((4, 3, 2), 0.01, 5)
    assert model_of(nodes, tets).mass.sum() == pytest.approx(1050 * 24e-6, rel=1e-12)


def test_the_frequency_bound_lies_above_the_highest_frequency_and_not_far() -> None:
    for seed in range(4):
        nodes, tets = irregular_box((3, 3, 2), 0.01, seed)
        model = model_of(nodes, tets)
        root = np.repeat(1 / np.sqrt(model.mass), 3)
        highest = np.sqrt(np.linalg.eigvalsh(root[:, None] * model.dense() * root)[-1])
        bound = FrequencyBound(model, np.repeat(1 / model.mass, 3))
        assert highest < bound.omega < 1.05 * highest


@pytest.mark.parametrize('model', ['linear', 'linear_smoothed', 'stiffening'])
@pytest.mark.parametrize('growth', [0.7, 1.1, 1000.0])
def test_no_mode_is_faster_than_the_bound_at_any_time_of_a_cut(
    model: ModelName, growth: float
) -> None:
    ratios = []
    for seed in range(3):
        nodes, tets = irregular_box((5, 4, 4), 0.005, seed)
        material = Material(5400.0, 0.45, 1060.0, 10.0, 1e-4, 6.0)
        stepping = TimeStepping('symplectic_euler', frequency_growth=growth)
        tissue = Dynamics(TetMesh(nodes, tets, nodes[:, 2] < 1e-9), material, model, stepping)
        ends = np.random.default_rng(seed).uniform(0.002, 0.018, (2, 3)) * [1, 1, 0.5]
        method = method_named()
        for a, b in pairwise(straight(*ends, (0.0, 0.001, 0.02), 6)):
            cut = method.advance(tissue.mesh, tissue.mesh.rest, Sweep(*a, *b))
            tissue.apply_cut(cut.delta)
            highest = highest_frequency(tissue.model, tissue.masses.inverse)
            ratios.append(highest / tissue.masses._frequency.omega)
        assert tissue.masses._frequency.omega <= 1.01 * growth * tissue.masses._frequency.unscaled
    assert max(ratios) < 1.0


def pressed(seconds: float, stiffness: float) -> tuple[ElasticModel, np.ndarray, Coupling]:
    """A block pressed by a spring at the middle of its top until it rests."""
    nodes, tets = box((6, 6, 3), 0.01)
    fixed = nodes[:, 2] < 1e-9
    material = Material(5000.0, 0.4, 1000.0, 20.0, 2e-3)
    model = ElasticModel(TetMesh(nodes, tets, fixed), material)
    top = int(np.argmin(np.linalg.norm(nodes - [0.03, 0.03, 0.03], axis=1)))
    load = Coupling(
        mode=PUSH,
        nodes=np.array([top]),
        weights=np.ones(1),
        start=nodes[top] - [0, 0, 0.004],
        end=nodes[top] - [0, 0, 0.004],
        stiffness=stiffness,
    )
    inverse = np.repeat(np.where(fixed, 0.0, 1 / model.mass), 3)
    u, v = np.zeros(nodes.size), np.zeros(nodes.size)
    omega = FrequencyBound(model, inverse).omega + np.sqrt(stiffness / model.mass[top])
    dt = 0.8 * step_bound('rk4', omega, material.alpha, material.beta)
    Integrator('rk4', 20.0, 2e-3).step(
        model.operands(),
        inverse,
        model.diagonal,
        springs_of([load], nodes),
        u,
        v,
        dt,
        int(seconds / dt),
    )
    return model, u.reshape(-1, 3), load


@pytest.mark.parametrize('stiffness', [20.0, 200.0, 2000.0])
def test_a_pressed_block_comes_to_the_static_solution_for_soft_and_stiff_springs(
    stiffness: float,
) -> None:
    model, u, load = pressed(3.0, stiffness)
    node = int(load.nodes[0])
    free = np.repeat(model.mesh.fixed == 0, 3)
    matrix = model.dense()[np.ix_(free, free)]
    at = np.flatnonzero(np.isin(np.flatnonzero(free), 3 * node + np.arange(3)))
    matrix[at, at] += stiffness
    right = np.zeros(len(matrix))
    right[at[2]] = -0.004 * stiffness
    static = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(u.ravel()[free], static, atol=1e-4 * np.abs(static).max())
    spring = load.force(model.mesh.rest + u)
    np.testing.assert_allclose(spring, model.force(u)[node], rtol=1e-3, atol=1e-6)
