"""Choice of the number of nodes that move on their own, by a curve of error and cost."""

import math
from collections.abc import Callable
from dataclasses import replace

from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Task
from cutting_trainer.tissue_sim.planner.far_field_errors import FarFieldTrial
from cutting_trainer.tissue_sim.planner.frame_cost import frame_cost
from cutting_trainer.tissue_sim.planner.indentation import Indenter
from cutting_trainer.tissue_sim.planner.method_errors import MARGIN
from cutting_trainer.tissue_sim.planner.rejection_reasons import Rejection, unfit

_FEWEST = 100
"""Number of nodes that is tried first."""
_MAX_SHARE = 0.5
"""Share of all nodes above which a far field saves nothing."""
_TRIALS = 6
_AIM = 0.8
"""Share of the allowed error that is aimed at, so that the next trial meets it."""
_STRIDE = (1.25, 3.0)
"""Least and largest ratio of two numbers that follow one another."""


def far_field(
    task: Task,
    candidate: Candidate,
    indenter: Indenter,
    depth: float,
    say: Callable[[str], None],
) -> tuple[Candidate | None, list[Rejection]]:
    """Return the method with the fewest nodes that meet the allowed error, if it is in time, and
    the others that were tried.

    Args:
        task: the scene.
        candidate: the method with all nodes moving.
        indenter: at the softest place.
        depth: of the tool in the measured frames [m].
        say: gets the name of the next measurement.
    """
    smoothed = candidate.model not in ('linear', 'corotational')
    trial = FarFieldTrial(task.mesh, task.material, indenter, smoothed=smoothed)
    allowed = (task.budget.error - candidate.errors.total) / MARGIN
    rejected: list[Rejection] = []
    curve: list[tuple[int, float]] = []
    nodes = _FEWEST
    while len(curve) < _TRIALS and nodes <= _MAX_SHARE * task.mesh.node_count:
        say(f'far field with {nodes} nodes')
        error = trial.error(nodes)
        curve.append((nodes, error))
        active = ActiveSettings('budget', nodes)
        part = replace(
            candidate,
            active=active,
            errors=replace(candidate.errors, region=MARGIN * error),
            cost=frame_cost(task, candidate.model, candidate.integrator, depth, active),
        )
        if task.fits(part):
            return part, rejected
        rejected.append(unfit(task, part))
        if not task.in_time(part):  # more nodes cost more
            break
        nodes = _next(curve, allowed)
    return None, rejected


def _next(curve: list[tuple[int, float]], allowed: float) -> int:
    """Return the number of nodes at which a power law through the last two trials meets the aim."""
    stride = _STRIDE[1]
    if len(curve) > 1 and allowed > 0.0:
        (few, high), (more, low) = curve[-2:]
        slope = math.log(high / low) / math.log(more / few) if high > low > 0.0 else 0.0
        if slope > 0.0:
            stride = (low / (_AIM * allowed)) ** (1.0 / slope)
    return math.ceil(curve[-1][0] * min(max(stride, _STRIDE[0]), _STRIDE[1]) / 10) * 10
