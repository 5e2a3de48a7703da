"""Measured CPU time of a method's frames on a scene, and savings by an active region.

The tool goes as deep as the budget says: a law counts where the tissue strains. Most of all it
strains under a blade, which is drawn through the tissue, uncut, where the scene has cuts.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import Frame, ToolContact, indenter_contact
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Cost, Task
from cutting_trainer.tissue_sim.planner.indentation import Indenter, places
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

_SHORT, _LONG = 4, 16
_FRAMES = 16
_REPEATS = 3
"""Strokes; the least time of each frame counts, because other load only adds to it."""
_ENOUGH_S = 0.4
"""CPU time after which strokes are not repeated."""
_HOPELESS = 2.0
"""Cost, in shares of the allowed one, at which implicit steps are not tried elsewhere: the dearest
place counts, and other load no more than doubles a cost."""
_NEVER, _TOUCH = 1e9, 1e-6
"""Forces at which the blade enters [N]: never, and where it touches."""
_COUPLING = 200.0
"""Stiffness of the coupling spring in the measurement [N/m]."""
_BLADE_STEP = 0.001
"""Way of the blade in a frame [m]: 3 cm/s at 30 Hz."""
_BLADE_WAY = 0.03
"""Way that the blade is drawn [m]: tough tissue yields by 1 to 2 cm first."""
_BLADE_MAX_S = 2.0
"""CPU time after which it is drawn no further [s]."""
_DEAR_SHARE = 90
"""Percentile of its frames that counts: those in which the tissue strains most."""


def tool_depth(task: Task, settled: float) -> float:
    """Return how deep the tool goes until the tissue is as deep as required [m].

    Args:
        task: the scene.
        settled: settlement of the tissue by force [m/N].
    """
    return task.budget.displacement * (1.0 + 1.0 / (settled * _COUPLING))


def frame_cost(
    task: Task,
    model: ModelName,
    integrator: IntegratorName,
    depth: float,
    active: ActiveSettings | None = None,
) -> Cost:
    """Return the CPU time of frames in which a tool goes in and out.

    Frames are cut short and extrapolated by their number of substeps, so that very slow methods do
    not delay the planner.

    Args:
        task: the scene.
        model, integrator: the method.
        depth: of the tool [m].
        active: region; None: all nodes move.
    """
    active = active or ActiveSettings()
    indenters = places(task.mesh, task.budget.contact_radius)
    if integrator == 'implicit':  # the number of iterations depends on place and depth
        found: list[_Timed] = []
        for indenter in indenters:
            found.append(_Timed(task, model, integrator, indenter, depth, _LONG, active))
            found[-1].stroke(2)
            if found[-1].frame > _HOPELESS * task.available:
                break
        return Cost(found[0].substeps, found[0].step, max(timed.frame for timed in found), 0.0)
    long, short = (
        _Timed(task, model, integrator, indenters[0], depth, most, active)
        for most in (_LONG, _SHORT)
    )
    for _ in _repeats(_REPEATS):
        long.stroke()
        if long.substeps > _LONG:
            short.stroke()
    if long.substeps == 1:
        return Cost(1, long.step, long.frame, 0.0)
    if long.substeps <= _LONG:
        return Cost(long.substeps, long.step, 0.0, long.frame / long.substeps)
    each = max((long.frame - short.frame) / (_LONG - _SHORT), long.frame / _LONG / 4)
    return Cost(long.substeps, long.step, max(long.frame - _LONG * each, 0.0), each)


def _repeats(most: int) -> Iterator[int]:
    """Yield numbers of repeats up to a largest one, or until `_ENOUGH_S` of CPU time are over.

    Two simulations take turns in each, so that both see the same load of the machine.
    """
    start = time.process_time()
    for number in range(most):
        yield number
        if time.process_time() - start > _ENOUGH_S:
            return


def frame_time(integrator: IntegratorName, times: list[float]) -> float:
    """Return the representative time of frames [s]: the median, or the 90th percentile for
    iterative methods.

    Args:
        integrator: which one.
        times: of frames [s].
    """
    return float(np.percentile(times, 90 if integrator == 'implicit' else 50))


class _Timed:
    """A timed simulation with a bounded number of substeps per frame.

    Attributes:
        substeps: required by a frame, of `step` [s] each.
    """

    def __init__(
        self,
        task: Task,
        model: ModelName,
        integrator: IntegratorName,
        indenter: Indenter,
        depth: float,
        most: int,
        active: ActiveSettings,
    ) -> None:
        s = task.stepping
        stepping = replace(
            s, integrator=integrator, min_substeps=min(s.min_substeps, most), max_substeps=most
        )
        self._simulation = TissueSimulation(
            task.mesh,
            task.material,
            uncut(task),
            model=model,
            stepping=stepping,
            active=active,
            threads=task.budget.threads,
        )
        self._contacts = _in_and_out(task, indenter, depth)
        self._times: list[list[float]] = []
        self.substeps, self.step = 0, 0.0

    def stroke(self, repeats: int = 1) -> None:
        """Move a tool in and out."""
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


def uncut(task: Task) -> Resistance:
    """Return the resistance of a tissue that the blade never enters."""
    return replace(task.resistance, threshold=_NEVER)


def _in_and_out(task: Task, indenter: Indenter, depth: float) -> list[ToolContact]:
    shares = [math.sin(math.pi * number / _FRAMES) ** 2 for number in range(_FRAMES)]
    place = indenter.centre, indenter.direction
    return [indenter_contact(task.mesh, *place, share * depth, _COUPLING) for share in shares]


def _timed(simulation: TissueSimulation, contact: ToolContact | None) -> tuple[Frame, float]:
    """Return a frame, and its CPU time; of several threads its time, in which they wait too [s]."""
    clock = time.perf_counter if simulation.dynamics.parallel else time.thread_time
    start = clock()
    frame = simulation.frame(contact)
    return frame, clock() - start


def with_blade(task: Task, candidate: Candidate) -> Candidate:
    """Return the method with the cost of a frame in which a blade is drawn, if the scene has cuts.

    The blade cuts nothing: the tissue strains as in a cut, but its mesh stays as it is.

    Args:
        task: the scene.
        candidate: the method.
    """
    if not task.budget.cuts:
        return candidate
    simulation = TissueSimulation(
        task.mesh,
        task.material,
        replace(task.resistance, threshold=_TOUCH, tip_width=0.0),
        model=candidate.model,
        stepping=task.stepped_by(candidate),
        active=candidate.active,
        threads=task.budget.threads,
    )
    spent: list[float] = []
    for contact in _drawn(task):
        frame, seconds = _timed(simulation, contact)
        if frame.command is not None:
            simulation.cut_done()
        if simulation.blade is not None:
            spent.append(seconds)
        if sum(spent) > _BLADE_MAX_S:
            break
    cutting = float(np.percentile(spent, _DEAR_SHARE)) if spent else 0.0
    return replace(candidate, cutting=cutting)


def _drawn(task: Task) -> Iterator[ToolContact]:
    """Yield the contacts of a blade that goes in, as deep as a tool is wide, and is drawn towards
    the middle.
    """
    rest, radius = task.mesh.rest, task.budget.contact_radius
    indenter = places(task.mesh, radius, 1)[0]
    into = indenter.direction
    way = rest.mean(axis=0) - indenter.centre
    way -= (way @ into) * into
    if np.linalg.norm(way) < _BLADE_STEP:  # it is over the middle: to any side
        way = np.cross(into, np.eye(3)[np.abs(into).argmin()])
    way /= np.linalg.norm(way)
    depth = min(radius, float(np.ptp(rest @ into)) / 2)
    for gone in np.arange(0.0, depth + _BLADE_WAY, _BLADE_STEP):
        contact = indenter_contact(task.mesh, indenter.centre, into, min(gone, depth), _COUPLING)
        shift = max(gone - depth, 0.0) * way
        yield replace(
            contact,
            device=contact.device + shift,
            blade_root=contact.blade_root + shift,
            blade_tip=contact.blade_tip + shift,
        )


class _Strokes:
    """Timed frames in which a tool goes in, out, and stays away, with an active region."""

    def __init__(
        self, task: Task, candidate: Candidate, depth: float, active: ActiveSettings
    ) -> None:
        self._simulation = TissueSimulation(
            task.mesh,
            task.material,
            uncut(task),
            model=candidate.model,
            stepping=task.stepped_by(candidate),
            active=active,
            threads=task.budget.threads,
        )
        indenter = places(task.mesh, task.budget.contact_radius, 1)[0]
        self._contacts = _in_and_out(task, indenter, depth)
        self._times: list[list[float]] = []

    def stroke(self) -> np.ndarray:
        """Return the displacement after each frame [m], shape (f, n, 3)."""
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


def with_sleepers(task: Task, candidate: Candidate, depth: float) -> Candidate:
    """Return the method with an active region in which slow nodes sleep, with cost and error.

    The error is the largest difference of any node's displacement while a tool goes in, out, and
    stays away, relative to the largest displacement.

    Args:
        task: the scene.
        candidate: the method with all nodes moving.
        depth: of the tool [m].
    """
    active = ActiveSettings('on')
    both = [_Strokes(task, candidate, depth, region) for region in (ActiveSettings(), active)]
    right, seen = (strokes.stroke() for strokes in both)
    for _ in _repeats(_REPEATS - 1):
        for strokes in both:
            strokes.stroke()
    most = float(np.linalg.norm(right, axis=2).max())
    wrong = float(np.linalg.norm(seen - right, axis=2).max()) / most
    share, cost = both[1].frame / both[0].frame, candidate.cost
    return replace(
        candidate,
        active=active,
        errors=replace(candidate.errors, region=wrong),
        cost=replace(cost, fixed=share * cost.fixed, each=share * cost.each),
    )
