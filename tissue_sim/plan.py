"""The least method that does what a scene asks: `trainer plan`, and `method: auto` at start.

Errors come from probing the scene's own mesh (`probe`), costs from a few frames of each method on
it, on the machine that asks.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from tissue_sim.blade import Resistance
from tissue_sim.budget import Budget
from tissue_sim.contact import ToolContact, press_triangle
from tissue_sim.dynamics import TimeStepping
from tissue_sim.elasticity import MODELS, ModelName
from tissue_sim.integrators import INTEGRATORS, IntegratorName
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.probe import Press, Probing, places, probe
from tissue_sim.simulation import TissueSimulation

MARGIN = 1.25
"""What the error by the size of the elements is multiplied by: other places may be worse."""
_HAND = 2 * math.pi
"""Frequency of a hand that palpates [rad/s]."""
_SHORT, _LONG = 4, 16
_FRAMES = 16
_ALIKE = 1.3
"""Ratio of costs that is within the noise of measuring them."""
_PREFERENCE: tuple[IntegratorName, ...] = ('symplectic_euler', 'rk4', 'implicit', 'euler')
"""Second order and no damping of its own, fourth order, damping, no stability without damping."""
_COUPLING = 200.0
"""Stiffness of the spring that costs are measured with [N/m]."""


@dataclass(frozen=True)
class Errors:
    """Relative errors of displacement under a load, by cause.

    Attributes:
        elements: size of the elements.
        rotation: largest rotation, for a linear model.
        depth: largest displacement, for a linear model.
        time: size of the step, at the pace of a palpating hand.
    """

    elements: float
    rotation: float
    depth: float
    time: float = 0.0

    @property
    def total(self) -> float:
        """Rotation and depth are one cause seen twice: the larger counts."""
        return self.elements + max(self.rotation, self.depth) + self.time


@dataclass(frozen=True)
class Cost:
    """What a frame costs.

    Attributes:
        substeps: that stability asks for.
        step: each [s].
        fixed: CPU time of a frame whatever the substeps [s].
        each: CPU time of a substep [s].
    """

    substeps: int
    step: float
    fixed: float
    each: float

    @property
    def frame(self) -> float:
        """CPU time of a frame [s]."""
        return self.fixed + self.substeps * self.each

    def grown(self, factor: float) -> 'Cost':
        """With so many times the substeps."""
        return Cost(math.ceil(self.substeps * factor), self.step / factor, self.fixed, self.each)


@dataclass(frozen=True)
class Candidate:
    """A method, with what it does to the scene."""

    model: ModelName
    integrator: IntegratorName
    errors: Errors
    cost: Cost

    @property
    def name(self) -> str:
        """Model and integrator."""
        return f'{self.model} by {self.integrator}'


@dataclass(frozen=True)
class Task:
    """A scene as the planner sees it.

    Attributes:
        mesh, material, resistance: the tissue.
        budget: what is asked.
        stepping: of the scene; its integrator does not count.
    """

    mesh: TetMesh
    material: Material
    resistance: Resistance
    budget: Budget
    stepping: TimeStepping

    @property
    def available(self) -> float:
        """CPU time that a frame may cost [s]."""
        return self.budget.cores / self.stepping.rate

    def worst(self, candidate: 'Candidate') -> Cost:
        """What a method costs when cuts have shortened the step as far as they may."""
        explicit = candidate.integrator != 'implicit'
        growth = self.stepping.frequency_growth if self.budget.cuts and explicit else 1.0
        return candidate.cost.grown(growth)


@dataclass(frozen=True)
class Plan:
    """The answer.

    Attributes:
        chosen: the least method that fits, or None.
        rejected: a sentence for each lesser method, and why not.
        remedies: what would have to give, where nothing fits.
        task: what was asked.
        tetrahedra: that there were.
    """

    chosen: Candidate | None
    rejected: tuple[str, ...]
    remedies: tuple[str, ...]
    task: Task = field(repr=False)
    tetrahedra: int

    @property
    def worst(self) -> Cost | None:
        """Cost when cuts have shortened the step as far as the scene lets them."""
        return self.task.worst(self.chosen) if self.chosen else None

    @property
    def stepping(self) -> TimeStepping:
        """How frames are stepped through by what was chosen."""
        stepping = self.task.stepping
        return replace(stepping, integrator=self.chosen.integrator) if self.chosen else stepping

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
            f'{_ms(frame)} a frame, of {_ms(self.task.available)} that it may use'
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
    rejected: list[str] = []
    tried: list[Candidate] = []
    for model in MODELS:
        errors = model_errors(model, probing, b)
        if errors.total > b.error:
            rejected.append(_inaccurate(model, errors, b))
            continue
        found = sorted(_candidates(task, model, errors, probing), key=lambda c: c.cost.frame)
        fitting = [c for c in found if _fits(task, c)]
        rejected += [_unfit(task, c) for c in found if c not in fitting]
        tried += found
        if fitting:
            best = _preferred(fitting)
            rejected += [
                f'{c.name}: {_ms(c.cost.frame)} a frame, where {best.integrator} takes '
                f'{_ms(best.cost.frame)}'
                for c in fitting
                if c is not best
            ]
            return Plan(best, tuple(rejected), (), task, count)
    return Plan(None, tuple(rejected), _remedies(task, probing, tried), task, count)


def _preferred(fitting: list[Candidate]) -> Candidate:
    """The cheapest; among those that cost as much, the one that is right in most other ways."""
    least = min(c.cost.frame for c in fitting)
    alike = [c for c in fitting if c.cost.frame <= _ALIKE * least]
    return min(alike, key=lambda c: _PREFERENCE.index(c.integrator))


def model_errors(model: ModelName, probing: Probing, budget: Budget) -> Errors:
    """What a model gets wrong whatever the integrator.

    An element that turns by theta without deformation feels a strain of cos(theta) - 1 in a linear
    model.
    """
    elements = MARGIN * probing.elements[model.endswith('_smoothed')]
    if model.startswith('corotational'):
        return Errors(elements, 0.0, 0.0)
    return Errors(elements, 1 - math.cos(math.radians(budget.rotation)), probing.depth)


def _candidates(
    task: Task, model: ModelName, errors: Errors, probing: Probing
) -> Iterator[Candidate]:
    for integrator in INTEGRATORS:
        if integrator == 'euler' and task.material.alpha == task.material.beta == 0.0:
            continue
        cost = frame_cost(task, model, integrator)
        wrong = time_error(integrator, task.material, probing.frequency, cost.step)
        yield Candidate(
            model,
            integrator,
            Errors(errors.elements, errors.rotation, errors.depth, wrong),
            cost,
        )


def time_error(
    integrator: IntegratorName, material: Material, frequency: float, step: float
) -> float:
    """Relative error of the answer of the slowest motion to a hand that moves at 1 Hz.

    That of the discrete transfer function of u'' + c u' + omega^2 u = omega^2 f.

    Args:
        integrator: which one.
        material: its damping counts.
        frequency: of the slowest motion [rad/s].
        step: [s].
    """
    c = material.alpha + material.beta * frequency**2
    z = np.exp(1j * _HAND * step)
    ahead, behind = (z - 1) / step, (1 - 1 / z) / step
    rate, acceleration = {
        'euler': (ahead, ahead * ahead),
        'symplectic_euler': (behind, ahead * behind),
        'rk4': (1j * _HAND, -(_HAND**2)),
        'implicit': (behind, behind * behind),
    }[integrator]
    exact = frequency**2 - _HAND**2 + 1j * c * _HAND
    return float(abs(exact / (acceleration + c * rate + frequency**2) - 1))


def frame_cost(task: Task, model: ModelName, integrator: IntegratorName) -> Cost:
    """CPU time of frames in which a tool goes in and out, measured here and now.

    Frames are cut short, and what is left of their substeps is counted: a method that is far too
    slow for the scene is not waited for.
    """
    presses = places(task.mesh, task.budget.contact_radius)
    if integrator == 'implicit':  # how many iterations it takes depends on where and how
        found = [_frame_times(task, model, integrator, press, _LONG) for press in presses]
        long, substeps, step = max(found)
        return Cost(substeps, step, long, 0.0)
    press = presses[0]
    long, substeps, step = _frame_times(task, model, integrator, press, _LONG)
    if substeps <= _LONG:
        return (
            Cost(substeps, step, long, 0.0)
            if substeps == 1
            else Cost(substeps, step, 0.0, long / substeps)
        )
    short, _, _ = _frame_times(task, model, integrator, press, _SHORT)
    each = max((long - short) / (_LONG - _SHORT), long / _LONG / 4)
    return Cost(substeps, step, max(long - _LONG * each, 0.0), each)


def frame_time(integrator: IntegratorName, times: list[float]) -> float:
    """What a frame is counted as [s]: the median, or of iterative ones what nine in ten stay below.

    Args:
        integrator: which one.
        times: of frames [s].
    """
    return float(np.percentile(times, 90 if integrator == 'implicit' else 50))


def _frame_times(
    task: Task, model: ModelName, integrator: IntegratorName, press: Press, most: int
) -> tuple[float, int, float]:
    """CPU time of a frame of at most so many substeps; how many are needed, and how long [s]."""
    s = task.stepping
    stepping = TimeStepping(
        integrator, s.rate, s.safety, min(s.min_substeps, most), most, s.frequency_growth
    )
    simulation = TissueSimulation(
        task.mesh, task.material, task.resistance, model=model, stepping=stepping
    )
    times = []
    for number in range(_FRAMES):
        contact = _contact(task, press, math.sin(math.pi * number / _FRAMES) ** 2)
        start = time.thread_time()
        frame = simulation.frame(contact)
        times.append(time.thread_time() - start)
    needed = frame.substeps / max(frame.slow_motion, 1e-12)
    return frame_time(integrator, times[1:]), math.ceil(needed - 1e-9), 1 / s.rate / needed


def _contact(task: Task, press: Press, share: float) -> ToolContact:
    # Less than what lets the blade in: contact stays contact.
    depth = min(0.9 * task.resistance.threshold / _COUPLING, 0.5 * task.budget.displacement)
    return press_triangle(task.mesh, press.centre, press.direction, share * depth, _COUPLING)


def _fits(task: Task, candidate: Candidate) -> bool:
    cost = task.worst(candidate)
    in_time = cost.substeps <= task.stepping.max_substeps and cost.frame <= task.available
    return in_time and candidate.errors.total <= task.budget.error


def _unfit(task: Task, candidate: Candidate) -> str:
    cost, errors = task.worst(candidate), candidate.errors
    after = ' when cuts have shortened the step' if cost != candidate.cost else ''
    if errors.total > task.budget.error:
        return (
            f'{candidate.name}: {_percent(errors.total)}, {_percent(errors.time)} of it by steps '
            f'of {_ms(cost.step)}'
        )
    if cost.frame > task.available:
        return (
            f'{candidate.name}: {cost.substeps} substeps of {_ms(cost.step)} cost '
            f'{_ms(cost.frame)} of {_ms(task.available)}{after}'
        )
    return (
        f'{candidate.name}: {cost.substeps} substeps{after}, above max_substeps, '
        f'{task.stepping.max_substeps}'
    )


def _inaccurate(model: ModelName, errors: Errors, budget: Budget) -> str:
    causes = {
        f'at the {budget.rotation:g} degrees that this scene allows': errors.rotation,
        f'at the {1e3 * budget.displacement:g} mm that this scene allows': errors.depth,
        'by elements of this size': errors.elements,
    }
    largest = max(causes.values())
    said = [
        f'{_percent(value)} {cause}' if math.isfinite(value) else f'gives way {cause}'
        for cause, value in causes.items()
        if value > 0.01 and (value == largest or value > budget.error / 3)
    ]
    return f'{model}: {", ".join(said)}; {_percent(budget.error)} is allowed'


def _remedies(task: Task, probing: Probing, tried: list[Candidate]) -> tuple[str, ...]:
    """What would have to give, the smallest step first of each kind."""
    b = task.budget
    said = []
    totals = {model: model_errors(model, probing, b).total for model in MODELS}
    best = min(totals, key=lambda model: totals[model])
    if totals[best] > b.error:
        said.append(f'allow an error of {_percent(math.ceil(100 * totals[best]) / 100)}: {best}')
        parts = model_errors(best, probing, b)
        if parts.elements > b.error:
            # Errors of displacement fall with the square of the size of the elements.
            finer = math.sqrt(parts.elements / (0.8 * b.error))
            said.append(f'or a mesh with edges {finer:.1f} times shorter')
    cheap = min(tried, key=lambda c: task.worst(c).frame, default=None)
    if cheap is not None:
        need = task.worst(cheap).frame
        cores = need * task.stepping.rate
        if b.cores < cores <= 1:
            said.append(f'give the simulation {math.ceil(100 * cores) / 100:g} cores: {cheap.name}')
        coarser = (need / task.available) ** 0.25
        if coarser > 1:
            said.append(f'or a mesh with edges {coarser:.2f} times longer: {cheap.name}')
        if task.worst(cheap) != cheap.cost and cheap.cost.frame <= task.available:
            fits = task.available / max(cheap.cost.frame, 1e-12)
            said.append(f'or a frequency_growth of {fits:.1f}: {cheap.name}')
    return tuple(said)


def _ms(seconds: float) -> str:
    return f'{1e3 * seconds:.3g} ms'


def _percent(share: float) -> str:
    return f'{round(100 * share)} %' if share >= 0.01 else f'{100 * share:.2g} %'
