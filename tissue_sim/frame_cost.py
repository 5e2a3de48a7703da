"""What frames of a method cost on a scene, measured here and now; what an active region saves."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.active_region import ActiveSettings
from tissue_sim.candidate import Candidate, Cost, Task
from tissue_sim.contact import ToolContact, press_triangle
from tissue_sim.elasticity import ModelName
from tissue_sim.integrators import IntegratorName
from tissue_sim.press import Press, places
from tissue_sim.simulation import TissueSimulation

_SHORT, _LONG = 4, 16
_FRAMES = 16
_COUPLING = 200.0
"""Stiffness of the spring that costs are measured with [N/m]."""


def frame_cost(task: Task, model: ModelName, integrator: IntegratorName) -> Cost:
    """CPU time of frames in which a tool goes in and out.

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
    stepping = replace(
        s, integrator=integrator, min_substeps=min(s.min_substeps, most), max_substeps=most
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
    return frame_time(integrator, times[1:]), math.ceil(needed - 1e-9), float(1 / s.rate / needed)


def _contact(task: Task, press: Press, share: float) -> ToolContact:
    # Less than what lets the blade in: contact stays contact.
    depth = min(0.9 * task.resistance.threshold / _COUPLING, 0.5 * task.budget.displacement)
    return press_triangle(task.mesh, press.centre, press.direction, share * depth, _COUPLING)


@dataclass(frozen=True)
class _Strokes:
    """Frames in which a tool goes in, out, and stays away.

    Attributes:
        cost: of a frame in contact, the median [s].
        displacement: after each frame [m], shape (f, n, 3).
    """

    cost: float
    displacement: np.ndarray


def _strokes(task: Task, candidate: Candidate, active: ActiveSettings) -> _Strokes:
    simulation = TissueSimulation(
        task.mesh,
        task.material,
        task.resistance,
        model=candidate.model,
        stepping=task.stepped_by(candidate),
        active=active,
    )
    press = places(task.mesh, task.budget.contact_radius, 1)[0]
    times, seen = [], []
    for number in range(2 * _FRAMES):
        inside = number < _FRAMES
        share = math.sin(math.pi * number / _FRAMES) ** 2
        start = time.thread_time()
        simulation.frame(_contact(task, press, share) if inside else None)
        times.append(time.thread_time() - start)
        seen.append(simulation.displacement.copy())
    return _Strokes(float(np.median(times[1:_FRAMES])), np.array(seen))


def with_regions(
    task: Task, candidate: Candidate, regions: list[ActiveSettings]
) -> list[Candidate]:
    """The same method with less than all nodes moving, its cost and error measured.

    The error is the largest difference of any node's displacement while a tool goes in, out, and
    stays away, relative to the largest displacement.

    Args:
        task: the scene.
        candidate: with all nodes moving.
        regions: which nodes move.
    """
    whole = _strokes(task, candidate, ActiveSettings())
    most = float(np.linalg.norm(whole.displacement, axis=2).max())
    found = []
    for region in regions:
        part = _strokes(task, candidate, region)
        apart = np.linalg.norm(part.displacement - whole.displacement, axis=2).max()
        wrong, share = float(apart) / most, part.cost / whole.cost
        cost = candidate.cost
        found.append(
            replace(
                candidate,
                active=region,
                errors=replace(candidate.errors, region=wrong),
                cost=replace(cost, fixed=share * cost.fixed, each=share * cost.each),
            )
        )
    return found
