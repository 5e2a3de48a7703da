"""Relaxation after a step of shear, and creep under a weight, against the series' exact answers."""

import time

import numpy as np

from bench.accuracy.prony import series_of_creep, shear_relaxation, uniaxial_creep
from bench.figures.tissue_relaxation import SIDE, after, block, pulled
from bench.validate.case import Result
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.models import MODELS

SHEAR, TIMES = 0.02, (0.1, 0.5, 2.0)
"""Shear of the step, and seconds after it."""
RETARDATION = (1.86, 51.3)
"""Published time constants of porcine liver under a constant load [s]."""
GROWTHS = (0.5, 0.5)
"""Growth of the strain by each of them, relative to the first strain: chosen, not published."""
CREEP_FRAMES = (60, 300, 1500)
"""Frames at 30 Hz after which the strain is compared."""


def run_relaxation(quick: bool) -> list[Result]:
    """Return what is left of the force after some times."""
    results = []
    for model in MODELS:
        dynamics, last = block(model), 0.0
        count = len(dynamics.mesh.tetrahedra)
        top = dynamics.mesh.rest[:, 2] > SIDE - 1e-9
        first = after(dynamics, SHEAR, 0.0)[top, 0].sum()
        for moment in TIMES:
            start = time.thread_time()
            found = float(after(dynamics, SHEAR, moment - last)[top, 0].sum() / first)
            cpu = time.thread_time() - start
            exact = float(shear_relaxation(dynamics.material, np.array([moment]))[0])
            name = f'force over the first, after {moment:g} s'
            results.append(Result(name, model, count, '', exact, found, found / exact - 1, cpu))
            last = moment
    return results


def run_creep(quick: bool) -> list[Result]:
    """Return the growth of the strain under a constant load.

    The nodes slide in planes, for which the mass of `stiffening` has no place. Its small strains
    are those of `linear_smoothed`.
    """
    results = []
    for model in MODELS:
        if model == 'stiffening':
            continue
        dynamics, lengthened = pulled(model, 'implicit', series_of_creep(GROWTHS, RETARDATION))
        count, start = len(dynamics.mesh.tetrahedra), time.thread_time()
        for frame in range(1, CREEP_FRAMES[-1] + 1):
            dynamics.advance(Coupling())
            if frame not in CREEP_FRAMES:
                continue
            found, cpu = lengthened(), time.thread_time() - start
            exact = float(uniaxial_creep(dynamics.material, np.array([frame / 30]))[0])
            name = f'strain over the first, after {frame / 30:g} s'
            results.append(Result(name, model, count, '', exact, found, found / exact - 1, cpu))
    return results
