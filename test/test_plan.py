"""The planner: what it asks of a mesh, what it takes, what it says when nothing fits."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from meshes import box, irregular_box

from bench.plan_check import deep_error, script_presses, settlement_error
from bench.quadratic import QuadraticTissue
from session.measure.chart_problems import LargeRotation
from session.measure.plan_report import as_data, report
from session.scene import load_scene
from tissue_sim.active_region import ActiveSettings
from tissue_sim.assembly import make_simulation, make_task
from tissue_sim.budget import Budget
from tissue_sim.candidate import Candidate, Cost, Errors
from tissue_sim.compliance import solve_static
from tissue_sim.dent import dents
from tissue_sim.elasticity import ElasticModel
from tissue_sim.equilibrium import equilibrium
from tissue_sim.frame_cost import frame_cost, with_regions
from tissue_sim.hyperelastic import neo_hookean
from tissue_sim.integrators import IntegratorName
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.method_errors import errors_at_rest, time_error
from tissue_sim.plan import Plan, plan
from tissue_sim.press import places, settlement
from tissue_sim.probe import Probing, Strains
from tissue_sim.refine import refined

pytestmark = pytest.mark.alone

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
    probing = Probing({False: 0.1, True: 0.05}, strains, 30.0)
    budget = Budget(rotation=30.0)
    assert errors_at_rest('linear', probing, budget).rotation == pytest.approx(0.134, abs=1e-3)
    assert errors_at_rest('corotational', probing, budget).rotation == 0.0
    smoothed = errors_at_rest('linear_smoothed', probing, budget)
    assert smoothed.elements < errors_at_rest('linear', probing, budget).elements


def test_a_neo_hookean_block_that_is_stretched_and_sheared_has_the_stress_of_its_formula() -> None:
    lam, mu = 3000.0, 1500.0
    stretch = np.diag([1.3, 0.9, 0.8])
    shear = np.eye(3)
    shear[0, 1] = 0.7
    angle = 0.9
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    stress, change = neo_hookean(np.array([stretch, shear, turn]), lam, mu)
    sides = np.diag(stretch)
    principal = mu * (sides - 1 / sides) + lam * np.log(sides.prod()) / sides
    np.testing.assert_allclose(stress[0], np.diag(principal), atol=1e-9)
    # Simple shear keeps the volume: P = mu (F - F^-T), so that the Cauchy shear is mu gamma.
    np.testing.assert_allclose((stress[1] @ shear.T)[0, 1], mu * 0.7, rtol=1e-12)
    np.testing.assert_allclose(stress[2], 0.0, atol=1e-9)
    way, size = np.random.default_rng(3).normal(size=(3, 3)), 1e-6
    ahead, behind = (neo_hookean((shear + s * way)[None], lam, mu)[0] for s in (size, -size))
    slope = np.einsum('bpaj,aj->bp', change[1], way)
    np.testing.assert_allclose((ahead - behind)[0] / (2 * size), slope, rtol=1e-5, atol=1e-3)


@pytest.fixture(scope='module')
def block() -> TetMesh:
    nodes, tets = box((6, 6, 3), 0.01)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def test_a_shallow_dent_is_linear_and_a_deep_one_errs_the_more_the_deeper(block: TetMesh) -> None:
    press = places(block, 0.015, 1)[0]
    shallow, deep, deeper = (
        dents(block, GEL, press, depth).error(rotating=False) for depth in (1e-5, 0.004, 0.008)
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
    found = dents(block, GEL, press, 0.006)
    assert 0.14 < wrong < found.error(rotating=False) < 0.2
    assert abs(found.whole.error(rotating=False)) < wrong / 2


def test_a_plan_for_a_dent_deeper_than_was_checked_says_so(block: TetMesh) -> None:
    task = make_task(load_scene('palpation').tissue)

    def caution(depth: float) -> str:
        budget = Budget(displacement=depth, contact_radius=0.015, error=0.9, cuts=False)
        return plan(replace(task, mesh=block, material=GEL, budget=budget)).caution

    assert caution(0.005) == ''
    assert 'the dent is 0.53 of its radius deep, and errors are checked up to 0.4' in caution(0.008)


@pytest.fixture(scope='module')
def plans() -> dict[str, Plan]:
    return {name: plan(make_task(load_scene(name).tissue)) for name in ('palpation', 'flap')}


def test_the_palpation_scene_takes_the_linear_model_and_the_flap_a_corotational_one(
    plans: dict[str, Plan],
) -> None:
    assert plans['palpation'].chosen is not None and plans['flap'].chosen is not None
    assert plans['palpation'].chosen.model == 'linear'
    assert plans['flap'].chosen.model.startswith('corotational')
    assert any(str(r).startswith('linear: 29 % at the 45 degrees') for r in plans['flap'].rejected)


def test_the_scenes_take_the_model_that_their_plan_finds(plans: dict[str, Plan]) -> None:
    for name, found in plans.items():
        assert found.chosen is not None
        assert load_scene(name).tissue.model == found.chosen.model


def test_the_predicted_error_is_not_exceeded_by_quadratic_elements(plans: dict[str, Plan]) -> None:
    """At a place of its own, one of the scene's script, and as deep as the budget says."""
    found = plans['palpation']
    assert found.chosen is not None
    task = found.task
    presses = script_presses(load_scene('palpation'), task)[:1]
    exact = QuadraticTissue(task.mesh, task.material)
    assert 0.0 < settlement_error(task, found.chosen, presses, exact) < found.chosen.errors.elements
    assert 0.0 < deep_error(task, found.chosen, presses, exact) < found.chosen.errors.total


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


def test_the_report_says_what_is_taken_and_why_nothing_less_and_so_does_the_json(
    plans: dict[str, Plan],
) -> None:
    settings, found = load_scene('flap').tissue, plans['flap']
    lines = report('flap', settings, found)
    text = '\n'.join(lines)
    assert 'asked: up to 12 mm and 45 degrees, error at most 20 %' in text
    assert 'linear: 29 % at the 45 degrees that this scene allows' in text
    assert any(line.startswith('taken: corotational_smoothed by ') for line in lines)
    data = json.loads(json.dumps(as_data('flap', settings, found)))
    assert data['chosen']['model'] == 'corotational_smoothed'
    errors = data['chosen']['errors']
    assert errors['total'] == pytest.approx(
        errors['elements'] + errors['strain'] + errors['time'] + errors['region']
    )
    assert data['chosen']['cost']['frame'] <= data['available']
    lesser = next(r for r in data['rejected'] if r['method'] == 'linear')
    assert lesser['fails'] and '45 degrees' in lesser['why']


def test_a_scene_whose_own_method_does_not_meet_its_budget_is_told(plans: dict[str, Plan]) -> None:
    settings = load_scene('flap').tissue.model_copy(update={'model': 'linear'})
    text = '\n'.join(report('flap', settings, plans['flap']))
    assert (
        f'the scene takes linear by {settings.integrator}, which does not meet its budget' in text
    )
    assert 'tissue.method: auto would follow the plan' in text


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'implicit'])
def test_what_else_the_machine_does_during_a_stroke_is_not_counted_as_cost(
    integrator: IntegratorName, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = make_task(load_scene('block').tissue)
    clock = [0.0, 0]

    def tick(busy: bool) -> float:
        clock[1] += 1
        clock[0] += 1e-3 + 0.05 * (busy and clock[1] % 96 < 32)
        return clock[0]

    costs = []
    for busy in (False, True):
        clock[1] = 0
        monkeypatch.setattr(time, 'thread_time', lambda busy=busy: tick(busy))
        costs.append(frame_cost(task, 'linear', integrator).frame)
    assert costs[1] == pytest.approx(costs[0])


def test_a_region_of_few_nodes_makes_a_large_tissue_cheaper_and_its_error_is_counted() -> None:
    nodes, tets = box((30, 6, 6), 0.005)
    task = replace(
        make_task(load_scene('palpation').tissue),
        mesh=TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        budget=Budget(displacement=0.002, contact_radius=0.01),
    )
    cost = Cost(20, 1e-3, 0.0, 1e-3)
    whole = Candidate('corotational_smoothed', 'symplectic_euler', Errors(0.1, 0.0, 0.0), cost)
    regions = [ActiveSettings('budget', nodes) for nodes in (60, 800)]
    few, more = with_regions(task, whole, regions)
    assert few.cost.frame < more.cost.frame
    assert few.errors.region > more.errors.region > 0
    assert few.errors.total == pytest.approx(0.1 + few.errors.region)
