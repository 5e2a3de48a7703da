"""The planner: what it takes by the cost that it measures, what it says when nothing fits."""

import json
import time
from dataclasses import replace

import pytest
from meshes import box

from bench.accuracy.plan_check import deep_error, script_presses, settlement_error
from bench.accuracy.quadratic import QuadraticTissue
from cutting_trainer.cli.plan_report import as_data, report
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation, make_task
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, ErrorEstimate, Task
from cutting_trainer.tissue_sim.planner.frame_cost import frame_cost, with_regions
from cutting_trainer.tissue_sim.planner.plan import Plan, plan

pytestmark = pytest.mark.long

GEL = Material(5000.0, 0.4, 1000.0, 10.0, 2e-4)


@pytest.fixture(scope='module')
def block() -> TetMesh:
    nodes, tets = box((6, 6, 3), 0.01)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def test_a_plan_for_a_dent_deeper_than_was_checked_says_so(block: TetMesh) -> None:
    task = make_task(load_scene('palpation').tissue)

    def caution(depth: float) -> str:
        budget = Budget(displacement=depth, contact_radius=0.015, error=0.9, cuts=False)
        return plan(replace(task, mesh=block, material=GEL, budget=budget)).caution

    assert caution(0.005) == ''
    deep = 'the indentation is 0.53 of its radius deep, and errors are checked up to 0.4'
    assert deep in caution(0.008)


@pytest.fixture(scope='module')
def plans() -> dict[str, Plan]:
    """Plans of two scenes on a whole core: a slow machine must not decide the model."""
    return {name: plan(task_on_a_core(name)) for name in ('palpation', 'flap')}


def task_on_a_core(name: str) -> Task:
    task = make_task(load_scene(name).tissue)
    return replace(task, budget=task.budget.model_copy(update={'cores': 1.0}))


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


@pytest.mark.thorough
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
    whole = Candidate(
        'corotational_smoothed', 'symplectic_euler', ErrorEstimate(0.1, 0.0, 0.0), cost
    )
    regions = [ActiveSettings('budget', nodes) for nodes in (60, 800)]
    few, more = with_regions(task, whole, regions)
    assert few.cost.frame < more.cost.frame
    assert few.errors.region > more.errors.region > 0
    assert few.errors.total == pytest.approx(0.1 + few.errors.region)
