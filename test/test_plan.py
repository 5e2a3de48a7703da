"""The planner: what it takes by the cost that it measures, what it says when nothing fits."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from meshes import box

from bench.accuracy.plan_check import deep_error, script_presses, settlement_error
from bench.accuracy.quadratic import QuadraticTissue
from cutting_trainer.cli.plan_report import as_data, report
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation, make_task
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import Frame, ToolContact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.planner import frame_cost as costs
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, ErrorEstimate, Task
from cutting_trainer.tissue_sim.planner.far_field_choice import far_field
from cutting_trainer.tissue_sim.planner.frame_cost import frame_cost, with_blade
from cutting_trainer.tissue_sim.planner.indentation import places
from cutting_trainer.tissue_sim.planner.memory import recall, remember
from cutting_trainer.tissue_sim.planner.plan import Plan, plan
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

pytestmark = pytest.mark.long

GEL = Material(5000.0, 0.4, 1000.0, 10.0, 2e-4)


@pytest.fixture(scope='module')
def block() -> TetMesh:
    nodes, tets = box((6, 6, 3), 0.01)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def test_a_plan_for_a_dent_deeper_than_was_checked_says_so(
    block: TetMesh, plans: dict[str, Plan]
) -> None:
    task = make_task(load_scene('palpation').tissue)

    budget = Budget(displacement=0.008, contact_radius=0.015, error=0.9, cuts=False)
    deep = 'the indentation is 0.53 of its radius deep, and errors are checked up to 0.4'
    assert deep in plan(replace(task, mesh=block, material=GEL, budget=budget)).caution
    assert plans['palpation'].caution == ''


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
    task = task_on_a_core('palpation')
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
    many = 10 * found.available / (cost.each or cost.frame)
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
        sum(errors[cause] for cause in ('elements', 'contact', 'strain', 'time', 'region'))
    )
    said = next(line for line in lines if line.startswith('  error '))
    assert said.count(' % by ') == 5  # each cause, those of no size too
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
        costs.append(frame_cost(task, 'linear', integrator, 0.001).frame)
    assert costs[1] == pytest.approx(costs[0])


def block_task() -> tuple[Task, Candidate]:
    """The thesis's block with its method, and the time of a whole core."""
    task = task_on_a_core('block')
    at_rest = ErrorEstimate(0.1, 0.0, 0.0)
    return task, Candidate('linear_smoothed', 'symplectic_euler', at_rest, Cost(20, 1e-3, 1e-3, 0))


def test_the_blade_of_the_plan_pays_for_its_way_at_the_depth_of_the_tool(block: TetMesh) -> None:
    tough = Resistance(1e-6, 20.0, 0.0)
    task = replace(block_task()[0], mesh=block, material=GEL, resistance=tough)
    task = replace(task, budget=Budget(contact_radius=0.008))
    simulation = TissueSimulation(block, GEL, tough, model='linear_smoothed')
    forces, depth = [], 0.008
    for contact in costs._drawn(task):
        frame = simulation.frame(contact)
        if frame.command is not None:
            simulation.cut_done()
        forces.append(float(np.linalg.norm(frame.force)))
    assert simulation.blade is not None
    assert np.median(forces[-10:]) == pytest.approx(tough.toughness * depth, rel=0.2)
    assert simulation.blade.paid > 0.3 * tough.toughness * depth * 0.03  # the tissue yields first


def test_a_scene_without_cuts_has_no_cost_of_a_cut() -> None:
    task, candidate = block_task()
    assert with_blade(task, candidate).cutting > 0.0
    whole = replace(task, budget=task.budget.model_copy(update={'cuts': False}))
    assert with_blade(whole, candidate).cutting == 0.0


def test_a_method_whose_frames_in_a_cut_take_too_long_does_not_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, _ = block_task()

    def timed(simulation: TissueSimulation, contact: ToolContact | None) -> tuple[Frame, float]:
        frame = simulation.frame(contact)
        return frame, 1e-3 if simulation.blade is None else 0.04

    monkeypatch.setattr(costs, '_timed', timed)
    none = plan(task)
    assert none.chosen is None
    dear = [r for r in none.rejected if '40 ms a frame while a blade is drawn, of 33 ms' in r.why]
    assert {r.method.rsplit(' by ')[1] for r in dear} >= {'symplectic_euler', 'implicit'}
    whole = plan(replace(task, budget=task.budget.model_copy(update={'cuts': False})))
    assert whole.chosen is not None and whole.chosen.cutting == 0.0


def far_task(error: float) -> tuple[Task, Candidate]:
    """A slab with a method, and time enough on any machine."""
    nodes, tets = box((14, 14, 6), 0.006)
    budget = Budget(displacement=0.002, contact_radius=0.01, error=error, cuts=False, cores=1.0)
    task = make_task(load_scene('palpation').tissue)
    task = replace(
        task,
        stepping=replace(task.stepping, rate=2.0, max_substeps=10_000),
        mesh=TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        budget=budget,
    )
    at_rest = ErrorEstimate(0.1, 0.0, 0.0)
    return task, Candidate('linear_smoothed', 'symplectic_euler', at_rest, Cost(20, 1e-3, 1.0, 0))


def test_cuts_save_no_substep_where_the_mesh_itself_was_slowed_down() -> None:
    """The mass that a growth below 1 adds to the mesh is in the measured cost already."""
    task = make_task(load_scene('palpation').tissue)
    at_rest = ErrorEstimate(0.0, 0.0, 0.0)
    candidate = Candidate('linear', 'symplectic_euler', at_rest, Cost(20, 1e-3, 1e-3, 1e-4))
    budget = task.budget.model_copy(update={'cuts': True})

    def worst(growth: float) -> Cost:
        stepping = replace(task.stepping, frequency_growth=growth)
        return replace(task, budget=budget, stepping=stepping).worst(candidate)

    assert worst(0.7) == worst(1.0) == candidate.cost
    assert worst(1.5).substeps == 30


def test_a_far_field_has_the_fewest_nodes_that_are_accurate_enough() -> None:
    found = []
    for allowed in (0.35, 0.105):
        task, whole = far_task(allowed)
        indenter = places(task.mesh, 0.01, 1)[0]
        chosen, others = far_field(task, whole, indenter, 0.002, lambda text: None)
        assert chosen is not None and chosen.errors.total <= allowed
        assert all('by far nodes that move together' in other.why for other in others)
        found.append(chosen)
    coarse, fine = found
    assert coarse.active.nodes < fine.active.nodes
    assert coarse.errors.region > fine.errors.region > 0


def test_a_plan_is_remembered_and_made_anew_where_its_file_is_damaged_or_anything_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plans: dict[str, Plan]
) -> None:
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    task, found = task_on_a_core('palpation'), plans['palpation']
    said: list[str] = []
    assert recall(task, said.append) is None
    remember(task, found)
    assert recall(task, said.append) == found
    assert len(said) == 1 and 'planned anew' in said[0]
    moved = TetMesh(task.mesh.rest * 1.000001, task.mesh.tetrahedra, task.mesh.fixed == 1)
    softer = replace(task.material, youngs_modulus=4999.0)
    budget = task.budget.model_copy(update={'error': 0.36})
    others = (
        replace(task, mesh=moved),
        replace(task, material=softer),
        replace(task, budget=budget),
        replace(task, model='corotational'),
    )
    assert [recall(other, said.append) for other in others] == [None] * 4
    (file,) = (tmp_path / 'plans').iterdir()
    whole = file.read_bytes()
    for damaged in (whole[:-5], whole.replace(b'linear', b'linaer'), b'', b'\xff' * 100):
        file.write_bytes(damaged)
        assert recall(task, said.append) is None
        assert str(file) in said[-1] and 'planned anew' in said[-1]
