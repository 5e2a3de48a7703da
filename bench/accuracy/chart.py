"""`trainer chart`: speed against accuracy of every method, on this machine."""

import csv
import json
import platform
from dataclasses import asdict, astuple, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console

from bench.accuracy.measure import EQUAL_ERROR_RATIO, Point, measure, reference_cost
from bench.accuracy.panels import Problem, static_problems
from bench.accuracy.peer_points import peer_points
from bench.accuracy.picture import draw, draw_regions
from bench.accuracy.problems import ALPHA, BETA
from bench.accuracy.region import ALPHA as REGION_ALPHA
from bench.accuracy.region import BETA as REGION_BETA
from bench.accuracy.region import LocalPalpation, describe
from bench.accuracy.vibration import Vibration
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

THESIS = ('linear', 'rk4')
"""Model and integrator of Yi 2007."""
DEFAULT = (
    TissueSettings.model_fields['model'].default,
    TissueSettings.model_fields['integrator'].default,
)
"""Default of a scene."""

NO_REGION = describe(ActiveSettings(TissueSettings.model_fields['active_region'].default.mode))
"""Default active region of a scene."""

_PAGE = """# Speed against accuracy

Written by `./trainer chart`: elastic models by integrators, on problems whose solution is known by
other means (named at the axis). Each scene's method is on the front of the panel that resembles it,
where methods that damp a motion do not count (`test/test_chart.py`).
[Others](performance.md#beside-others) bend the beam too. [All digits](charts/points.csv).

- **CPU time** is that of one thread, for a tissue bent as under its load and let go; explicit
  steps are {safety:g} of the stable one. A force of the linear model took {reference_cost:.1f} ns
  a tetrahedron before all measurements, and {after:.1f} after them ({machine}).
- **Error** belongs to model and mesh; the integrator matters in free vibration only. Scattered
  nodes are moved at random by up to a fifth of an edge, those inside only.
- Damping: alpha {alpha:g} 1/s, beta {beta:g} s (active region: {region_alpha:g} 1/s,
  {region_beta:g} s); none in free vibration, where forward Euler has no stable step. Implicit
  steps last a frame, 33 ms; in free vibration also a 4th and a 16th of it.

{panels}"""


def run_chart(folder: Path, *, coarse: bool = False, as_json: bool = False) -> None:
    """Measure, and write page, tables and pictures.

    Args:
        folder: that exists; the page goes into it, tables and pictures into `charts` in it.
        coarse: only the coarsest mesh of each problem.
        as_json: print the points as JSON too.

    Raises:
        SessionError: there is no such folder, or no reference solver.
    """
    if not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, the chart goes into it')
    console = Console(highlight=False, stderr=as_json)
    with console.status('') as line:
        before = reference_cost()
        progress = line.update if console.is_terminal else console.print
        points = measure(progress, coarse=coarse)
        after = reference_cost()
    write_chart(folder, points, (before, after))
    console.print(f'{folder / "charts.md"}: {len(points)} points')
    if as_json:
        data = {
            'machine': machine(),
            'nanoseconds_a_tetrahedron': {'before': before, 'after': after},
            'points': [asdict(point) for point in points],
        }
        print(json.dumps(data, indent=2, allow_nan=False))


def write_chart(folder: Path, points: list[Point], yardsticks: tuple[float, float]) -> None:
    """Write the measured points.

    Args:
        folder: for the page; `charts` in it for the rest.
        points: of all problems.
        yardsticks: before and after [ns].
    """
    charts = folder / 'charts'
    charts.mkdir(exist_ok=True)
    with (charts / 'points.csv').open('w', newline='') as out:
        writer = csv.writer(out, lineterminator='\n')
        writer.writerow([field.name for field in fields(Point)])
        writer.writerows(_rounded(point) for point in points)
    panels = []
    for problem in (*static_problems(), Vibration()):
        own = [point for point in points if point.problem == problem.name]
        if not own:
            continue
        text, peers = sentence(own), peer_points(problem.name)
        figure = draw(problem.title, problem.reference_name, own, text, THESIS, DEFAULT, peers)
        figure.savefig(charts / f'{problem.name}.png', dpi=110)
        panels.append(_panel(problem))
    panels.append(_region_panel(charts, [p for p in points if p.problem == LocalPalpation.name]))
    page = _PAGE.format(
        safety=TimeStepping().safety,
        machine=machine(),
        reference_cost=yardsticks[0],
        after=yardsticks[1],
        alpha=ALPHA,
        beta=BETA,
        region_alpha=REGION_ALPHA,
        region_beta=REGION_BETA,
        panels='\n'.join(panels),
    )
    (folder / 'charts.md').write_text(page, encoding='utf-8')


def _region_panel(charts: Path, own: list[Point]) -> str:
    problem = LocalPalpation()
    text = region_sentence(own)
    figure = draw_regions(problem.title, problem.reference_name, own, text, NO_REGION)
    figure.savefig(charts / f'{problem.name}.png', dpi=110)
    return _panel(problem)


def region_sentence(points: list[Point]) -> str:
    """Return a sentence on the panel of the active region: each region on the finest mesh."""
    finest = [p for p in points if p.resolution == max(q.resolution for q in points)]
    whole = next(p for p in finest if p.region == NO_REGION)
    said = [
        f'{p.region} {100 * p.displacement_error:.2g} %, '
        f'{p.cpu_per_second / whole.cpu_per_second:.2g}'
        for p in finest
        if p is not whole
    ]
    return (
        f'With {whole.tetrahedra} tetrahedra all nodes err by '
        f'{100 * whole.displacement_error:.2g} %, which is the step; by region, error and CPU '
        f'time over theirs: {"; ".join(said)}.'
    )


def _panel(problem: Problem | Vibration | LocalPalpation) -> str:
    return f'## {problem.title}\n\n![Error against CPU time](charts/{problem.name}.png)\n'


def sentence(points: list[Point]) -> str:
    """Return a sentence on a panel: cost and method of an error of 10 % and of 1 %."""
    said = [_cost_of(points, target) for target in (0.10, 0.01)]
    return '; '.join(said) + f'. {_plain(points)}'


def _cost_of(points: list[Point], target: float) -> str:
    reached = {
        name: cost
        for name in sorted({(p.model, p.integrator) for p in points})
        if (cost := cost_for(_line(points, *name), target)) is not None
    }
    percent = f'{100 * target:g} %'
    if not reached:
        least = EQUAL_ERROR_RATIO * min(p.displacement_error for p in points)
        near = [p for p in points if p.displacement_error <= least]
        nearest = min(near, key=lambda p: p.cpu_per_second)
        return (
            f'{percent} was not reached on these meshes, the nearest being '
            f'{100 * nearest.displacement_error:.2g} % with {nearest.model} by '
            f'{nearest.integrator} for {nearest.cpu_per_second:.2g} s a second'
        )
    (model, integrator), cost = min(reached.items(), key=lambda item: item[1])
    coarsest = cost == _line(points, model, integrator)[0].cpu_per_second
    most = 'at most ' if coarsest else ''
    return f'{percent} costs {most}{cost:.2g} s a second, with {model} by {integrator}'


def _plain(points: list[Point]) -> str:
    """Return the cost of plain elements for an error that smoothed ones reach as well."""
    found = []
    for kind in sorted({p.model for p in points} & {'linear', 'corotational'}):
        plain = _cheapest(points, kind)[-1]
        as_near = [
            p
            for p in _cheapest(points, f'{kind}_smoothed')
            if p.displacement_error <= plain.displacement_error
        ]
        if as_near:
            found.append((plain, min(as_near, key=lambda p: p.cpu_per_second)))
    if not found:
        return 'Smoothing the strains does not pay here.'
    plain, smoothed = min(found, key=lambda pair: pair[0].displacement_error)
    return (
        f'The finest plain mesh, {plain.tetrahedra} tetrahedra, reaches '
        f'{100 * plain.displacement_error:.2g} % with {plain.model}, for '
        f'{plain.cpu_per_second / smoothed.cpu_per_second:.2g} times the CPU time in which '
        f'{smoothed.model} reaches {100 * smoothed.displacement_error:.2g} % with '
        f'{smoothed.tetrahedra}.'
    )


def _cheapest(points: list[Point], model: str) -> list[Point]:
    """Return the cheapest integrator of a model, by resolution."""
    own = [p for p in points if p.model == model]
    return [
        min((p for p in own if p.resolution == r), key=lambda p: p.cpu_per_second)
        for r in sorted({p.resolution for p in own})
    ]


def _line(points: list[Point], model: str, integrator: str) -> list[Point]:
    own = [p for p in points if (p.model, p.integrator) == (model, integrator)]
    return sorted(own, key=lambda p: (p.resolution, p.cpu_per_second))


def cost_for(line: list[Point], error: float) -> float | None:
    """Return CPU time at which a method reaches an error, between its meshes on the logarithmic
    chart.

    Args:
        line: the method's points, coarsest mesh first.
        error: of the displacement.

    Returns:
        [s/s]; None where it does not reach it.
    """
    if line and line[0].displacement_error <= error:
        return line[0].cpu_per_second
    for a, b in pairwise(line):
        if b.displacement_error <= error < a.displacement_error:
            share = np.log(a.displacement_error / error) / np.log(
                a.displacement_error / b.displacement_error
            )
            ratio = np.log(b.cpu_per_second / a.cpu_per_second)
            return float(a.cpu_per_second * np.exp(share * ratio))
    return None


def _rounded(point: Point) -> tuple[object, ...]:
    return tuple(f'{v:.4g}' if isinstance(v, float) else v for v in astuple(point))


def machine() -> str:
    """Return the name of the processor."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    except OSError:
        return name
    models = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return models[0] if models else name
