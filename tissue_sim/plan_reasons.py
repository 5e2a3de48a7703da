"""Why the planner refuses a method, and what would have to give where none fits."""

import math
from typing import NamedTuple

from tissue_sim.budget import Budget
from tissue_sim.candidate import Candidate, Errors, Task
from tissue_sim.elasticity import MODELS, ModelName
from tissue_sim.method_errors import model_errors
from tissue_sim.probe import Probing


class Rejection(NamedTuple):
    """A method that was not taken.

    Attributes:
        method: a model, or a candidate's name.
        why: a phrase.
        fails: whether it does not meet the budget; else it is only dearer.
    """

    method: str
    why: str
    fails: bool = True

    def __str__(self) -> str:
        return f'{self.method}: {self.why}'


def inaccurate(model: ModelName, errors: Errors, budget: Budget) -> Rejection:
    """A model that no integrator makes accurate enough."""
    causes = {
        f'at the {budget.rotation:g} degrees that this scene allows': errors.rotation,
        f'at the {1e3 * budget.displacement:g} mm that this scene allows': errors.strain,
        'by elements of this size': errors.elements,
    }
    largest = max(causes.values())
    said = [
        f'{percent(value)} {cause}' if math.isfinite(value) else f'gives way {cause}'
        for cause, value in causes.items()
        if value > 0.01 and (value == largest or value > budget.error / 3)
    ]
    return Rejection(model, f'{", ".join(said)}; {percent(budget.error)} is allowed')


def unfit(task: Task, candidate: Candidate) -> Rejection:
    """A method that is too dear, or too wrong by its step or region."""
    cost, errors = task.worst(candidate), candidate.errors
    after = ' when cuts have shortened the step' if cost != candidate.cost else ''
    if errors.total > task.budget.error:
        by_step = f'{percent(errors.time)} of it by steps of {ms(cost.step)}'
        by_region = f', {percent(errors.region)} by nodes that are held' if errors.region else ''
        return Rejection(candidate.name, f'{percent(errors.total)}, {by_step}{by_region}')
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
    """A method that would do, but costs more, or no less that is worth it."""
    other = best.name.removeprefix(f'{best.model} by ')
    why = f'{ms(candidate.cost.frame)} a frame, where {other} takes {ms(best.cost.frame)}'
    return Rejection(candidate.name, why, fails=False)


def remedies(task: Task, probing: Probing, tried: list[Candidate]) -> tuple[str, ...]:
    """What would have to give, the smallest step first of each kind.

    Args:
        task: the scene.
        probing: what its mesh came to.
        tried: methods whose model is accurate enough.
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
    left = b.error - errors.elements
    if errors.strain > left > 0 and math.isfinite(errors.strain):
        less = 1e3 * b.displacement * left / errors.strain
        said.append(f'at most {less:.2g} mm of displacement: {best}')
    if errors.rotation > left > 0:
        angle = math.degrees(math.acos(1 - left))
        said.append(f'at most {math.floor(angle)} degrees of rotation: {best}')
    return said


def _for_speed(task: Task, tried: list[Candidate]) -> list[str]:
    cheap = min(tried, key=lambda c: task.worst(c).frame, default=None)
    if cheap is None:
        return []
    said = []
    need = task.worst(cheap).frame
    cores = need * task.stepping.rate
    if task.budget.cores < cores <= 1:
        said.append(f'give the simulation {math.ceil(100 * cores) / 100:g} cores: {cheap.name}')
    coarser = (need / task.available) ** 0.25
    if coarser > 1:
        said.append(f'a mesh with edges {coarser:.2f} times longer: {cheap.name}')
    if task.worst(cheap) != cheap.cost and need > task.available >= cheap.cost.frame:
        fits = task.available / max(cheap.cost.frame, 1e-12)
        said.append(f'a frequency_growth of {math.floor(10 * fits) / 10:.1f}: {cheap.name}')
    if task.worst(cheap).substeps > task.stepping.max_substeps:
        said.append(f'max_substeps of {task.worst(cheap).substeps}: {cheap.name}')
    return said


def ms(seconds: float) -> str:
    """Milliseconds, for people."""
    return f'{1e3 * seconds:.2g} ms' if seconds < 0.01 else f'{1e3 * seconds:.0f} ms'


def percent(share: float) -> str:
    """Per cent, for people."""
    return f'{100 * share:.2g} %' if share < 0.1 else f'{100 * share:.0f} %'
