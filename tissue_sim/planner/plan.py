"""Planner: the simplest method that meets a scene's budget, for `trainer plan` and `method: auto`.

Errors come from trial loads on the scene's own mesh (`probe`), costs from a few frames of each
method on this machine.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, ErrorEstimate, Task
from cutting_trainer.tissue_sim.planner.far_field_choice import far_field
from cutting_trainer.tissue_sim.planner.frame_cost import (
    frame_cost,
    tool_depth,
    with_blade,
    with_sleepers,
)
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


@dataclass(frozen=True)
class Plan:
    """Result of the planner.

    Attributes:
        chosen: the simplest that fits, or None.
        rejected: every other method with the reason.
        remedies: changes of the scene that would help, if no method fits.
        tetrahedra: of the mesh.
        available: CPU time allowed for a frame [s].
        worst: cost after cuts have shortened the step as far as the scene allows.
        caution: a sentence if the indentation is deeper than the checked range of the predictions.
        own: why the scene's own model fails the budget, if it does and is not among the rejected.
        late: whether no method fits only because those that are accurate take too long.
    """

    chosen: Candidate | None
    rejected: tuple[Rejection, ...]
    remedies: tuple[str, ...]
    tetrahedra: int
    available: float
    worst: Cost | None = None
    caution: str = ''
    own: str = ''
    late: bool = False

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
        if frame <= self.available:
            return ''
        return (
            f'after the cut {self.chosen.name} needs {substeps:.0f} substeps and '
            f'{ms(frame)} a frame, of {ms(self.available)} that it may use'
        )


def plan(task: Task, say: Callable[[str], None] = lambda text: None) -> Plan:
    """Choose the simplest accurate model, and its cheapest integrator within the allowed cost.

    Args:
        task: the scene.
        say: gets the name of the next measurement.

    Raises:
        MeshError: the mesh cannot be probed.
    """
    b, count = task.budget, len(task.mesh.tetrahedra)
    say('errors by elements and footprint, by trial loads')
    probing = probe(task.mesh, task.material, b.contact_radius, b.displacement)
    depth = tool_depth(task, probing.settled)
    rejected: list[Rejection] = []
    tried: list[Candidate] = []
    for model in MODELS:
        errors = errors_at_rest(model, probing, b)
        if errors.total <= b.error:  # deep indentation takes seconds to compute
            say(f'error of {model} by large deformation')
            errors = model_errors(model, probing, b)
        if errors.total > b.error:
            rejected.append(inaccurate(model, errors, b))
            continue
        candidates = _candidates(task, model, errors, probing, depth, say)
        found = sorted(candidates, key=lambda c: c.cost.frame)
        rejected += [unfit(task, c) for c in found if not task.fits(c)]
        fitting = [c for c in found if task.fits(c)]
        best = None
        while fitting:
            light = _lighter(task, _preferred(task, fitting), depth, rejected)
            cut = _with_cut(task, light, rejected, say)
            if task.fits(cut):
                best = cut
                break
            late = [c for c in found if c.integrator == cut.integrator]
            found = [replace(c, cutting=cut.cutting) if c in late else c for c in found]
            fitting = [c for c in fitting if c not in late]
        tried += found
        best = best or _near_the_tool(task, found, probing, depth, rejected, say)
        if best is not None:
            rejected += [dearer(c, best) for c in fitting if c.name != best.name]
            own = _own(task, best, probing, rejected, say)
            caution, worst = _caution(probing), task.worst(best)
            return Plan(best, tuple(rejected), (), count, task.available, worst, caution, own)
    said = remedies(task, probing, tried)
    return Plan(None, tuple(rejected), said, count, task.available, late=bool(tried))


def _own(
    task: Task,
    best: Candidate,
    probing: Probing,
    rejected: list[Rejection],
    say: Callable[[str], None],
) -> str:
    """Return why the scene's own model, not tried, fails the budget; else an empty string."""
    if task.model == best.model or any(r.method == task.model for r in rejected):
        return ''
    say(f'error of {task.model}, which the scene has')
    errors = model_errors(task.model, probing, task.budget)
    fails = errors.total > task.budget.error
    return inaccurate(task.model, errors, task.budget).why if fails else ''


def _caution(probing: Probing) -> str:
    steepness = probing.strains.steepness
    if steepness <= _CHECKED:
        return ''
    return (
        f'the indentation is {steepness:.2f} of its radius deep, and errors are checked up to '
        f'{_CHECKED:g}: deeper, the tissue may yield by far more than predicted; '
        'a broader contact_radius or less displacement makes it shallower'
    )


def _candidates(
    task: Task,
    model: ModelName,
    errors: ErrorEstimate,
    probing: Probing,
    depth: float,
    say: Callable[[str], None],
) -> Iterator[Candidate]:
    for integrator in INTEGRATORS:
        if integrator == 'euler' and task.material.alpha == task.material.beta == 0.0:
            continue
        say(f'cost of {model} by {integrator}')
        cost = frame_cost(task, model, integrator, depth)
        wrong = time_error(integrator, task.material, probing.frequency, cost.step)
        yield Candidate(model, integrator, replace(errors, time=wrong), cost)


def _with_cut(
    task: Task, candidate: Candidate, rejected: list[Rejection], say: Callable[[str], None]
) -> Candidate:
    """Return the method with its cost in a cut; one that does not fit is rejected."""
    say(f'cost of a cut with {candidate.name}')
    cut = with_blade(task, candidate)
    if not task.fits(cut):
        rejected.append(unfit(task, cut))
    return cut


def _preferred(task: Task, fitting: list[Candidate]) -> Candidate:
    """Return the cheapest method.

    Among equal costs, it is the one with most other advantages.
    """
    least = min(c.cost.frame for c in fitting)
    alike = [c for c in fitting if c.cost.frame <= max(_ALIKE * least, _CHEAP * task.available)]
    return min(alike, key=lambda c: _PREFERENCE.index(c.integrator))


def _lighter(task: Task, best: Candidate, depth: float, rejected: list[Rejection]) -> Candidate:
    """Return the method, with sleeping nodes if that is clearly cheaper."""
    if best.cost.frame <= _CHEAP * task.available:
        return best
    part = with_sleepers(task, best, depth)
    if task.fits(part) and _ALIKE * part.cost.frame < best.cost.frame:
        return part
    rejected.append(dearer(part, best) if task.fits(part) else unfit(task, part))
    return best


def _near_the_tool(
    task: Task,
    found: list[Candidate],
    probing: Probing,
    depth: float,
    rejected: list[Rejection],
    say: Callable[[str], None],
) -> Candidate | None:
    """Return the cheapest of the too expensive methods with a far field, if that is in time."""
    dear = [c for c in found if c.errors.total <= task.budget.error and not task.in_time(c)]
    cheapest = min(dear, key=task.dearest, default=None)
    if cheapest is None or task.worst(cheapest).substeps > task.stepping.max_substeps:
        return None
    whole = replace(cheapest, cutting=0.0)
    part, others = far_field(task, whole, probing.strains.indenter, depth, say)
    rejected += others
    if part is None:
        return None
    part = _with_cut(task, part, rejected, say)
    return part if task.fits(part) else None
