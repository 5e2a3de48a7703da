"""Gain of two threads in moving all nodes, beside their gain in reading the same bytes.

`./trainer run python -m bench.figures.scale_threads` prints both by model, on a quiet machine.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from bench.accuracy.far_field_session import BRICKS
from bench.accuracy.footprint import MATERIAL, block
from bench.figures.figure import Figure, print_figures
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.parallel_euler import make_integrator

THREADS = 2
_MODELS: tuple[ModelName, ...] = ('linear', 'linear_smoothed')
_TETRAHEDRA, _SEED = 197_472, 21
_ROUNDS, _STEPS = 9, 40
_MIN_SHARE = 0.9
_STEP_S = 1e-5
"""Far below the stable one: the time of a step does not depend on it."""


def measure() -> list[Figure]:
    """Return the figures of line 3."""
    mesh = block(BRICKS[_TETRAHEDRA], _SEED)
    figures = []
    for name in _MODELS:
        model = ElasticModel(mesh, MATERIAL, name)
        arrays = _read_by_a_step(model.operands(), np.zeros((6, 3 * mesh.node_count)))
        size = 1e-6 * sum(array.nbytes for array in arrays)
        with ThreadPoolExecutor(THREADS) as pool:
            stepping, reading = _gains(
                *(_steps(model, threads) for threads in (1, THREADS)),
                *(_reading(arrays, threads, pool) for threads in (1, THREADS)),
            )
        figures.append(
            Figure(
                3,
                f'gain of {THREADS} threads, all nodes of {_TETRAHEDRA} tetrahedra, {name}',
                stepping / reading,
                _MIN_SHARE,
                'at least',
                '',
                _ROUNDS,
                f'their gain in reading the {size:.0f} MB of a step',
                f'{stepping:.2f}, and {reading:.2f}',
            )
        )
    return figures


def _gains(*tasks: Callable[[], object]) -> tuple[float, float]:
    """Return the ratios of the first two and of the last two tasks' times, medians of rounds."""
    times = []
    for number in range(_ROUNDS + 1):
        spent = []
        for task in tasks:
            began = time.perf_counter()
            task()
            spent.append(time.perf_counter() - began)
        if number:  # the first loads kernels and caches
            times.append(spent)
    stepped, shared, read, read_together = np.median(times, axis=0)
    return float(stepped / shared), float(read / read_together)


def _steps(model: ElasticModel, threads: int) -> Callable[[], object]:
    """Return a task: some steps of all nodes."""
    mesh, operands = model.mesh, model.operands()
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    euler = make_integrator('symplectic_euler', MATERIAL.alpha, MATERIAL.beta, threads)
    u, v = np.zeros((2, 3 * mesh.node_count))
    u[:] = 1e-6 * np.random.default_rng(_SEED).standard_normal(len(u))
    given = operands, inverse, model.diagonal, NO_SPRINGS, u, v, _STEP_S, _STEPS
    return lambda: euler.step(*given)


def _read_by_a_step(operands: Operands, vectors: np.ndarray) -> list[np.ndarray]:
    """Return the arrays that a step reads, six of them `vectors`, as whole numbers."""
    rows, domains = operands.rows, operands.domains
    entries = [int((of.start + of.used).max(initial=0)) // 2 * 2 for of in (rows, domains)]
    arrays = [
        *(rows.start, rows.used, rows.columns[: entries[0]], rows.blocks[: 9 * entries[0]]),
        *(rows.diagonal, domains.start, domains.used, domains.columns[: entries[1]]),
        *(domains.vectors[: 3 * entries[1]], domains.volume, *vectors),
    ]
    return [array.view(np.int64) for array in arrays]


@kernel(nogil=True)
def _read(arrays, repeats):
    total = 0
    for _ in range(repeats):
        for array in arrays:
            for number in array:
                total += number
    return total


def _reading(
    arrays: list[np.ndarray], threads: int, pool: ThreadPoolExecutor
) -> Callable[[], object]:
    """Return a task: to read the arrays as often as steps are taken."""
    halves = [np.array_split(array, threads) for array in arrays]
    parts = [tuple(of[number] for of in halves) for number in range(threads)]
    return lambda: list(pool.map(_read, parts, [_STEPS] * threads))


if __name__ == '__main__':
    sys.exit(print_figures(measure()))
