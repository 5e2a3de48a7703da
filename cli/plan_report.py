"""The command `trainer plan`: the cheapest method that meets a scene's budget."""

import json
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.markup import escape

from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_plan, make_task
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost
from cutting_trainer.tissue_sim.planner.plan import Plan
from cutting_trainer.tissue_sim.planner.rejection_reasons import by_cause, ms, percent
from cutting_trainer.tissue_sim.scene_schema import TissueSettings


def run_plan(scene: str, *, as_json: bool = False) -> Status:
    """Plan a scene and print the answer.

    Args:
        scene: name or path.
        as_json: for machines, see `as_data`.

    Returns:
        OK if a method meets the budget, else FAILED.

    Raises:
        SessionError, SceneError, MeshError: the scene cannot be used.
    """
    settings = load_scene(scene).tissue
    beside = Console(stderr=True, soft_wrap=True, highlight=False)
    with beside.status('loading kernels', refresh_per_second=1) as shown:
        found = make_plan(make_task(settings), beside.print, shown.update)
    console = Console(soft_wrap=True, highlight=False)
    if as_json:
        console.out(json.dumps(as_data(scene, settings, found), indent=2), highlight=False)
    else:
        for line in report(scene, settings, found):
            console.print(escape(line))
    return Status.OK if found.chosen else Status.FAILED


def report(scene: str, settings: TissueSettings, found: Plan) -> list[str]:
    """Return the lines that are printed."""
    b = settings.budget
    lines = [
        f'{scene}: {found.tetrahedra} tetrahedra, {"cut" if b.cuts else "not cut"}',
        f'  asked: up to {1e3 * b.displacement:g} mm and {b.rotation:g} degrees, error at most '
        f'{100 * b.error:g} %, {ms(found.available)} a frame at {settings.integration.rate:g} Hz '
        f'(cores: {b.cores:g})',
    ]
    if found.chosen is not None:
        lines += _chosen(found.chosen, found)
    else:
        lines.append('no method meets this budget')
    if found.caution:
        lines.append(f'caution: {found.caution}')
    lines += ['not taken:', *(f'  {rejection}' for rejection in found.rejected)]
    if found.remedies:
        lines.append('what would have to give, one of:')
        lines += [f'  {sentence}' for sentence in found.remedies]
    return lines + _given(settings, found)


def _chosen(chosen: Candidate, found: Plan) -> list[str]:
    cost, worst, errors = chosen.cost, found.worst, chosen.errors
    lines = [
        f'taken: {chosen.name}',
        f'  error {percent(errors.total)}: {by_cause(errors)}',
        f'  {ms(cost.frame)} a frame: {_steps(cost)}',
    ]
    if worst is not None and worst != cost:
        lines.append(
            f'  at most {ms(worst.frame)} when cuts have shortened the step: {_steps(worst)}'
        )
    if chosen.cutting:
        lines.append(f'  {ms(chosen.cutting)} while a blade is drawn through the tissue')
    return lines


def _steps(cost: Cost) -> str:
    return f'{cost.substeps} substep{"s" if cost.substeps > 1 else ""} of {ms(cost.step)}'


def _given(settings: TissueSettings, found: Plan) -> list[str]:
    """Return a sentence about the scene's own choice, where that is another."""
    if settings.method == 'auto':
        if found.chosen is not None:
            return []
        return [f'the scene has method: auto, and runs {_name(settings)} while nothing fits']
    if found.chosen is None or _name(settings) == found.chosen.name:
        return []
    why = _why_not(settings, found)
    fails = f', which does not meet its budget: {why}' if why else ', which does more than that'
    return [
        f'the scene takes {_name(settings)}{fails}',
        'tissue.method: auto would follow the plan',
    ]


def _why_not(settings: TissueSettings, found: Plan) -> str:
    """Return why the scene's own method does not meet its budget, if so."""
    for rejection in found.rejected:
        if rejection.method in (settings.model, _name(settings)):
            return rejection.why if rejection.fails else ''
    return found.own


def _name(settings: TissueSettings) -> str:
    return f'{settings.model} by {settings.integrator}'


def as_data(scene: str, settings: TissueSettings, found: Plan) -> dict[str, Any]:
    """Return the plan for machines: SI units, relative errors; null where there is nothing.

    Returns:
        scene, tetrahedra, budget and available [s] that were asked; chosen with errors by cause
        and cost, also when cuts have shortened the step, and in a cut (0: none); rejected;
        remedies; a caution, empty where there is none; what the scene takes.
    """
    chosen = None
    if found.chosen is not None and found.worst is not None:
        c = found.chosen
        chosen = {
            'model': c.model,
            'integrator': c.integrator,
            'active_region': asdict(c.active),
            'errors': {**asdict(c.errors), 'total': c.errors.total},
            'cost': {**asdict(c.cost), 'frame': c.cost.frame},
            'cost_after_cuts': {**asdict(found.worst), 'frame': found.worst.frame},
            'frame_in_a_cut': c.cutting,
        }
    return {
        'scene': scene,
        'tetrahedra': found.tetrahedra,
        'budget': settings.budget.model_dump(),
        'available': found.available,
        'chosen': chosen,
        'rejected': [r._asdict() for r in found.rejected],
        'remedies': list(found.remedies),
        'caution': found.caution,
        'scene_takes': {'model': settings.model, 'integrator': settings.integrator},
    }
