"""Outputs of a study: one number for each bag and setting."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.score import UNITS, score
from cutting_trainer.recordings.incision_metrics import surface_length
from cutting_trainer.recordings.what_if import Run
from cutting_trainer.tissue_sim.mesh.pieces import free_parts
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh


@dataclass(frozen=True)
class Output:
    """One column of results.

    Attributes:
        unit: of the number; '' for counts.
        meaning: in a few words.
    """

    unit: str
    meaning: str


_SI_UNITS = {'mm': 'm', 'mm/s': 'm/s', 'mm^2': 'm^2', '%': ''}
FIGURES = {
    'largest_force': Output('N', 'largest force on the hand'),
    'mean_force_in_contact': Output('N', 'mean force on the hand in contact'),
    'force_rms_difference': Output('N', 'rms difference to the force of the reference'),
    'largest_force_difference': Output('N', 'largest difference to the force of the reference'),
    'contact': Output('s', 'time in contact'),
    'incision_area': Output('m^2', 'area of the incision, one side, at rest'),
    'incision_length': Output('m', 'length of the incision on the surface, at rest'),
    'pieces': Output('', 'pieces that came off'),
    'elements_cut': Output('', 'tetrahedra taken out by cuts'),
    'tetrahedra': Output('', 'tetrahedra at the end'),
    'substeps': Output('', 'substeps of all frames'),
    'frames_taken_back': Output('', 'frames that diverged and were taken back'),
}
"""Outputs of every bag, by column."""
SCORE = 'exercise.score'
MEASURES = {
    SCORE: Output('', 'points of the exercise'),
    **{
        f'exercise.{name}': Output(_SI_UNITS.get(unit, unit), meaning)
        for name, (_, unit, meaning) in UNITS.items()
    },
}
"""Further outputs of bags of an exercise."""
OUTPUTS = FIGURES | MEASURES
FileName = Literal['force', 'tissue']
"""What a study may keep of each session."""
COMPARED = ('force_rms_difference', 'largest_force_difference')
"""Those that compare with the reference."""


def outputs_of(run: Run, reference: NDArray[np.float64], mesh: TetMesh) -> dict[str, float]:
    """Compute the outputs that every session has.

    Args:
        run: the session.
        reference: norm of the force that it is compared with at each tick [N], shape (n,).
        mesh: tissue at the end.
    """
    off = np.abs(run.forces - reference)
    values = run.figures() | {
        'force_rms_difference': float(np.sqrt(np.mean(off**2))),
        'largest_force_difference': float(off.max(initial=0.0)),
        'incision_length': surface_length(mesh),
        'pieces': float(free_parts(mesh).max(initial=0)),
    }
    return {name: float(values[name]) for name in FIGURES}


def measures_of(attempt: Attempt) -> dict[str, float]:
    """Return score and measures of an attempt, without those that have no value."""
    measures = attempt.measures()
    points = score(attempt.exercise, measures).points
    found = {SCORE: points} | {f'exercise.{name}': value for name, value in measures.items()}
    return {name: float(value) for name, value in found.items() if not math.isnan(value)}
