"""Reasons for which the planner rejects methods, and remedies where none fits."""

import math
from typing import NamedTuple

from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.planner.budget import Budget
from cutting_trainer.tissue_sim.planner.candidate import Candidate, ErrorEstimate, Task
from cutting_trainer.tissue_sim.planner.mesh_errors import Probing
from cutting_trainer.tissue_sim.planner.method_errors import model_errors


class Rejection(NamedTuple):
    """A rejected method.

    Attributes:
        method: a model, or a candidate's name.
        why: reason, as a phrase.
        fails: whether it fails the budget; else it is only more expensive.
    """

    method: str
    why: str
    fails: bool = True

    def __str__(self) -> str:
        return f'{self.method}: {self.why}'


def by_cause(errors: ErrorEstimate) -> str:
    """Return the errors of all causes as a phrase."""
    return ', '.join(f'{percent(value)} {cause}' for cause, value in errors.causes.items())


def inaccurate(model: ModelName, errors: ErrorEstimate, budget: Budget) -> Rejection:
    """Return the rejection of a model that is inaccurate with any integrator."""
    causes = {
        f'at the {budget.rotation:g} degrees that this scene allows': errors.rotation,
        f'at the {1e3 * budget.displacement:g} mm that this scene allows': errors.strain,
        'by elements of this size': errors.elements,
        'by the footprint of the tool': errors.contact,
    }
    said = [
        f'{percent(value)} {cause}' if math.isfinite(value) else f'gives way {cause}'
        for cause, value in causes.items()
        if value > 0.0  # it has this cause, and it was computed
    ]
    return Rejection(model, f'{", ".join(said)}; {percent(budget.error)} is allowed')


def unfit(task: Task, candidate: Candidate) -> Rejection:
    """Return the rejection of a method by its cost, or by the error of its step or region."""
    cost, errors = task.worst(candidate), candidate.errors
    after = ' when cuts have shortened the step' if cost != candidate.cost else ''
    if errors.total > task.budget.error:
        by_step = f'{percent(errors.time)} of it by steps of {ms(cost.step)}'
        by_region = (
            f', {percent(errors.region)} by far nodes that move together' if errors.region else ''
        )
        return Rejection(
            candidate.name,
            f'{percent(errors.total)}, {by_step}{by_region}; {ms(cost.frame)} a frame',
        )
    if candidate.cutting > max(task.available, cost.frame):
        return Rejection(
            candidate.name,
            f'{ms(candidate.cutting)} a frame while a blade is drawn, of {ms(task.available)}',
        )
    if cost.frame > task.available:
        return Rejection(
            candidate.name,
            f'{cost.substeps} substeps of {ms(cost.step)} cost {ms(cost.frame)} of '
            f'{ms(task.available)}{after}',
        )
    return Rejection(
        candidate.name,
        f'{cost.substeps} substeps{after}, above max_substeps, {task.stepping.max_substeps}',
    )


def dearer(candidate: Candidate, best: Candidate) -> Rejection:
    """Return the rejection of a method that meets the budget but is not clearly cheaper."""
    other = best.name.removeprefix(f'{best.model} by ')
    why = f'{ms(candidate.cost.frame)} a frame, where {other} takes {ms(best.cost.frame)}'
    if candidate.cost.frame < best.cost.frame:
        why += ': no clear gain, and less merit'
    return Rejection(candidate.name, why, fails=False)


def remedies(task: Task, probing: Probing, tried: list[Candidate]) -> tuple[str, ...]:
    """Return changes of the scene that would help, the smallest of each kind first.

    Args:
        task: the scene.
        probing: results of the trial loads.
        tried: methods with an accurate model.
    """
    return tuple(_for_accuracy(task.budget, probing) + _for_speed(task, tried))


def _for_accuracy(b: Budget, probing: Probing) -> list[str]:
    found = {model: model_errors(model, probing, b) for model in MODELS}
    best = min(found, key=lambda model: found[model].total)
    errors = found[best]
    if errors.total <= b.error:
        return []
    said = []
    if errors.total <= 1:
        said.append(f'allow an error of {percent(math.ceil(100 * errors.total) / 100)}: {best}')
    if errors.elements > 0.8 * b.error:
        # Errors of displacement fall with the square of the size of the elements.
        finer = math.sqrt(errors.elements / (0.5 * b.error))
        said.append(f'a mesh with edges {finer:.1f} times shorter: {best}')
    left = b.error - errors.elements - errors.contact
    if errors.strain > left > 0 and math.isfinite(errors.strain):
        less = 1e3 * b.displacement * left / errors.strain
        said.append(f'at most {less:.2g} mm of displacement: {best}')
    if errors.rotation > left > 0:
        angle = math.degrees(math.acos(1 - left))
        said.append(f'at most {math.floor(angle)} degrees of rotation: {best}')
    return said


def _for_speed(task: Task, tried: list[Candidate]) -> list[str]:
    cheap = min(tried, key=task.dearest, default=None)
    if cheap is None:
        return []
    said = []
    need = task.dearest(cheap)
    cores = need * task.stepping.rate
    if task.budget.cores < cores <= 1:
        said.append(f'give the simulation {math.ceil(100 * cores) / 100:g} cores: {cheap.name}')
    coarser = (need / task.available) ** 0.25
    if coarser > 1:
        said.append(f'a mesh with edges {coarser:.2f} times longer: {cheap.name}')
    dear = task.worst(cheap).frame > task.available >= max(cheap.cost.frame, cheap.cutting)
    if task.worst(cheap) != cheap.cost and dear:
        fits = task.available / max(cheap.cost.frame, 1e-12)
        said.append(f'a frequency_growth of {math.floor(10 * fits) / 10:.1f}: {cheap.name}')
    if task.worst(cheap).substeps > task.stepping.max_substeps:
        said.append(f'max_substeps of {task.worst(cheap).substeps}: {cheap.name}')
    return said


def ms(seconds: float) -> str:
    """Return a time as text in milliseconds."""
    return f'{1e3 * seconds:.2g} ms' if seconds < 0.01 else f'{1e3 * seconds:.0f} ms'


def percent(share: float) -> str:
    """Return a share as text in per cent."""
    return f'{100 * share:.2g} %' if share < 0.1 else f'{100 * share:.0f} %'
