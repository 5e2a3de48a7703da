"""Relaxation after a step of shear, against the exact answer of the series."""

import time

import numpy as np

from bench.accuracy.prony import shear_relaxation
from bench.figures.tissue_relaxation import SIDE, after, block
from bench.validate.case import Result
from cutting_trainer.tissue_sim.elasticity.models import MODELS

SHEAR, TIMES = 0.02, (0.1, 0.5, 2.0)
"""Shear of the step, and seconds after it."""


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
