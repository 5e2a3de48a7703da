"""Section `tissue` of a scene file."""

import math
from collections.abc import Container
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from cutting_trainer.node_common.scene_reader import SceneModel, ScenePath
from cutting_trainer.tissue_sim.contact.blade_constants import BladeConstants
from cutting_trainer.tissue_sim.contact.friction import Friction
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.material_presets import PRESETS, PresetName
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.planner.budget import Budget

UNIT_SCALE = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}
"""Metres per unit of a mesh file."""

AXES = ('x', 'y', 'z')


def _as_tuple(values: object) -> object:
    """Return a list as a tuple: below a validator of a mapping, only that is read as one."""
    return tuple(values) if isinstance(values, list) else values


Coordinate = Annotated[float, Field(ge=-2, le=2)]
Stretch = Annotated[float, Field(ge=-0.3, le=0.3)]
Acceleration = Annotated[float, Field(ge=-30, le=30)]
Relaxing = Annotated[float, Field(gt=0, le=0.95)]
MAX_REGIONS = 32
"""Of a mesh, with a material of their own."""
RelaxationTime = Annotated[float, Field(ge=0.005, le=1e4)]
PronyTerm = Annotated[tuple[Relaxing, RelaxationTime], BeforeValidator(_as_tuple)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class MaterialSettings(SceneModel):
    """An isotropic elastic solid: a preset, single values, or a preset with some replaced.

    `material_presets.py` has the named materials and the source of each number.
    """

    preset: PresetName | None = Field(
        default=None, description='named material that fills in the values not given here'
    )
    youngs_modulus: float = Field(
        ge=10,
        le=1e7,
        description="Young's modulus [Pa], 10 to 1e7; with prony that of the first moment",
    )
    poissons_ratio: float = Field(
        ge=0,
        lt=0.5,
        description="Poisson's ratio [-], 0 to below 0.5; near it linear elements lock",
    )
    density: float = Field(ge=100, le=20000, description='mass density [kg/m^3], 100 to 20000')
    toughness: float = Field(
        default=200.0, ge=0, le=1e5, description='fracture toughness [J/m^2], 0 to 1e5'
    )
    stiffening: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description='b of the law exp(b x) of the model stiffening [-], 0 to 100; 0: neo-Hookean',
    )
    prony: Annotated[tuple[PronyTerm, ...], BeforeValidator(_as_tuple)] = Field(
        default=(),
        max_length=2,
        description='viscosity: up to two terms [g, tau]: share of the shear modulus that relaxes '
        '(in sum up to 0.95) and its time [s] from 0.005 up to 1e4',
    )
    blade_friction: float = Field(
        default=20.0,
        ge=0,
        le=1e4,
        description='friction on the blade by length of edge in the tissue [N/m], 0 to 1e4',
    )
    crack_length: float = Field(
        default=0.0,
        ge=0,
        le=0.02,
        description='length by which a crack runs at once before the blade, so that the force is a '
        'sawtooth around its steady value; 0: it runs steadily [m], 0 to 0.02',
    )

    friction: float = Field(
        default=0.0,
        ge=0,
        le=2,
        description='dry friction of the tool on the surface: tangential over normal force [-], 0 '
        'to 2',
    )
    static_friction_ratio: float = Field(
        default=1.0,
        ge=1,
        le=3,
        description='static over sliding friction [-], 1 to 3',
    )

    @property
    def dry_friction(self) -> Friction:
        """The friction of the tool on the surface."""
        return Friction(self.friction, self.static_friction_ratio)

    @model_validator(mode='after')
    def _check_prony(self) -> Self:
        relaxing = sum(share for share, _ in self.prony)
        if relaxing > 0.95:
            raise ValueError(
                f'the terms of prony relax {relaxing:.3g} of the shear modulus; at most 0.95 may '
                'relax, so that the tissue holds its shape'
            )
        return self

    @model_validator(mode='before')
    @classmethod
    def _fill_in_preset(cls, values: Any) -> Any:
        return _with_preset(values, cls.model_fields)


def _with_preset(values: Any, fields: Container[str]) -> Any:
    """Return the values with those of their preset that are absent, as far as there are fields."""
    preset = values.get('preset') if isinstance(values, dict) else None
    if not isinstance(preset, str):
        return values
    if preset not in PRESETS:
        known = ', '.join(map(repr, PRESETS))
        raise ValueError(f'preset {preset!r} is not known: there are {known}')
    return {k: v for k, v in PRESETS[preset].values.items() if k in fields} | values


class RegionSettings(SceneModel):
    """A region of the mesh with a material of its own; what is absent is as in `material`.

    Poisson's ratio, stiffening, viscosity and dry friction are those of `material`, also beside a
    preset.
    """

    label: int = Field(
        ge=-(2**31),
        lt=2**31,
        description='its number in the mesh file [-]: physical group of Gmsh, medit:ref, or cell '
        'data of the name cell_tags, region or label',
    )
    preset: PresetName | None = Field(
        default=None, description='named material that fills in the values not given here'
    )
    youngs_modulus: float | None = Field(
        default=None, ge=10, le=1e7, description="Young's modulus [Pa], 10 to 1e7"
    )
    density: float | None = Field(
        default=None, ge=100, le=20000, description='mass density [kg/m^3], 100 to 20000'
    )
    toughness: float | None = Field(
        default=None, ge=0, le=1e5, description='fracture toughness [J/m^2], 0 to 1e5'
    )
    blade_friction: float | None = Field(
        default=None,
        ge=0,
        le=1e4,
        description='friction on the blade by length of edge in the tissue [N/m], 0 to 1e4',
    )

    @model_validator(mode='before')
    @classmethod
    def _fill_in_preset(cls, values: Any) -> Any:
        return _with_preset(values, cls.model_fields)


class Damping(SceneModel):
    """Rayleigh damping, C = alpha M + beta K."""

    alpha: float = Field(
        default=10.0, ge=0, le=1e4, description='damping in proportion to mass [1/s], 0 to 1e4'
    )
    beta: float = Field(
        default=5e-4,
        ge=0,
        le=0.1,
        description='damping in proportion to stiffness [s], 0 to 0.1; shortens the stable step',
    )


class Box(SceneModel):
    """An axis-parallel box in the tissue frame."""

    min: Point = Field(description='corner with the least coordinates [m], each -2 to 2')
    max: Point = Field(description='corner with the largest coordinates [m], each -2 to 2')

    @model_validator(mode='after')
    def _check_order(self) -> Self:
        for axis, low, high in zip(AXES, self.min, self.max, strict=True):
            if low > high:
                raise ValueError(f'{axis} of min is {low}, above {high} of max: exchange them')
        return self


class HalfSpace(SceneModel):
    """All points at or below a value of one coordinate."""

    axis: Literal['x', 'y', 'z'] = Field(description='coordinate that is compared: x, y or z')
    value: Coordinate = Field(description='its largest value [m], -2 to 2')


class FixedRegion(SceneModel):
    """A box or half space; nodes with their rest position in it do not move."""

    box: Box | None = Field(default=None, description='box with min and max [m]')
    below: HalfSpace | None = Field(default=None, description='half space with axis and value [m]')

    @model_validator(mode='after')
    def _check_one(self) -> Self:
        if (self.box is None) == (self.below is None):
            raise ValueError('give one of box (min, max) and below (axis, value), and not both')
        return self

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points lie in the region, boundary included.

        Args:
            points: [m], shape (n, 3).

        Returns:
            shape (n,).
        """
        if self.box is not None:
            inside = (points >= np.array(self.box.min)) & (points <= np.array(self.box.max))
            return np.asarray(inside.all(axis=1))
        assert self.below is not None
        return np.asarray(points[:, AXES.index(self.below.axis)] <= self.below.value)


class Integration(SceneModel):
    """Time integration of a frame."""

    rate: float = Field(default=30.0, ge=1, le=240, description='frames a second [Hz], 1 to 240')
    safety: float = Field(
        default=0.8,
        ge=0.01,
        le=1,
        description='share of the stable step that is used [-], 0.01 to 1',
    )
    frequency_growth: float = Field(
        default=3.0,
        ge=0.3,
        le=1000,
        description='how far cuts may raise the highest frequency before small nodes get more '
        'mass; below 1 those of the mesh do too, for longer steps [-], 0.3 to 1000',
    )
    min_substeps: int = Field(
        default=1,
        ge=1,
        le=1000,
        description='substeps of a frame at least [-], 1 to 1000; the accuracy of implicit',
    )
    max_substeps: int = Field(
        default=200, ge=1, le=10000, description='substeps of a frame at most [-], 1 to 10000'
    )

    @model_validator(mode='after')
    def _check_order(self) -> 'Integration':
        if self.min_substeps > self.max_substeps:
            raise ValueError(
                f'min_substeps {self.min_substeps} is above max_substeps {self.max_substeps}: '
                'exchange them, or raise max_substeps'
            )
        return self


class ActiveRegionSettings(SceneModel):
    """Active region: nodes at rest are not integrated."""

    mode: Literal['off', 'on', 'budget'] = Field(
        default='off',
        description='off: all nodes move; on: those that forces or neighbours move; budget: the '
        'nodes nearest to the tool, and all others by a coarse grid',
    )
    nodes: int = Field(
        default=2000,
        ge=1,
        le=10**7,
        description='how many move on their own with budget [-], 1 to 1e7',
    )
    tolerance: float = Field(
        default=1e-4,
        gt=0,
        le=1,
        description='speed below which a node may sleep [m/s], above 0 to 1',
    )


class TissueSettings(SceneModel):
    """Section `tissue` of a scene."""

    mesh: ScenePath = Field(
        description='file of tetrahedra that meshio reads, relative to the scene'
    )
    unit: Literal['m', 'cm', 'mm'] = Field(default='m', description='unit of the mesh file')
    material: MaterialSettings = Field(
        description='preset, or youngs_modulus, poissons_ratio and density'
    )
    regions: tuple[RegionSettings, ...] = Field(
        default=(),
        max_length=MAX_REGIONS,
        description='regions with a material of their own, up to 32; values absent here, and '
        "Poisson's ratio, stiffening, prony and dry friction, are those of `material`, which "
        'should be that of the surface under the tool',
    )
    damping: Damping = Field(default=Damping(), description='alpha [1/s] and beta [s]')
    fixed: tuple[FixedRegion, ...] = Field(
        min_length=1, description='regions whose nodes do not move, at least one'
    )
    stretch: tuple[Stretch, Stretch, Stretch] = Field(
        default=(0.0, 0.0, 0.0),
        description='pre-strain of the fixed nodes along x, y, z [-], -0.3 to 0.3: the tension '
        'under which a cut opens',
    )
    gravity: tuple[Acceleration, Acceleration, Acceleration] = Field(
        default=(0.0, 0.0, 0.0),
        description='acceleration of gravity along x, y, z [m/s^2], each -30 to 30; the session '
        'begins at rest under it; 0: none',
    )
    cut_threshold: float = Field(
        default=0.5,
        gt=0,
        le=100,
        description='contact force that lets the blade in, unless tip_width does [N], above 0 to '
        '100',
    )
    tip_width: float = Field(
        default=0.0,
        ge=0,
        le=0.01,
        description='width w of the slit that the tip of the blade opens [m], 0 to 0.01; it goes '
        'in where the work of the dent reaches toughness times w times its depth, then resists by '
        'toughness times w. To enter at a force F choose F / (2.5 toughness). 0: it goes in by '
        'cut_threshold, and its tip resists by nothing',
    )
    method: Literal['given', 'auto'] = Field(
        default='given',
        description='given: model and integrator of the scene; auto: the cheapest that meet its '
        'budget, else those of the scene',
    )
    model: ModelName = Field(
        default='linear_smoothed',
        description='linear: tensor-mass; linear_smoothed: nodal smoothing, against locking; '
        'corotational: elements turn with the tissue; corotational_smoothed: both; '
        'stiffening: linear_smoothed, and a stiffening law where strain or rotation needs it',
    )
    contact: ContactName = Field(
        default='footprint',
        description='footprint: loads what the sphere touches, whatever the size of the elements; '
        'triangle: loads the corners of the touched triangles, as older sessions did',
    )
    integrator: IntegratorName = Field(
        default='symplectic_euler',
        description='euler: forward, needs damping; symplectic_euler: one force a step; rk4: '
        'Runge-Kutta; implicit: backward Euler, any step, damps',
    )
    active_region: ActiveRegionSettings = Field(
        default=ActiveRegionSettings(),
        description='which nodes are integrated: mode, nodes, tolerance',
    )
    integration: Integration = Field(
        default=Integration(), description='rate, safety, substeps and frequency_growth'
    )

    budget: Budget = Field(
        default=Budget(),
        description='required range and accuracy of the method, and its allowed cost',
    )

    @model_validator(mode='after')
    def _check_regions(self) -> Self:
        labels = [region.label for region in self.regions]
        for label in labels:
            if labels.count(label) > 1:
                raise ValueError(f'label {label} is in regions twice: name each region once')
        return self

    def region_values(self, name: str) -> list[float]:
        """Return a constant of the regions, one after the other; absent: that of `material`."""
        common = getattr(self.material, name)
        given = [getattr(region, name) for region in self.regions]
        return [common if value is None else value for value in given]

    @property
    def blade_constants(self) -> BladeConstants:
        """The constants of the blade's law that the force loop knows."""
        toughness = max(self.material.toughness, *self.region_values('toughness'), 0.0)
        return BladeConstants(
            self.material.crack_length,
            max(self.material.blade_friction, *self.region_values('blade_friction'), 0.0),
            math.inf if self.tip_width else self.cut_threshold,
            toughness,
            toughness * self.tip_width,
        )

    @model_validator(mode='after')
    def _check_damping(self) -> Self:
        if self.integrator == 'euler' and self.damping.alpha == self.damping.beta == 0.0:
            raise ValueError(
                'integrator euler has no stable step without damping: set damping.beta above 0, '
                'or take symplectic_euler'
            )
        return self

    @property
    def method_taken(self) -> dict[str, str | int | float]:
        """Method of computation, by dotted key below `tissue`."""
        region = {f'active_region.{k}': v for k, v in self.active_region.model_dump().items()}
        method = {'model': self.model, 'integrator': self.integrator, 'contact': self.contact}
        return method | region

    @property
    def unit_scale(self) -> float:
        """Metres per unit of the mesh file."""
        return UNIT_SCALE[self.unit]
