"""Figures of the far field, against the same sessions with all nodes moving."""

import math
import time
from typing import NamedTuple

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
from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings

_SEED, _PLACE = 21, (0.044, 0.056)
"""Of the block, and x and y of the first touch [m]; nothing was chosen by them."""


class _Case(NamedTuple):
    """A session.

    Attributes:
        tetrahedra: of the block.
        nodes: free ones of the far field.
        model: of the tissue; the blade cuts steadily in the linear one alone.
        frames: of the session.
    """

    tetrahedra: int
    nodes: int
    model: ModelName
    frames: int


_TIMED = _Case(51_744, 300, 'linear', FRAMES)
_CASES = (
    _TIMED,
    _Case(51_744, 300, 'linear_smoothed', PALPATED.end),
    _Case(197_472, 500, 'linear', PALPATED.end),
)
MAX_ERROR = 0.05
MAX_FRAME = 47.0
"""Evaluations: 22 ms where one takes 0.47 ms, as on an AMD EPYC (Zen 4) without other load."""
_EVALUATIONS = 40
"""Before and after a session."""


def measure() -> list[Figure]:
    """Return the figures of line 1."""
    prepared()
    evaluation, figures = _Evaluation(_TIMED.tetrahedra), []
    for case in _CASES:
        session = FarFieldSession(case.tetrahedra, _SEED, _PLACE, case.model)
        exact = session.run(ActiveSettings(), frames=case.frames)
        evaluation.sample()
        course = session.run(ActiveSettings('budget', case.nodes), exact, case.frames)
        evaluation.sample()
        for name, phase in PHASES.items():
            if phase.end <= case.frames:
                errors = session.errors(course, exact, phase)
                figures += _errors(name, case, errors, phase.end - phase.first)
        if case is _TIMED:
            times = course.times
    return [*figures, _frame(times, evaluation)]


def _errors(name: str, case: _Case, errors: Errors, frames: int) -> list[Figure]:
    found = [('worst node', errors.worst, frames), ('tool force, rms', errors.force, frames)]
    if not math.isnan(errors.compliance):
        found.append(('compliance', errors.compliance, 1))
    tissue = f'{case.model}, {case.nodes} free nodes of {case.tetrahedra} tetrahedra'
    return [
        Figure(1, f'{quantity}, {name}; {tissue}', value, MAX_ERROR, 'at most', '', samples)
        for quantity, value, samples in found
    ]


class _Evaluation:
    """Time of the force on all elements, sampled beside the sessions."""

    def __init__(self, tetrahedra: int) -> None:
        mesh = block(BRICKS[tetrahedra], _SEED)
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
        f'the force of linear_smoothed on {_TIMED.tetrahedra} tetrahedra',
        f'{1e3 * late:.1f} ms, and {1e3 * evaluation.median:.2f} ms',
    )
