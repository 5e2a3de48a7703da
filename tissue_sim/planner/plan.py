"""Planner: the simplest method that meets a scene's budget, for `trainer plan` and `method: auto`.

Errors come from trial loads on the scene's own mesh (`probe`), costs from a few frames of each
method on this machine.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from cutting_trainer.tissue_sim.elasticity.models import PLANNED_MODELS, ModelName
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, ErrorEstimate, Task
from cutting_trainer.tissue_sim.planner.frame_cost import frame_cost, with_regions
from cutting_trainer.tissue_sim.planner.mesh_errors import Probing, probe
from cutting_trainer.tissue_sim.planner.method_errors import (
    errors_at_rest,
    model_errors,
    time_error,
)
from cutting_trainer.tissue_sim.planner.rejection_reasons import (
    Rejection,
    dearer,
    inaccurate,
    ms,
    remedies,
    unfit,
)

_ALIKE = 1.3
"""Ratio of costs within the measurement noise."""
_CHEAP = 0.1
"""Share of the allowed cost below which a cheaper method has no advantage."""
_PREFERENCE: tuple[IntegratorName, ...] = ('symplectic_euler', 'rk4', 'implicit', 'euler')
"""By merit: second order without own damping, fourth order, damped, unstable without damping."""
_CHECKED = 0.4
"""Ratio of indentation depth to radius up to which predictions were checked against quadratic
elements."""
_FEWEST = 30
"""Smallest number of nodes in an active region."""
_HOPELESS = 0.25
"""Frame time above which fewer nodes are not tried [s]: the trial would take too long."""


@dataclass(frozen=True)
class Plan:
    """Result of the planner.

    Attributes:
        chosen: the simplest method that fits, or None.
        rejected: every other method with the reason.
        remedies: changes of the scene that would help, if no method fits.
        task: the task.
        tetrahedra: of the mesh.
        probing: results of the trial loads.
    """

    chosen: Candidate | None
    rejected: tuple[Rejection, ...]
    remedies: tuple[str, ...]
    task: Task = field(repr=False)
    tetrahedra: int
    probing: Probing = field(repr=False)

    @property
    def worst(self) -> Cost | None:
        """Cost after cuts have shortened the step as far as the scene allows."""
        return self.task.worst(self.chosen) if self.chosen else None

    @property
    def caution(self) -> str:
        """A sentence if the indentation is deeper than the checked range of the predictions."""
        if self.chosen is None or self.probing.strains.steepness <= _CHECKED:
            return ''
        return (
            f'the indentation is {self.probing.strains.steepness:.2f} of its radius deep, and '
            f'errors are checked up to {_CHECKED:g}: deeper, the tissue may yield by far more than '
            'predicted; '
            'a broader contact_radius or less displacement makes it shallower'
        )

    def over(self, substeps: float, tetrahedra: int) -> str:
        """Return a sentence if the cut tissue exceeds the allowed cost, else ''.

        Args:
            substeps: required by the present frame.
            tetrahedra: present number.
        """
        if self.chosen is None:
            return ''
        cost = self.chosen.cost
        share = tetrahedra / self.tetrahedra
        frame = cost.fixed + substeps * cost.each * share
        if frame <= self.task.available:
            return ''
        return (
            f'after the cut {self.chosen.name} needs {substeps:.0f} substeps and '
            f'{ms(frame)} a frame, of {ms(self.task.available)} that it may use'
        )


def plan(task: Task, say: Callable[[str], None] = lambda text: None) -> Plan:
    """Choose the simplest accurate model, and its cheapest integrator within the allowed cost.

    Args:
        task: the scene.
        say: gets what is measured next.

    Raises:
        MeshError: the mesh cannot be probed.
    """
    b = task.budget
    count = len(task.mesh.tetrahedra)
    say('errors by elements, by trial loads')
    probing = probe(task.mesh, task.material, b.contact_radius, b.displacement)
    rejected: list[Rejection] = []
    tried: list[Candidate] = []
    for model in PLANNED_MODELS:
        errors = errors_at_rest(model, probing, b)
        if errors.total <= b.error:  # deep indentation takes seconds to compute
            say(f'error of {model} by large deformation')
            errors = model_errors(model, probing, b)
        if errors.total > b.error:
            rejected.append(inaccurate(model, errors, b))
            continue
        found = sorted(_candidates(task, model, errors, probing, say), key=lambda c: c.cost.frame)
        rejected += [unfit(task, c) for c in found if not task.fits(c)]
        tried += found
        fitting = [c for c in found if task.fits(c)]
        best = _lighter(task, _preferred(task, fitting), rejected) if fitting else None
        best = best or _near_the_tool(task, found, rejected)
        if best is not None:
            rejected += [dearer(c, best) for c in fitting if c.name != best.name]
            return Plan(best, tuple(rejected), (), task, count, probing)
    said = remedies(task, probing, tried)
    return Plan(None, tuple(rejected), said, task, count, probing)


def _candidates(
    task: Task,
    model: ModelName,
    errors: ErrorEstimate,
    probing: Probing,
    say: Callable[[str], None],
) -> Iterator[Candidate]:
    for integrator in INTEGRATORS:
        if integrator == 'euler' and task.material.alpha == task.material.beta == 0.0:
            continue
        say(f'cost of {model} by {integrator}')
        cost = frame_cost(task, model, integrator)
        wrong = time_error(integrator, task.material, probing.frequency, cost.step)
        yield Candidate(model, integrator, replace(errors, time=wrong), cost)


def _preferred(task: Task, fitting: list[Candidate]) -> Candidate:
    """Return the cheapest method.

    Among equal costs, it is the one with most other advantages.
    """
    least = min(c.cost.frame for c in fitting)
    alike = [c for c in fitting if c.cost.frame <= max(_ALIKE * least, _CHEAP * task.available)]
    return min(alike, key=lambda c: _PREFERENCE.index(c.integrator))


def _lighter(task: Task, best: Candidate, rejected: list[Rejection]) -> Candidate:
    """Return the method, with an active region if that is clearly cheaper."""
    if best.cost.frame <= _CHEAP * task.available:
        return best
    (part,) = with_regions(task, best, [ActiveSettings('on')])
    if task.fits(part) and _ALIKE * part.cost.frame < best.cost.frame:
        return part
    rejected.append(dearer(part, best) if task.fits(part) else unfit(task, part))
    return best


def _near_the_tool(
    task: Task, found: list[Candidate], rejected: list[Rejection]
) -> Candidate | None:
    """Return the cheapest of the too expensive methods, with as many nodes that move on their own
    as the cost allows.
    """
    dear = [c for c in found if c.errors.total <= task.budget.error and not task.in_time(c)]
    cheapest = min(dear, key=lambda c: task.worst(c).frame, default=None)
    if cheapest is None or cheapest.cost.frame > _HOPELESS:
        return None
    share = task.available / task.worst(cheapest).frame
    nodes = [int(part * share * task.mesh.node_count) for part in (0.8, 0.5)]
    regions = [ActiveSettings('budget', n) for n in nodes if n >= _FEWEST]
    if task.worst(cheapest).substeps > task.stepping.max_substeps or not regions:
        return None
    parts = with_regions(task, cheapest, regions)
    rejected += [unfit(task, part) for part in parts if not task.fits(part)]
    return next((part for part in parts if task.fits(part)), None)
