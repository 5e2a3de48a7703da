"""What is said of a plan at its start, after cuts, and on /diagnostics."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from cutting_trainer.tissue_sim import assembly
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, ErrorEstimate
from cutting_trainer.tissue_sim.planner.monitor import PlanMonitor
from cutting_trainer.tissue_sim.planner.plan import Plan
from cutting_trainer.tissue_sim.planner.rejection_reasons import Rejection

CHOSEN = Candidate(
    'linear', 'symplectic_euler', ErrorEstimate(0.05, 0.01, 0.02), Cost(10, 1e-3, 2e-3, 1e-3)
)
PLAN = Plan(CHOSEN, (Rejection('corotated', 'is dearer'),), ('coarser mesh',), 100, 0.02)
SIMULATION: Any = SimpleNamespace(
    mesh=SimpleNamespace(topology=0, tetrahedra=range(100)),
    model=SimpleNamespace(name='corotated'),
    dynamics=SimpleNamespace(stepping=SimpleNamespace(integrator='rk4')),
)


def monitor(plan: Plan, topology: int = 0, tetrahedra: int = 100) -> PlanMonitor:
    mesh = SimpleNamespace(topology=topology, tetrahedra=range(tetrahedra))
    simulation: Any = SimpleNamespace(**vars(SIMULATION) | {'mesh': mesh})
    return PlanMonitor(plan, simulation)


def frame(substeps: int, slow_motion: float = 1.0) -> Any:
    return SimpleNamespace(substeps=substeps, slow_motion=slow_motion)


def test_the_method_is_announced_with_what_it_costs_and_the_others_with_why_not() -> None:
    rejected, chosen = monitor(PLAN).announcement()
    assert 'corotated' in rejected and 'is dearer' in rejected
    assert CHOSEN.name in chosen and '12 ms a frame of 20 ms' in chosen
    assert monitor(PLAN).warnings == []
    assert monitor(PLAN).values() == {
        'method': CHOSEN.name,
        'predicted_error': CHOSEN.errors.total,
        'predicted_frame': pytest.approx(0.012),
        'predicted_cut_frame': 0.0,
        'allowed_frame': 0.02,
    }


def test_a_plan_that_no_method_fits_names_the_one_taken_and_the_remedies() -> None:
    unmet = monitor(replace(PLAN, chosen=None, caution='it is pressed deep'))
    assert 'corotated by rk4' in unmet.unmet and 'coarser mesh' in unmet.unmet
    assert unmet.warnings == [unmet.unmet, 'it is pressed deep']
    assert len(unmet.announcement()) == 1
    assert unmet.values() == {'method': 'no method fits the budget'}
    assert unmet.follow(frame(1000)) == ''


def test_a_plan_ceases_to_hold_once_after_cuts_that_cost_more_than_a_frame_has() -> None:
    assert monitor(PLAN).follow(frame(1000)) == '', 'nothing was cut'
    cut = monitor(PLAN, topology=1, tetrahedra=200)
    assert cut.follow(frame(8)) == cut.over == ''
    said = cut.follow(frame(10))
    assert '22 ms a frame' in said and cut.over == said
    assert cut.follow(frame(10)) == '', 'it is said once'
    assert cut.over
    assert monitor(PLAN, 1, 100).follow(frame(10, slow_motion=0.5)), 'twice the substeps are needed'


def test_a_plan_of_an_earlier_start_is_taken_and_a_new_one_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known: list[Plan | None] = [None]
    kept: list[Plan] = []
    monkeypatch.setattr(assembly, 'recall', lambda *_: known[0])
    monkeypatch.setattr(assembly, 'remember', lambda _, found: kept.append(found))
    done: list[str] = []
    monkeypatch.setattr(assembly, 'plan', lambda *_: done.append('measure') or PLAN)
    monkeypatch.setattr(assembly, 'warm_up', lambda: done.append('load'))
    task: Any = None
    assert assembly.make_plan(task) is PLAN and kept == [PLAN]
    assert done == ['load', 'measure'], 'what is loaded meanwhile would count as cost'
    known[0] = replace(PLAN, available=0.01)
    assert assembly.make_plan(task) is known[0] and kept == [PLAN]


@pytest.mark.parametrize(
    ('late', 'goes_on', 'anew'), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_plan_whose_methods_take_too_long_is_made_anew_but_by_a_session_that_goes_on(
    monkeypatch: pytest.MonkeyPatch, late: bool, goes_on: bool, anew: bool
) -> None:
    known, kept = replace(PLAN, chosen=None, late=late), []
    monkeypatch.setattr(assembly, 'recall', lambda *_: known)
    monkeypatch.setattr(assembly, 'remember', lambda _, found: kept.append(found))
    monkeypatch.setattr(assembly, 'plan', lambda *_: PLAN)
    monkeypatch.setattr(assembly, 'warm_up', lambda: None)
    task: Any = None
    assert assembly.make_plan(task, goes_on=goes_on) is (PLAN if anew else known)
    assert kept == [PLAN] * anew
