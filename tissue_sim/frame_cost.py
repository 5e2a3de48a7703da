"""What frames of a method cost on a scene, measured here and now; what an active region saves."""

import math
import time
from dataclasses import replace

import numpy as np

from tissue_sim.active_region import ActiveSettings
from tissue_sim.candidate import Candidate, Cost, Task
from tissue_sim.contact import Frame, ToolContact, press_triangle
from tissue_sim.elasticity import ModelName
from tissue_sim.integrators import IntegratorName
from tissue_sim.press import Press, places
from tissue_sim.simulation import TissueSimulation

_SHORT, _LONG = 4, 16
_FRAMES = 16
_REPEATS = 3
"""Strokes of which each frame's least time counts: what else the machine does only adds to it."""
_COUPLING = 200.0
"""Stiffness of the spring that costs are measured with [N/m]."""


def frame_cost(task: Task, model: ModelName, integrator: IntegratorName) -> Cost:
    """CPU time of frames in which a tool goes in and out.

    Frames are cut short, and what is left of their substeps is counted: a method that is far too
    slow for the scene is not waited for.
    """
    presses = places(task.mesh, task.budget.contact_radius)
    if integrator == 'implicit':  # how many iterations it takes depends on where and how
        found = [_Timed(task, model, integrator, press, _LONG) for press in presses]
        for timed in found:
            timed.stroke(_REPEATS)
        return Cost(found[0].substeps, found[0].step, max(timed.frame for timed in found), 0.0)
    long, short = (_Timed(task, model, integrator, presses[0], most) for most in (_LONG, _SHORT))
    for _ in range(_REPEATS):  # by turns, so that both meet the same machine
        long.stroke()
        if long.substeps > _LONG:
            short.stroke()
    if long.substeps == 1:
        return Cost(1, long.step, long.frame, 0.0)
    if long.substeps <= _LONG:
        return Cost(long.substeps, long.step, 0.0, long.frame / long.substeps)
    each = max((long.frame - short.frame) / (_LONG - _SHORT), long.frame / _LONG / 4)
    return Cost(long.substeps, long.step, max(long.frame - _LONG * each, 0.0), each)


def frame_time(integrator: IntegratorName, times: list[float]) -> float:
    """What a frame is counted as [s]: the median, or of iterative ones what nine in ten stay below.

    Args:
        integrator: which one.
        times: of frames [s].
    """
    return float(np.percentile(times, 90 if integrator == 'implicit' else 50))


class _Timed:
    """A simulation whose frames have at most so many substeps, and how long they take.

    Attributes:
        substeps: that a frame needs, of `step` [s] each.
    """

    def __init__(
        self, task: Task, model: ModelName, integrator: IntegratorName, press: Press, most: int
    ) -> None:
        s = task.stepping
        stepping = replace(
            s, integrator=integrator, min_substeps=min(s.min_substeps, most), max_substeps=most
        )
        self._simulation = TissueSimulation(
            task.mesh, task.material, task.resistance, model=model, stepping=stepping
        )
        self._contacts = _in_and_out(task, press)
        self._times: list[list[float]] = []
        self.substeps, self.step = 0, 0.0

    def stroke(self, repeats: int = 1) -> None:
        """A tool goes in and out."""
        for _ in range(repeats):
            times = []
            for contact in self._contacts:
                frame, spent = _timed(self._simulation, contact)
                times.append(spent)
            self._times.append(times[1:])
        needed = frame.substeps / max(frame.slow_motion, 1e-12)
        self.substeps = math.ceil(needed - 1e-9)
        self.step = float(1 / self._simulation.dynamics.stepping.rate / needed)

    @property
    def frame(self) -> float:
        """CPU time of a frame [s]."""
        integrator = self._simulation.dynamics.stepping.integrator
        return frame_time(integrator, np.min(self._times, axis=0).tolist())


def _in_and_out(task: Task, press: Press) -> list[ToolContact]:
    # Less than what lets the blade in: contact stays contact.
    depth = min(0.9 * task.resistance.threshold / _COUPLING, 0.5 * task.budget.displacement)
    shares = [math.sin(math.pi * number / _FRAMES) ** 2 for number in range(_FRAMES)]
    place = press.centre, press.direction
    return [press_triangle(task.mesh, *place, share * depth, _COUPLING) for share in shares]


def _timed(simulation: TissueSimulation, contact: ToolContact | None) -> tuple[Frame, float]:
    """A frame, and its CPU time [s]."""
    start = time.thread_time()
    frame = simulation.frame(contact)
    return frame, time.thread_time() - start


class _Strokes:
    """Frames in which a tool goes in, out, and stays away, with so much of the tissue moving."""

    def __init__(self, task: Task, candidate: Candidate, active: ActiveSettings) -> None:
        self._simulation = TissueSimulation(
            task.mesh,
            task.material,
            task.resistance,
            model=candidate.model,
            stepping=task.stepped_by(candidate),
            active=active,
        )
        press = places(task.mesh, task.budget.contact_radius, 1)[0]
        self._contacts = _in_and_out(task, press)
        self._times: list[list[float]] = []

    def stroke(self) -> np.ndarray:
        """The displacement after each frame [m], shape (f, n, 3)."""
        times, seen = [], []
        for contact in [*self._contacts, *[None] * _FRAMES]:
            times.append(_timed(self._simulation, contact)[1])
            seen.append(self._simulation.displacement.copy())
        self._times.append(times[1:_FRAMES])
        return np.array(seen)

    @property
    def frame(self) -> float:
        """CPU time of a frame in contact [s]."""
        return float(np.median(np.min(self._times, axis=0)))


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
    whole, *parts = (_Strokes(task, candidate, r) for r in [ActiveSettings(), *regions])
    right, *others = [strokes.stroke() for strokes in [whole, *parts]]
    for _ in range(_REPEATS - 1):  # by turns, so that all meet the same machine
        for strokes in [whole, *parts]:
            strokes.stroke()
    most = float(np.linalg.norm(right, axis=2).max())
    found = []
    for region, part, seen in zip(regions, parts, others, strict=True):
        wrong = float(np.linalg.norm(seen - right, axis=2).max()) / most
        share, cost = part.frame / whole.frame, candidate.cost
        found.append(
            replace(
                candidate,
                active=region,
                errors=replace(candidate.errors, region=wrong),
                cost=replace(cost, fixed=share * cost.fixed, each=share * cost.each),
            )
        )
    return found
