"""Measures of an attempt: one implementation for the page during it and for the bag after it.

`Attempt` takes batches of samples and meshes as they come. Its measures depend on the samples, not
on how they were batched, and are the same bits on every run. docs/exercises.md has the formulas.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.motion import (
    RATE_HZ,
    holds,
    idle_share,
    log_dimensionless_jerk,
    resampled,
    smoothed,
    tremor,
)
from cutting_trainer.exercises.opened_tissue import (
    Coverage,
    Curve,
    Opened,
    Tissue,
    bridge,
    cut_faces,
    free_pieces,
    lesion_margin,
    zones_touched,
)
from cutting_trainer.exercises.scene_schema import MEASURES, ExerciseSettings, MeasureName
from cutting_trainer.tissue_sim.contact.tool import ContactState

Floats = NDArray[np.float64]
NAN = float('nan')
_BEGUN = 0.1
"""Opened share of a target from which it counts as begun."""
_NEARLY = 0.9
"""Opened share of the targets from which a bridge that still holds the lesion is looked for."""


class Attempt:
    """Accumulates an attempt at an exercise.

    Args:
        exercise: its settings.
    """

    def __init__(self, exercise: ExerciseSettings) -> None:
        self.exercise = exercise
        self._curves = [Curve(target) for target in exercise.targets]
        self._motion = [np.zeros((0, 11))]
        self._forces = [np.zeros((0, 2))]
        self._begun: dict[int, float] = {}
        self._coverage: list[Coverage] = []
        self._opened = Opened(np.zeros((0, 3)), np.zeros(0))
        self._touched: list[str] = []
        self._pieces = 0
        self._margin = NAN
        self._bridge: tuple[int, int] | None = None

    def add_motion(self, samples: Floats) -> None:
        """Add samples of the tool.

        Args:
            samples: time [s], tip [m], blade root and tip [m], contact state, shape (n, 11).
        """
        self._motion.append(np.array(samples, float).reshape(-1, 11))

    def add_forces(self, samples: Floats) -> None:
        """Add samples of the force on the hand: time [s] and norm [N], shape (n, 2)."""
        self._forces.append(np.array(samples, float).reshape(-1, 2))

    def see_tissue(self, time: float, tissue: Tissue) -> None:
        """Measure the opened tissue; to be called when the connectivity has changed.

        Args:
            time: [s].
            tissue: mesh now.
        """
        exercise = self.exercise
        self._opened = opened = cut_faces(tissue)
        self._coverage = [curve.coverage(opened) for curve in self._curves]
        for number, coverage in enumerate(self._coverage):
            if coverage.opened >= _BEGUN:
                self._begun.setdefault(number, time)
        self._touched = zones_touched(opened, exercise.zones)
        self._pieces = free_pieces(tissue)
        if exercise.lesion:
            self._margin = lesion_margin(tissue, exercise.lesion)
            nearly = bool(self._curves) and self._coverage_of_all() >= _NEARLY
            self._bridge = bridge(tissue, exercise.lesion, exercise.targets) if nearly else None

    @property
    def zones_touched(self) -> tuple[str, ...]:
        """Names of the forbidden zones that cut faces reach into."""
        return tuple(self._touched)

    @property
    def bridge(self) -> tuple[int, int] | None:
        """Nodes of the edge by which tissue still holds a lesion that is nearly cut out."""
        return self._bridge

    @property
    def coverage(self) -> tuple[Coverage, ...]:
        """Opened tissue along each target."""
        return tuple(self._coverage)

    def measures(self) -> dict[MeasureName, float]:
        """Return all measures in SI units; NaN where there is none."""
        values: dict[MeasureName, float] = dict.fromkeys(MEASURES, NAN)
        motion, forces = self._during()
        values.update(self._of_motion(motion))
        values.update(self._of_forces(motion, forces))
        values.update(self._of_tissue())
        values.update(self._of_marks(motion, forces))
        return values

    @property
    def over(self) -> bool:
        """Whether the tip touched tissue and is back at the end, or the time limit is over."""
        return self._is_back() is True or self._late

    @property
    def broken_off(self) -> bool:
        """Whether the tip touched tissue, and the samples ended before the attempt was over."""
        return self._is_back() is False and not self._late

    @property
    def _late(self) -> bool:
        motion, _ = self._during()
        return len(motion) > 0 and bool(np.ptp(motion[:, 0]) > self.exercise.time_limit)

    def _is_back(self) -> bool | None:
        """Return whether the tip is back at the end; None: no end, or nothing was touched."""
        motion = _joined(self._motion)
        touched = np.flatnonzero(motion[:, 10] > 0)
        if self.exercise.end is None or not len(touched):
            return None
        return self._back(motion, touched[-1]) is not None

    def marks(self) -> Floats:
        """Return the places that were marked [m], shape (h, 3)."""
        return self._marks(*self._during())

    def _during(self) -> tuple[Floats, Floats]:
        """Return motion and forces from the start of the clock to its end."""
        motion, forces = _joined(self._motion), _joined(self._forces)
        if not len(motion):
            return motion, forces
        exercise = self.exercise
        moved = np.linalg.norm(motion[:, 1:4] - motion[0, 1:4], axis=1) > 1e-3
        started = moved
        if exercise.start:
            off = np.linalg.norm(motion[:, 1:4] - exercise.start.centre, axis=1)
            started = off > exercise.start.radius
        waited = motion[:, 0] - motion[0, 0] > exercise.time_limit
        if not (started | waited).any():
            return motion[:0], forces[:0]
        # Who does not begin within the limit has used it up.
        first = 0 if waited[started.argmax()] or not started.any() else int(started.argmax())
        late = motion[:, 0] - motion[first, 0] > exercise.time_limit
        last = int(late.argmax()) if late.any() else len(motion) - 1
        touched = np.flatnonzero(motion[: last + 1, 10] > 0)
        if exercise.end and len(touched):
            back = self._back(motion[: last + 1], touched[-1])
            last = last if back is None else back
        motion = motion[first : last + 1]
        within = (forces[:, 0] >= motion[0, 0]) & (forces[:, 0] <= motion[-1, 0])
        return motion, forces[within]

    def _back(self, motion: Floats, touched: int) -> int | None:
        """Return the sample of the return to the end after the last touch; None: there is none."""
        end = self.exercise.end
        assert end is not None
        off = np.linalg.norm(motion[touched:, 1:4] - end.centre, axis=1)
        back = np.flatnonzero(off <= end.radius)
        return int(touched + back[0]) if len(back) else None

    def _of_motion(self, motion: Floats) -> dict[MeasureName, float]:
        if len(motion) < 2:
            return {'time': 0.0, 'path_length': 0.0}
        path = resampled(motion[:, 0], motion[:, 1:4])
        slow = smoothed(path)
        length = float(np.linalg.norm(np.diff(slow, axis=0), axis=1).sum())
        time = float(motion[-1, 0] - motion[0, 0])
        inside = motion[:, 10] == ContactState.INSIDE
        blade = motion[inside, 4:7] - motion[inside, 7:10]
        norm = np.maximum(np.linalg.norm(blade, axis=1), 1e-12)
        tilt = np.degrees(np.arccos(np.clip(blade[:, 2] / norm, -1, 1)))
        ideal = sum(curve.length for curve in self._curves)
        return {
            'time': time,
            'path_length': length,
            'economy': ideal / length if ideal and length else NAN,
            'mean_speed': length / time,
            'jerk': log_dimensionless_jerk(slow),
            'idle': idle_share(slow),
            'tremor': tremor(path),
            'blade_angle': float(tilt.mean()) if len(tilt) else NAN,
        }

    def _of_forces(self, motion: Floats, forces: Floats) -> dict[MeasureName, float]:
        if not len(forces) or not len(motion):
            return {'peak_force': 0.0, 'force_over': 0.0}
        at = np.clip(np.searchsorted(motion[:, 0], forces[:, 0], 'right') - 1, 0, None)
        touched = motion[at, 10] > 0
        steps = np.diff(forces[:, 0], append=forces[-1, 0])
        over = forces[:, 1] > self.exercise.force_limit
        return {
            'mean_force': float(forces[touched, 1].mean()) if touched.any() else NAN,
            'peak_force': float(forces[:, 1].max()),
            'force_over': float(steps[over].sum()),
        }

    def _of_tissue(self) -> dict[MeasureName, float]:
        values: dict[MeasureName, float] = {
            'pieces': float(self._pieces),
            'zones_touched': float(len(self._touched)),
            'lesion_margin': self._margin,
        }
        areas = self._opened.areas
        total = float(areas.sum())
        needed = np.zeros(len(areas), bool)
        for coverage in self._coverage:
            needed |= coverage.near
        values['damage'] = float(areas[~needed].sum())
        if not self._curves:
            return values
        if total > 0:
            values['excess'] = values['damage'] / total
        values['coverage'] = self._coverage_of_all()
        weight = self._opened_lengths()
        if weight.any():
            errors = np.array([c.depth_error for c in self._coverage])
            values['depth_error'] = float(
                np.average(errors[weight > 0], weights=weight[weight > 0])
            )
        values['order'] = self._order()
        return values

    def _opened_lengths(self) -> Floats:
        """Return the opened length of each target [m], shape (k,)."""
        lengths = [curve.length for curve in self._curves]
        shares = [coverage.opened for coverage in self._coverage] or [0.0] * len(lengths)
        return np.multiply(shares, lengths)

    def _coverage_of_all(self) -> float:
        """Return the opened share of the length of all targets."""
        return float(self._opened_lengths().sum() / sum(curve.length for curve in self._curves))

    def _order(self) -> float:
        """Return the share of steps from a target to the next that were begun in order."""
        pairs = len(self._curves) - 1
        if pairs < 1:
            return 1.0
        begun = [self._begun.get(number, math.inf) for number in range(pairs + 1)]
        right = sum(math.isfinite(b) and a <= b for a, b in pairwise(begun))
        return right / pairs

    def _of_marks(self, motion: Floats, forces: Floats) -> dict[MeasureName, float]:
        lumps = self.exercise.lumps
        if not lumps:
            return {}
        marks = self._marks(motion, forces)
        centres = np.array([lump.centre for lump in lumps])[:, :2]
        radii = np.array([lump.radius for lump in lumps])
        off = np.linalg.norm(marks[:, None, :2] - centres[None], axis=2)
        hit = off <= radii
        return {
            'marks_found': float(hit.any(axis=0).mean()) if len(marks) else 0.0,
            'marks_false': float((~hit.any(axis=1)).sum()),
        }

    def _marks(self, motion: Floats, forces: Floats) -> Floats:
        mark = self.exercise.mark
        if len(motion) < 2 or not len(forces):
            return np.zeros((0, 3))
        path = resampled(motion[:, 0], motion[:, 1:4])
        times = motion[0, 0] + np.arange(len(path)) / RATE_HZ
        pressed = np.interp(times, forces[:, 0], forces[:, 1]) >= mark.force
        return holds(times, path, pressed, mark.seconds, mark.radius)


def _joined(batches: list[Floats]) -> Floats:
    """Return all samples in one array, which takes the place of the batches."""
    if len(batches) > 1:
        batches[:] = [np.concatenate(batches)]
    return batches[0]
