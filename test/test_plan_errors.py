"""What the planner expects of meshes and models: no clock decides here."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box, irregular_box

from bench.accuracy.problems import LargeRotation
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.hyperelastic import law_stress
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.refine import refined
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.contact_errors import contact_error, curvature
from cutting_trainer.tissue_sim.planner.deep_indentation import indent
from cutting_trainer.tissue_sim.planner.indentation import Indenter, places, settlement
from cutting_trainer.tissue_sim.planner.mesh_errors import Probing, Strains
from cutting_trainer.tissue_sim.planner.method_errors import errors_at_rest, time_error

pytestmark = pytest.mark.long

GEL = Material(5000.0, 0.4, 1000.0, 10.0, 2e-4)


def test_refinement_keeps_volume_surface_and_what_is_fixed() -> None:
    nodes, tets = irregular_box((3, 2, 2), 0.01, 0)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    fine = refined(mesh)
    assert len(fine.tetrahedra) == 8 * len(mesh.tetrahedra)
    assert len(fine.triangles) == 4 * len(mesh.triangles)
    assert fine.volumes().min() > 0
    assert fine.volumes().sum() == pytest.approx(mesh.volumes().sum(), rel=1e-12)
    assert np.array_equal(fine.fixed == 1, fine.rest[:, 2] < 1e-9)


def test_a_press_is_one_newton_into_the_tissue_on_a_mesh_and_on_the_refined_one() -> None:
    nodes, tets = box((6, 6, 3), 0.01)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    for press in places(mesh, 0.012):
        assert np.linalg.norm(press.direction) == pytest.approx(1.0)
        for finer in (mesh, refined(mesh)):
            load = press.load(finer)
            np.testing.assert_allclose(load.sum(axis=0), press.direction, atol=1e-12)
            assert (load @ press.direction >= -1e-15).all()


def test_equilibrium_of_a_linear_model_is_the_static_solution() -> None:
    nodes, tets = irregular_box((4, 3, 3), 0.01, 1)
    model = ElasticModel(TetMesh(nodes, tets, nodes[:, 2] < 1e-9), GEL, 'linear_smoothed')
    load = np.random.default_rng(1).normal(size=nodes.shape) * 1e-3
    expected = solve_static(model, np.repeat(model.mesh.fixed == 0, 3), load)
    found = equilibrium(model, load, tolerance=1e-10)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_a_beam_bent_by_45_degrees_is_the_exact_one_to_five_per_cent_if_the_model_turns() -> None:
    problem = LargeRotation()
    turning = problem.rest('corotational_smoothed', 2).errors
    linear = problem.rest('linear_smoothed', 2).errors
    assert turning.displacement < 0.05
    assert linear.displacement > 0.3


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'implicit'])
def test_time_error_is_that_of_a_mass_on_a_spring_moved_at_one_hertz(integrator: str) -> None:
    frequency, step, hand = 30.0, 1 / 60, 2 * np.pi
    c = GEL.alpha + GEL.beta * frequency**2
    u = v = 0.0
    seen = []
    for k in range(600):
        pull = frequency**2 * np.exp(1j * hand * step * (k + (integrator == 'implicit')))
        if integrator == 'implicit':
            v = (v + step * (pull - frequency**2 * u)) / (1 + step * c + step**2 * frequency**2)
        else:
            v = v + step * (pull - frequency**2 * u - c * v)
        u = u + step * v
        seen.append(u)
    turn = np.exp(1j * hand * step * 600)
    exact = frequency**2 / (frequency**2 - hand**2 + 1j * c * hand)
    wrong = abs(seen[-1] / (exact * turn) - 1)
    assert time_error(integrator, GEL, frequency, step) == pytest.approx(wrong, rel=0.02)


def test_a_linear_model_is_charged_with_one_minus_the_cosine() -> None:
    nodes, tets = box((2, 2, 2), 0.01)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    strains = Strains(mesh, GEL, places(mesh, 0.01, 1)[0], 1e-4)
    probing = Probing({False: 0.1, True: 0.05}, 0.02, strains, 1e-3, 30.0)
    budget = Budget(rotation=30.0)
    assert errors_at_rest('linear', probing, budget).rotation == pytest.approx(0.134, abs=1e-3)
    assert errors_at_rest('corotational', probing, budget).rotation == 0.0
    smoothed = errors_at_rest('linear_smoothed', probing, budget)
    assert smoothed.elements < errors_at_rest('linear', probing, budget).elements


def test_a_block_that_is_stretched_and_sheared_has_the_stress_of_its_formula() -> None:
    lam, mu = 3000.0, 1500.0
    stretch = np.diag([1.3, 0.9, 0.8])
    shear = np.eye(3)
    shear[0, 1] = 0.7
    angle = 0.9
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    stress, _ = law_stress(np.array([stretch, shear, turn]), lam, mu)
    sides = np.diag(stretch)
    principal = mu * (sides - 1 / sides) + lam * np.log(sides.prod()) / sides
    np.testing.assert_allclose(stress[0], np.diag(principal), atol=1e-9)
    # Simple shear keeps the volume: P = mu (F - F^-T), so that the Cauchy shear is mu gamma.
    np.testing.assert_allclose((stress[1] @ shear.T)[0, 1], mu * 0.7, rtol=1e-12)
    np.testing.assert_allclose(stress[2], 0.0, atol=1e-9)
    way, size = np.random.default_rng(3).normal(size=(3, 3)), 1e-6
    for b in (0.0, 6.0):
        change = law_stress(shear[None], lam, mu, b)[1]
        ahead, behind = (law_stress((shear + s * way)[None], lam, mu, b)[0] for s in (size, -size))
        slope = np.einsum('bpaj,aj->bp', change[0], way)
        np.testing.assert_allclose((ahead - behind)[0] / (2 * size), slope, rtol=1e-5, atol=1e-3)


@pytest.fixture(scope='module')
def block() -> TetMesh:
    nodes, tets = box((6, 6, 3), 0.01)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def test_a_shallow_dent_is_linear_and_a_deep_one_errs_the_more_the_deeper(block: TetMesh) -> None:
    press = places(block, 0.015, 1)[0]
    shallow, deep, deeper = (
        indent(block, GEL, press, depth).error('linear') for depth in (1e-5, 0.004, 0.008)
    )
    assert shallow < 2e-3
    assert 10 * shallow < deep < deeper


def test_in_a_deep_dent_the_prediction_covers_what_finer_quadratic_elements_find(
    block: TetMesh,
) -> None:
    """They took 0.7534 N for 6 mm: `QuadraticTissue(refined(block), GEL).force(press, 0.006)`."""
    press = places(block, 0.015, 1)[0]
    soft = settlement(ElasticModel(block, GEL, 'linear_smoothed'), press.load(block))[0]
    wrong = abs(0.7534 * soft / 0.006 - 1)
    found = indent(block, GEL, press, 0.006)
    assert 0.14 < wrong < found.error('linear') < 0.2
    assert abs(found.whole.error('linear')) < wrong / 2


def test_a_stiffening_model_errs_by_its_tolerance_alone_and_a_linear_one_by_the_law(
    block: TetMesh,
) -> None:
    found = indent(block, replace(GEL, stiffening=6.0), places(block, 0.015, 1)[0], 0.006)
    assert 0.0 < found.error('law') < 0.04
    assert found.error('linear') > 0.3


def test_the_contact_errs_where_the_footprint_is_wider_than_it_should_be_or_the_surface_curved(
    block: TetMesh,
) -> None:
    wide, narrow = (
        contact_error(block, GEL, places(block, radius, 1)[0], 0.003) for radius in (0.02, 0.01)
    )
    assert wide < 1e-3 < narrow < 0.1
    nodes, tets = box((10, 10, 2), 0.004)
    dome = nodes - [0.02, 0.02, 0.0]
    dome[:, 2] -= np.square(dome[:, :2]).sum(axis=1) / (2 * 0.1) * dome[:, 2] / 0.008
    mesh = TetMesh(dome, tets, nodes[:, 2] < 1e-9)
    press = Indenter(np.array([0.0, 0.0, 0.008]), 0.006, np.array([0.0, 0.0, -1.0]))
    assert curvature(mesh, press) == pytest.approx(1 / 0.1, rel=0.1)
