"""Scene section `exercise`: the task, its zones and the scoring of an attempt."""

from typing import Annotated, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from cutting_trainer.node_common.scene_reader import SceneModel, read_section
from cutting_trainer.node_common.share_folder import SCENES, scene_names

Coordinate = Annotated[float, Field(ge=-2, le=2)]
Point = tuple[Coordinate, Coordinate, Coordinate]
CIRCLE_CORNERS = 72

MeasureName = Literal[
    'time',
    'path_length',
    'economy',
    'mean_speed',
    'jerk',
    'idle',
    'tremor',
    'coverage',
    'excess',
    'depth_error',
    'mean_force',
    'peak_force',
    'force_over',
    'blade_angle',
    'damage',
    'pieces',
    'zones_touched',
    'lesion_margin',
    'marks_found',
    'marks_false',
    'order',
]
MEASURES: tuple[MeasureName, ...] = get_args(MeasureName)


class CircleSettings(SceneModel):
    """A horizontal circle."""

    centre: Point = Field(description='[m]')
    radius: float = Field(gt=0, le=0.5, description='[m]')


class TargetSettings(SceneModel):
    """A curve on the surface that is to be cut: a line through points, or a circle."""

    name: str = Field(min_length=1, description='for messages')
    points: tuple[Point, ...] = Field(
        (), max_length=1000, description='corners of the line, on the surface at rest [m]'
    )
    circle: CircleSettings | None = Field(None, description='a circle instead of points')
    margin: float = Field(
        0.002, gt=0, le=0.1, description='allowed distance from the curve to either side [m]'
    )
    depth: tuple[Annotated[float, Field(ge=0, le=0.2)], Annotated[float, Field(ge=0, le=0.2)]] = (
        Field(description='least and largest depth of the opened tissue under the curve [m]')
    )

    @model_validator(mode='after')
    def _check(self) -> Self:
        if (self.circle is None) == (len(self.points) == 0):
            raise ValueError('a target has either points or a circle: give one of them')
        if self.circle is None and len(self.points) < 2:
            raise ValueError('a line needs two points at least: add one')
        if self.circle is None and not np.diff(self.corners(), axis=0).any(axis=1).all():
            raise ValueError('two points of a line that follow each other are equal: delete one')
        if self.depth[0] >= self.depth[1]:
            raise ValueError(
                f'depth is [{self.depth[0]:g}, {self.depth[1]:g}]: the first must be less'
            )
        return self

    def corners(self) -> NDArray[np.float64]:
        """Return the corners of the curve [m], shape (k, 3); those of a circle are closed."""
        if self.circle is None:
            return np.array(self.points, float)
        angle = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS + 1)
        around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        return np.asarray(self.circle.centre) + self.circle.radius * around


class ZoneSettings(SceneModel):
    """A tube that must not be cut, as a vessel or a nerve: a line through points with a radius."""

    name: str = Field(min_length=1, description='for messages')
    points: tuple[Point, ...] = Field(
        min_length=2, max_length=1000, description='axis of the tube at rest [m]'
    )
    radius: float = Field(gt=0, le=0.1, description='[m]')


class BallSettings(SceneModel):
    """A ball in the tissue at rest."""

    name: str = Field(min_length=1, description='for messages')
    centre: Point = Field(description='[m]')
    radius: float = Field(gt=0, le=0.1, description='[m]')


class MarkSettings(SceneModel):
    """A mark: the tip presses on one place and holds still there."""

    seconds: float = Field(1.0, ge=0.2, le=10, description='how long the tip holds still [s]')
    force: float = Field(0.3, gt=0, le=50, description='force at which it must press [N]')
    radius: float = Field(
        0.001, gt=0, le=0.05, description='radius within which the tip counts as still [m]'
    )


class CriterionSettings(SceneModel):
    """One measure of the score: full marks at `good`, none at `bad`, in proportion between."""

    measure: MeasureName = Field(description='[measure](exercises.md#measures)')
    good: float = Field(description='value with full marks, in SI units')
    bad: float = Field(description='value without any')
    weight: float = Field(1.0, ge=0, le=1000, description='share of the score, before division')
    required: bool = Field(False, description='at bad or beyond it, the attempt fails')

    @model_validator(mode='after')
    def _differ(self) -> Self:
        if self.good == self.bad:
            raise ValueError(f'good and bad are both {self.good:g}: they must differ')
        return self


class ExerciseSettings(SceneModel):
    """Scene section `exercise`; a scene without `title` is none."""

    title: str = Field('', description='name of the exercise; empty: the scene is none')
    instruction: str = Field('', description='text for the trainee')
    targets: tuple[TargetSettings, ...] = Field((), max_length=32)
    ordered: bool = Field(False, description='whether the targets are to be cut in this order')
    zones: tuple[ZoneSettings, ...] = Field((), max_length=32)
    lesion: BallSettings | None = Field(
        None, description='a ball that must come off whole, with tissue around it'
    )
    lumps: tuple[BallSettings, ...] = Field(
        (), max_length=32, description='hidden balls that are to be marked, seen along z'
    )
    mark: MarkSettings = MarkSettings()
    force_limit: float = Field(
        5.0, gt=0, le=100, description='force on the hand that should not be exceeded [N]'
    )
    time_limit: float = Field(300.0, ge=1, le=86400, description='longest duration that passes [s]')
    start: BallSettings | None = Field(
        None, description='where the tip begins: time runs from leaving it'
    )
    end: BallSettings | None = Field(
        None, description='where the tip ends: time runs until it is back there'
    )
    pass_score: float = Field(70.0, gt=0, le=100, description='score that passes, of 100')
    criteria: tuple[CriterionSettings, ...] = Field((), max_length=len(MEASURES))

    @model_validator(mode='after')
    def _check(self) -> Self:
        if not self.title:
            if self.targets or self.lumps or self.lesion or self.criteria:
                raise ValueError('an exercise needs a title: add one')
            return self
        if not (self.targets or self.lumps or self.lesion):
            raise ValueError('an exercise needs targets, lumps or a lesion: add one of them')
        if not sum(criterion.weight for criterion in self.criteria) > 0:
            raise ValueError('the weights of criteria must not all be 0: add a criterion')
        names = [criterion.measure for criterion in self.criteria]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice:
            raise ValueError(f'the measure {twice} is in criteria twice: delete one')
        needs = {
            'lesion_margin': (self.lesion, 'a lesion'),
            'marks_found': (self.lumps, 'lumps'),
            'marks_false': (self.lumps, 'lumps'),
            'coverage': (self.targets, 'targets'),
            'depth_error': (self.targets, 'targets'),
            'zones_touched': (self.zones, 'zones'),
        }
        for name, (given, words) in needs.items():
            if name in names and not given:
                raise ValueError(f'the measure {name} needs {words}: add them or delete it')
        return self


def exercise_titles() -> dict[str, str]:
    """Return the titles of the exercises that come with the trainer, by scene."""
    titles = {}
    for name in scene_names():
        section = read_section(SCENES / f'{name}.yaml', 'exercise', ExerciseSettings)
        if title := section.title:
            titles[name] = title
    return titles
