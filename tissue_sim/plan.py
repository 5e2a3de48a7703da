"""The least method that does what a scene asks: `trainer plan`, and `method: auto` at start.

Errors come from probing the scene's own mesh (`probe`), costs from a few frames of each method on
it, on the machine that asks.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from tissue_sim.active_region import ActiveSettings
from tissue_sim.candidate import Candidate, Cost, Errors, Task
from tissue_sim.elasticity import MODELS, ModelName
from tissue_sim.frame_cost import frame_cost, with_regions
from tissue_sim.integrators import INTEGRATORS, IntegratorName
from tissue_sim.method_errors import errors_at_rest, model_errors, time_error
from tissue_sim.plan_reasons import Rejection, dearer, inaccurate, ms, remedies, unfit
from tissue_sim.probe import Probing, probe

_ALIKE = 1.3
"""Ratio of costs that is within the noise of measuring them."""
_CHEAP = 0.1
"""Share of what a frame may cost below which there is nothing to gain."""
_PREFERENCE: tuple[IntegratorName, ...] = ('symplectic_euler', 'rk4', 'implicit', 'euler')
"""Second order and no damping of its own, fourth order, damping, no stability without damping."""
_CHECKED = 0.4
"""Depth of a dent over its radius up to which predictions hold against quadratic elements."""
_FEWEST = 30
"""Nodes that an active region has at least."""
_HOPELESS = 0.25
"""Frame that is not tried with fewer nodes [s]: the trial would take too long."""


@dataclass(frozen=True)
class Plan:
    """The answer.

    Attributes:
        chosen: the least method that fits, or None.
        rejected: each other method that was looked at, and why not that.
        remedies: what would have to give, where nothing fits.
        task: what was asked.
        tetrahedra: that there were.
        probing: what pressing the tissue came to.
    """

    chosen: Candidate | None
    rejected: tuple[Rejection, ...]
    remedies: tuple[str, ...]
    task: Task = field(repr=False)
    tetrahedra: int
    probing: Probing = field(repr=False)

    @property
    def worst(self) -> Cost | None:
        """Cost when cuts have shortened the step as far as the scene lets them."""
        return self.task.worst(self.chosen) if self.chosen else None

    @property
    def caution(self) -> str:
        """A sentence where the dent is deeper than any that predictions were checked in."""
        if self.chosen is None or self.probing.strains.steepness <= _CHECKED:
            return ''
        return (
            f'the dent is {self.probing.strains.steepness:.2f} of its radius deep, and errors are '
            f'checked up to {_CHECKED:g}: deeper, the tissue may yield by far more than predicted; '
            'a broader contact_radius or less displacement makes it shallower'
        )

    def over(self, substeps: float, tetrahedra: int) -> str:
        """A sentence if the tissue as it has been cut costs more than it may, else nothing.

        Args:
            substeps: that a frame asks for now.
            tetrahedra: that there are now.
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


def plan(task: Task) -> Plan:
    """Chooses the least model that is accurate enough, and its cheapest integrator that is in time.

    Args:
        task: the scene.

    Raises:
        MeshError: the mesh cannot be probed.
    """
    b = task.budget
    count = len(task.mesh.tetrahedra)
    probing = probe(task.mesh, task.material, b.contact_radius, b.displacement)
    rejected: list[Rejection] = []
    tried: list[Candidate] = []
    for model in MODELS:
        errors = errors_at_rest(model, probing, b)
        if errors.total <= b.error:  # what is deep takes seconds to compute
            errors = model_errors(model, probing, b)
        if errors.total > b.error:
            rejected.append(inaccurate(model, errors, b))
            continue
        found = sorted(_candidates(task, model, errors, probing), key=lambda c: c.cost.frame)
        rejected += [unfit(task, c) for c in found if not task.fits(c)]
        tried += found
        fitting = [c for c in found if task.fits(c)]
        best = _lighter(task, _preferred(task, fitting), rejected) if fitting else None
        best = best or _held(task, found, rejected)
        if best is not None:
            rejected += [dearer(c, best) for c in fitting if c.name != best.name]
            return Plan(best, tuple(rejected), (), task, count, probing)
    said = remedies(task, probing, tried)
    return Plan(None, tuple(rejected), said, task, count, probing)


def _candidates(
    task: Task, model: ModelName, errors: Errors, probing: Probing
) -> Iterator[Candidate]:
    for integrator in INTEGRATORS:
        if integrator == 'euler' and task.material.alpha == task.material.beta == 0.0:
            continue
        cost = frame_cost(task, model, integrator)
        wrong = time_error(integrator, task.material, probing.frequency, cost.step)
        yield Candidate(model, integrator, replace(errors, time=wrong), cost)


def _preferred(task: Task, fitting: list[Candidate]) -> Candidate:
    """The cheapest; among those that cost as much, the one that is right in most other ways."""
    least = min(c.cost.frame for c in fitting)
    alike = [c for c in fitting if c.cost.frame <= max(_ALIKE * least, _CHEAP * task.available)]
    return min(alike, key=lambda c: _PREFERENCE.index(c.integrator))


def _lighter(task: Task, best: Candidate, rejected: list[Rejection]) -> Candidate:
    """The same, or only the nodes moving that something moves, where that is clearly cheaper."""
    if best.cost.frame <= _CHEAP * task.available:
        return best
    (part,) = with_regions(task, best, [ActiveSettings('on')])
    if task.fits(part) and _ALIKE * part.cost.frame < best.cost.frame:
        return part
    rejected.append(dearer(part, best) if task.fits(part) else unfit(task, part))
    return best


def _held(task: Task, found: list[Candidate], rejected: list[Rejection]) -> Candidate | None:
    """Of methods that are too dear the cheapest, with as many nodes moving as are in time."""
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
