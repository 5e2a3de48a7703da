"""Figures of the stiffening law: against quadratic elements, adaptive against everywhere, yanks."""

import time
from typing import Any

import numpy as np

from bench.accuracy.law_problems import CASES, compared, settled, solved_reference
from bench.accuracy.law_problems import unstructured_block as block_of
from bench.common.meshes import kuhn_block
from bench.cuts.random_loads import MAX_AWAY, torture
from bench.figures.figure import Figure
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName

STIFFENING = 6.0
EDGE_M = 0.006
"""Mean edge of the unstructured meshes [m]."""
COMPARED = (('press 30 %', 0.45), ('stretch 30 %', 0.45))
SLIVER_SEEDS = (0, 1)
EVALUATIONS = 200


def measure() -> list[Figure]:
    """Measure all figures of the law."""
    return [*against_reference(), *adaptive_against_full(), *yanked(), *cost()]


def against_reference() -> list[Figure]:
    """Measure force and field against quadratic hexahedra of the same law."""
    errors = []
    for name, nu in COMPARED:
        case = CASES[name]
        reference = solved_reference(case, nu, STIFFENING, 4)
        errors.append(compared(case, reference, nu, EDGE_M, 1))
    n = len(errors)
    return [
        Figure(2, 'force against quadratic elements of the law', max(abs(e.force) for e in errors),
               0.05, 'at most', '', n),
        Figure(2, 'field against quadratic elements of the law', max(e.field for e in errors),
               0.07, 'at most', '', n),
    ]  # fmt: skip


def adaptive_against_full() -> list[Figure]:
    """Measure what the tolerance changes, at a press by a tenth of the height."""
    case, found = CASES['punch 10 %'], []
    mesh = block_of(case, EDGE_M, 1)
    for tolerance in (0.0, None):
        more: dict[str, Any] = {} if tolerance is None else {'tolerance': tolerance}
        found.append(settled(case, mesh, 0.45, STIFFENING, **more))
    (_, full, right), (_, some, force) = found
    field = float(np.linalg.norm(some - full) / np.linalg.norm(full))
    return [
        Figure(3, 'force, adaptive against the law everywhere', abs(force / right - 1), 0.02,
               'at most', '', 1),
        Figure(3, 'field, adaptive against the law everywhere', field, 0.03, 'at most', '', 1),
    ]  # fmt: skip


def yanked() -> list[Figure]:
    """Measure frames that are not finite, and J a second after release, on sliver meshes."""
    outcomes = [torture(seed, rounds=1) for seed in SLIVER_SEEDS]
    bad, frames = (sum(getattr(o, name) for o in outcomes) for name in ('bad', 'frames'))
    away, inverted = max(o.away for o in outcomes), max(o.inverted for o in outcomes)
    return [
        Figure(5, 'frames with a number that is not finite', bad, 0, 'at most', '', frames),
        Figure(5, '|J - 1| a second after release', away, MAX_AWAY, 'at most', '', len(outcomes)),
        Figure(5, 'elements inside out a second after release', inverted, 0, 'at most', '',
               len(outcomes)),
    ]  # fmt: skip


def cost() -> list[Figure]:
    """Measure an evaluation under a dent as the demo's, as a ratio to linear_smoothed."""
    times = {name: _evaluation(name) for name in ('linear_smoothed', 'stiffening')}
    ratio = times['stiffening'] / times['linear_smoothed']
    return [
        Figure(3, 'cost of a force evaluation in a dent', ratio, 1.5, 'at most', '', EVALUATIONS,
               'that of linear_smoothed', f'{1e6 * times["stiffening"]:.0f} us')
    ]  # fmt: skip


def _evaluation(name: ModelName) -> float:
    """Return the median CPU time of a force evaluation [s]."""
    mesh = kuhn_block((20, 20, 8), (0.1, 0.1, 0.04))
    model = ElasticModel(mesh, Material(5400.0, 0.45, 1060.0, stiffening=STIFFENING), name)
    rest = mesh.rest
    depth = 0.006 * np.exp(-np.square(rest - [0.05, 0.05, 0.04]).sum(axis=1) / 0.01**2)
    u = np.stack([0 * depth, 0 * depth, -depth], axis=1).ravel()
    operands, f = model.operands(), np.zeros_like(u)
    times = []
    for _ in range(EVALUATIONS):
        start = time.thread_time()
        internal_force(operands, u, f, 1)
        times.append(time.thread_time() - start)
    return float(np.median(times))
