"""Progress of an attempt at the exercise: measures during it, the score at its end."""

import time
from typing import Any

import numpy as np

from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.scene_schema import ExerciseSettings, MeasureName
from cutting_trainer.exercises.score import UNITS, in_words, score
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.viewer.tool_state import Moment

PERIOD_S = 0.5
"""[s] between two reports."""
_MAX_LOAD = 0.05
"""Largest share of one processor: a report takes longer as the attempt grows."""
_MAX_REASONS = 6
_LAST_FRAMES = 6
"""Frames of the tissue after the end of the motion until the last cut is in the mesh: its sweep,
the end of its stroke, and the answer to each take one, and two may be under way."""


class AttemptProgress:
    """Follows an attempt by the samples of the page, up to 30 times a second.

    Its peak of the force is that of these samples: a shorter peak is in the bag alone.

    Args:
        exercise: with a title.
    """

    def __init__(self, exercise: ExerciseSettings) -> None:
        self._exercise = exercise
        self._begin()

    def _begin(self) -> None:
        self._attempt = Attempt(self._exercise)
        self._motion: list[np.ndarray] = []
        self._forces: list[tuple[float, float]] = []
        self._step = self._topology = -1
        self._over_at: int | None = None
        self._next = 0.0

    def see(self, now: float, replica: MeshReplica, moment: Moment) -> dict[str, Any] | None:
        """Take one sample; return the content of the message `attempt` when it is due.

        Args:
            now: [s], monotonic.
            replica: of the tissue; an older frame than before is of a new tissue, and attempt.
            moment: of the tool, finite.
        """
        if replica.step < self._step:
            self._begin()
        self._step = replica.step
        self._motion.append(np.array([now, *moment.tip, *moment.blade.ravel(), moment.contact]))
        self._forces.append((now, float(np.linalg.norm(moment.force))))
        if now < self._next:
            return None
        began = time.thread_time()
        content = self._report(now, replica)
        self._next = now + max(PERIOD_S, (time.thread_time() - began) / _MAX_LOAD)
        return content

    def _report(self, now: float, replica: MeshReplica) -> dict[str, Any]:
        attempt = self._attempt
        attempt.add_motion(np.array(self._motion))
        attempt.add_forces(np.array(self._forces))
        self._motion, self._forces = [], []
        if replica.topology != self._topology:
            self._topology = replica.topology
            attempt.see_tissue(now, replica)
        measures = attempt.measures()
        if not attempt.over:  # or no more: the tip has touched again
            self._over_at = None
        elif self._over_at is None:
            self._over_at = replica.step
        found = None
        if self._over_at is not None and replica.step >= self._over_at + _LAST_FRAMES:
            result = score(self._exercise, measures)
            found = {
                'points': f'{result.points:.1f}',
                'passed': result.passed,
                'reasons': result.reasons[:_MAX_REASONS],
            }
        bridge = None
        if attempt.bridge is not None:
            bridge = replica.positions()[list(attempt.bridge)].mean(axis=0).tolist()
        return {'rows': self._rows(measures), 'score': found, 'bridge': bridge}

    def _rows(self, measures: dict[MeasureName, float]) -> list[dict[str, Any]]:
        """Return name, value and whether it is beyond its limit, of what the trainee may know."""
        exercise = self._exercise

        def row(measure: MeasureName, limit: float = np.inf) -> dict[str, Any]:
            value = measures[measure]
            return {
                'name': UNITS[measure][2],
                'value': in_words(measure, value),
                'over': bool(value > limit),
            }

        rows = [row('time', exercise.time_limit)]
        if exercise.targets:
            rows += [row('coverage'), row('excess')]
        if exercise.zones:
            rows.append(row('zones_touched', 0.0))
        if exercise.lumps:  # whether they are right is not told before the end
            marks = str(len(self._attempt.marks()))
            rows.append({'name': 'marks', 'value': marks, 'over': False})
        return [*rows, row('peak_force', exercise.force_limit)]
