"""Figures of the far field, 51,744 tetrahedra, against the same sessions with all nodes moving."""

import time

import numpy as np

from bench.accuracy.far_field_session import (
    BRICKS,
    FRAMES,
    PALPATED,
    PHASES,
    Errors,
    FarFieldSession,
    Floats,
    prepared,
)
from bench.accuracy.footprint import MATERIAL, block
from bench.figures.figure import Figure
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName, internal_force
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings

TETRAHEDRA, NODES = 51_744, 300
_SEED, _PLACE = 21, (0.044, 0.056)
"""Of the block, and x and y of the first touch [m]; nothing was chosen by them."""
_CUT: ModelName = 'linear'
_PALPATED: ModelName = 'linear_smoothed'
"""The blade cuts steadily in the linear model alone; the smoothed one is palpated, too."""
MAX_ERROR = 0.05
MAX_FRAME = 47.0
"""Evaluations: 22 ms where one takes 0.47 ms, as on an AMD EPYC (Zen 4) without other load."""
_EVALUATIONS = 40
"""Before each session."""


def measure() -> list[Figure]:
    """Return the figures of line 1."""
    prepared()
    active = ActiveSettings('budget', NODES)
    evaluation, times = _Evaluation(), np.zeros(0)
    found: dict[str, list[Errors]] = {name: [] for name in PHASES}
    for model, frames in ((_CUT, FRAMES), (_PALPATED, PALPATED.end)):
        session = FarFieldSession(TETRAHEDRA, _SEED, _PLACE, model)
        exact = session.run(ActiveSettings(), frames=frames)
        evaluation.sample()
        course = session.run(active, exact, frames)
        evaluation.sample()
        for name, phase in PHASES.items():
            if phase.end <= frames:
                found[name].append(session.errors(course, exact, phase))
        times = course.times if model == _CUT else times
    return [*_errors(found), _frame(times, evaluation)]


def _errors(found: dict[str, list[Errors]]) -> list[Figure]:
    figures = []
    for name, phase in PHASES.items():
        some = found[name]
        count = len(some) * (phase.end - phase.first)
        if phase.rests >= 0:
            soft = max(errors.compliance for errors in some)
            figures.append(_error(f'compliance, {name}', soft, len(some)))
        figures.append(_error(f'worst node, {name}', max(e.worst for e in some), count))
        figures.append(_error(f'tool force, {name}, rms', max(e.force for e in some), count))
    return figures


def _error(name: str, value: float, samples: int) -> Figure:
    return Figure(1, f'{name}, {NODES} free nodes', value, MAX_ERROR, 'at most', '', samples)


class _Evaluation:
    """Time of the force on all elements, sampled beside the sessions."""

    def __init__(self) -> None:
        mesh = block(BRICKS[TETRAHEDRA], _SEED)
        self._operands = ElasticModel(mesh, MATERIAL, 'linear_smoothed').operands()
        self._u, self._f = np.zeros((2, 3 * mesh.node_count))
        self._times: list[float] = []

    def sample(self) -> None:
        """Time some evaluations."""
        for _ in range(_EVALUATIONS):
            began = time.thread_time()
            internal_force(self._operands, self._u, self._f, 1)
            self._times.append(time.thread_time() - began)

    @property
    def median(self) -> float:
        """Median [s]."""
        return float(np.median(self._times))


def _frame(times: Floats, evaluation: _Evaluation) -> Figure:
    late = float(np.percentile(times, 99))
    return Figure(
        1,
        'frame of palpation and cut, the slowest but one in a hundred',
        late / evaluation.median,
        MAX_FRAME,
        'at most',
        '',
        FRAMES,
        f'the force of linear_smoothed on {TETRAHEDRA} tetrahedra',
        f'{1e3 * late:.1f} ms, and {1e3 * evaluation.median:.2f} ms',
    )
