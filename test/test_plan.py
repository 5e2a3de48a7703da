"""The planner: what it asks of a mesh, what it takes, what it says when nothing fits."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box, irregular_box

from session.chart_problems import LargeRotation
from session.plan_report import report
from session.scene import load_scene
from tissue_sim.assembly import make_simulation, make_task
from tissue_sim.budget import Budget
from tissue_sim.compliance import solve_static
from tissue_sim.elasticity import ElasticModel
from tissue_sim.equilibrium import equilibrium
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.plan import Plan, model_errors, plan, time_error
from tissue_sim.probe import Probing, places
from tissue_sim.refine import refined

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
    probing = Probing({False: 0.1, True: 0.05}, 0.02, 30.0)
    budget = Budget(rotation=30.0)
    assert model_errors('linear', probing, budget).rotation == pytest.approx(0.134, abs=1e-3)
    assert model_errors('corotational', probing, budget).rotation == 0.0
    smoothed = model_errors('linear_smoothed', probing, budget)
    assert smoothed.elements < model_errors('linear', probing, budget).elements


@pytest.fixture(scope='module')
def plans() -> dict[str, Plan]:
    return {name: plan(make_task(load_scene(name).tissue)) for name in ('palpation', 'flap')}


def test_the_palpation_scene_takes_the_linear_model_and_the_flap_a_corotational_one(
    plans: dict[str, Plan],
) -> None:
    assert plans['palpation'].chosen is not None and plans['flap'].chosen is not None
    assert plans['palpation'].chosen.model == 'linear'
    assert plans['flap'].chosen.model.startswith('corotational')
    assert any(s.startswith('linear: 29 % at the 45 degrees') for s in plans['flap'].rejected)
    text = '\n'.join(report('flap', load_scene('flap').tissue, plans['flap']))
    assert 'not linear: 29 % at the 45 degrees that this scene allows' in text


def test_the_scenes_take_the_model_that_their_plan_finds(plans: dict[str, Plan]) -> None:
    for name, found in plans.items():
        assert found.chosen is not None
        assert load_scene(name).tissue.model == found.chosen.model


def test_the_predicted_error_is_not_exceeded_by_quadratic_elements(plans: dict[str, Plan]) -> None:
    """At places of its own: those of the scene's script."""
    from bench.plan_check import settlement_error

    found = plans['palpation']
    assert found.chosen is not None
    wrong = settlement_error(found, np.array([[0.02, 0.015, 0.04]]))
    assert 0.02 < wrong < found.chosen.errors.elements


def test_where_nothing_fits_what_is_proposed_does() -> None:
    task = make_task(load_scene('block').tissue)
    none = plan(replace(task, budget=task.budget.model_copy(update={'error': 0.2})))
    assert none.chosen is None and none.remedies
    percent = float(none.remedies[0].split('error of ')[1].split(' %')[0])
    relaxed = task.budget.model_copy(update={'error': percent / 100})
    found = plan(replace(task, budget=relaxed))
    assert found.chosen is not None
    assert none.remedies[0].endswith(found.chosen.model)


def test_after_a_cut_the_plan_is_held_against_what_the_step_costs_now(
    plans: dict[str, Plan],
) -> None:
    found = plans['palpation']
    assert found.chosen is not None
    cost = found.chosen.cost
    assert found.over(cost.substeps, found.tetrahedra) == ''
    many = 10 * found.task.available / (cost.each or cost.frame)
    assert 'needs' in found.over(many, found.tetrahedra) or cost.each == 0


def test_a_scene_that_asks_for_it_runs_by_its_plan() -> None:
    settings = load_scene('block').tissue.model_copy(update={'method': 'auto'})
    simulation, found = make_simulation(settings)
    assert found is not None and found.chosen is not None
    assert simulation.model.name == found.chosen.model
    assert simulation.dynamics.stepping.integrator == found.chosen.integrator
    _, none = make_simulation(settings.model_copy(update={'method': 'given'}))
    assert none is None
