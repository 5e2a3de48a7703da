"""Measure the points of the chart: error and CPU time of each method on each mesh."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bench.accuracy.panels import Problem, static_problems
from bench.accuracy.problems import AfterCut, Rest
from bench.accuracy.region import LocalPalpation, describe
from bench.accuracy.vibration import Vibration
from bench.common.meshes import kuhn_block
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

_MAX_SUBSTEPS = 100_000
"""More substeps than any method needs in a frame."""
_MIN_FRAMES, _MAX_FRAMES, _MAX_CPU_TIME_S = 3, 9, 0.5
"""Smallest and largest number of timed frames, and CPU time that ends them [s]."""
_WAKING_VELOCITY = 1e-6
"""Velocity that wakes a tissue at rest."""
EQUAL_ERROR_RATIO = 1.01
"""Ratio of errors that counts as equal: models that agree on a problem differ by rounding."""
_IMPLICIT_SUBSTEPS = (1, 4, 16)
"""Steps a frame of the implicit integrator in free vibration: its accuracy, not stability."""


@dataclass(frozen=True)
class Point:
    """One method on one mesh; the names are the columns of the table.

    Attributes:
        resolution: bricks over the depth of the body.
        step_ms: [ms].
        cpu_per_second: CPU time for a second of simulated time [s/s].
        displacement_error, force_error: relative.
        front: no other point of the problem is cheaper and as near or nearer.
        region: the active region: off, on with its tolerance [m/s], budget with its nodes.
    """

    problem: str
    model: str
    integrator: str
    resolution: int
    tetrahedra: int
    step_ms: float
    substeps: int
    cpu_per_second: float
    displacement_error: float
    force_error: float
    front: bool = False
    region: str = 'off'


def measure(
    progress: Callable[[str], None] = lambda name: None, *, coarse: bool = False
) -> list[Point]:
    """Measure everything.

    Args:
        progress: called with the next step.
        coarse: only the coarsest mesh of each problem.
    """
    points: list[Point] = []
    for problem in static_problems():
        points += with_front(_static(problem, progress, coarse))
    points += with_front(_vibration(Vibration(), progress, coarse))
    return points + _palpation(LocalPalpation(), progress, coarse)


def _static(problem: Problem, progress: Callable[[str], None], coarse: bool) -> list[Point]:
    points = []
    for resolution in problem.resolutions[: 1 if coarse else None]:
        for model in getattr(problem, 'models', MODELS):
            progress(f'{problem.title}, {model}, resolution {resolution}')
            rest = problem.rest(model, resolution)
            for integrator in INTEGRATORS:
                points.append(_timed(problem, rest, model, integrator, resolution))
    return points


def _timed(
    problem: Problem, rest: Rest, model: ModelName, integrator: IntegratorName, resolution: int
) -> Point:
    stepping = TimeStepping(integrator, max_substeps=_MAX_SUBSTEPS)
    if isinstance(problem, AfterCut):
        dynamics = problem.dynamics(model, resolution, stepping)
        free = dynamics.mesh.fixed == 0
        dynamics.displacement[free] = rest.displacement[free]
        dynamics.velocity[free] = _WAKING_VELOCITY
    else:
        dynamics = Dynamics(rest.model.mesh, rest.model.material, model, stepping)
        dynamics.displacement[:] = rest.displacement
    cost, step, substeps = cpu_per_second(dynamics)
    return Point(
        problem.name,
        model,
        integrator,
        resolution,
        len(dynamics.mesh.tetrahedra),
        1e3 * step,
        substeps,
        cost,
        rest.errors.displacement,
        rest.errors.force,
    )


def cpu_per_second(dynamics: Dynamics) -> tuple[float, float, int]:
    """Return CPU time by simulated time of a tissue that was just released; step [s]; substeps.

    The first frame warms up; the median of the next ones counts.
    """
    rate = dynamics.stepping.rate
    times: list[float] = []
    motion = dynamics.advance(Coupling())
    while len(times) < _MAX_FRAMES and (len(times) < _MIN_FRAMES or sum(times) < _MAX_CPU_TIME_S):
        start = time.thread_time()
        motion = dynamics.advance(Coupling())
        times.append((time.thread_time() - start) / motion.slow_motion)
    step = motion.slow_motion / rate / motion.substeps
    return float(np.median(times)) * rate, step, motion.substeps


def _vibration(problem: Vibration, progress: Callable[[str], None], coarse: bool) -> list[Point]:
    points = []
    for resolution in problem.resolutions[: 1 if coarse else None]:
        for model in MODELS:
            progress(f'{problem.title}, {model}, resolution {resolution}')
            for integrator in INTEGRATORS:
                if integrator == 'euler':
                    continue  # it has no stable step without damping
                for fewest in _IMPLICIT_SUBSTEPS if integrator == 'implicit' else (1,):
                    stepping = TimeStepping(
                        integrator, min_substeps=fewest, max_substeps=_MAX_SUBSTEPS
                    )
                    errors, cost, step = problem.swing(model, resolution, stepping)
                    substeps = round(1 / stepping.rate / step)
                    points.append(
                        Point(
                            problem.name,
                            model,
                            integrator,
                            resolution,
                            30 * resolution**3,
                            1e3 * step,
                            substeps,
                            cost,
                            errors.displacement,
                            errors.force,
                        )
                    )
    return points


def _palpation(
    problem: LocalPalpation, progress: Callable[[str], None], coarse: bool
) -> list[Point]:
    """Measure active regions: each mesh has its own reference and front."""
    points: list[Point] = []
    for resolution in problem.resolutions[: 1 if coarse else None]:
        own = []
        tetrahedra = len(problem.mesh(resolution).tetrahedra)
        for active in problem.regions(resolution):
            region = describe(active)
            progress(f'{problem.title}, {region}, resolution {resolution}')
            errors, course = problem.palpate(resolution, active)
            own.append(
                Point(
                    problem.name,
                    problem.model,
                    problem.integrator,
                    resolution,
                    tetrahedra,
                    1e3 * course.step,
                    round(1 / TimeStepping().rate / course.step),
                    course.cost,
                    errors.displacement,
                    errors.force,
                    region=region,
                )
            )
        points += with_front(own)
    return points


def with_front(points: list[Point]) -> list[Point]:
    """Return the same points of one problem, with those on the front marked as such."""
    return [
        replace(point, front=not any(is_beaten(point, other) for other in points))
        for point in points
    ]


def is_beaten(point: Point, other: Point) -> bool:
    """Return whether another point of the same problem is cheaper, and as near or nearer."""
    return (
        other.cpu_per_second < point.cpu_per_second
        and other.displacement_error < EQUAL_ERROR_RATIO * point.displacement_error
    )


def reference_cost() -> float:
    """Return CPU time of an elastic force of plain linear elements, by element, here and now [ns].

    Written beside the chart: another machine's figures compare by it.
    """
    mesh = kuhn_block((17, 16, 6), (0.10, 0.10, 0.04))
    model = ElasticModel(mesh, Material(5000.0, 0.47, 1050.0))
    u = np.random.default_rng(0).standard_normal((mesh.node_count, 3)) * 1e-6
    times = []
    for _ in range(41):
        start = time.thread_time()
        model.force(u)
        times.append(time.thread_time() - start)
    return 1e9 * float(np.median(times[1:])) / len(mesh.tetrahedra)
