"""What the section `tissue` of a scene file may say."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tissue_sim.budget import Budget
from tissue_sim.elasticity import ModelName
from tissue_sim.integrators import IntegratorName
from tissue_sim.scene_file import SceneModel, ScenePath

UNIT_SCALE = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}
"""Metres by unit of a mesh file."""

AXES = ('x', 'y', 'z')

PRESETS: dict[str, dict[str, float]] = {
    'liver_yi2007': {
        'youngs_modulus': 642.55,
        'poissons_ratio': 0.47,
        'density': 1050.0,
        'toughness': 200.0,
    },
    'liver_elastography': {
        'youngs_modulus': 5400.0,
        'poissons_ratio': 0.45,
        'density': 1060.0,
        'toughness': 200.0,
    },
}
"""Materials by name; see `Material` for their sources."""

Coordinate = Annotated[float, Field(ge=-2, le=2)]
Stretch = Annotated[float, Field(ge=-0.3, le=0.3)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class Material(SceneModel):
    """A linear isotropic elastic solid: a preset, single values, or a preset with some replaced.

    Presets:
        liver_yi2007: E 642.55 Pa, nu 0.47, 1050 kg/m^3, the liver of J. Yi, MASc thesis, Carleton
            University 2007, section 7.2.
        liver_elastography: shear modulus 1.8 kPa of healthy liver by magnetic resonance
            elastography (PMC6925591, table 1), 1060 kg/m^3; E = 5.4 kPa is three times it. That
            source has no Poisson's ratio: 0.45 is a compromise, above it linear tetrahedra lock.
        Both: toughness of porcine liver under a blade, 187 to 225 J/m^2
            (doi 10.1186/s10033-022-00767-4, table 2).
    """

    preset: Literal['liver_yi2007', 'liver_elastography'] | None = Field(
        default=None, description='named material that fills in the values not given here'
    )
    youngs_modulus: float = Field(ge=10, le=1e7, description="Young's modulus [Pa], 10 to 1e7")
    poissons_ratio: float = Field(
        ge=0,
        lt=0.5,
        description="Poisson's ratio [-], 0 to below 0.5; near it linear elements lock",
    )
    density: float = Field(ge=100, le=20000, description='mass density [kg/m^3], 100 to 20000')
    toughness: float = Field(
        default=200.0, ge=0, le=1e5, description='fracture toughness [J/m^2], 0 to 1e5'
    )
    blade_friction: float = Field(
        default=20.0,
        ge=0,
        le=1e4,
        description='friction on the blade by length of edge in the tissue [N/m], 0 to 1e4',
    )

    @model_validator(mode='before')
    @classmethod
    def _fill_in_preset(cls, values: Any) -> Any:
        preset = values.get('preset') if isinstance(values, dict) else None
        if not isinstance(preset, str):
            return values
        if preset not in PRESETS:
            known = ', '.join(map(repr, PRESETS))
            raise ValueError(f'preset {preset!r} is not known: there are {known}')
        return PRESETS[preset] | values


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
    """Everything at or below a value of one coordinate."""

    axis: Literal['x', 'y', 'z'] = Field(description='coordinate that is compared: x, y or z')
    value: Coordinate = Field(description='its largest value [m], -2 to 2')


class FixedRegion(SceneModel):
    """A box or a half space: nodes whose rest position lies in it do not move."""

    box: Box | None = Field(default=None, description='box with min and max [m]')
    below: HalfSpace | None = Field(default=None, description='half space with axis and value [m]')

    @model_validator(mode='after')
    def _check_one(self) -> Self:
        if (self.box is None) == (self.below is None):
            raise ValueError('give one of box (min, max) and below (axis, value), and not both')
        return self

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points lie in the region, its boundary included.

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
    """How a frame is integrated in time."""

    rate: float = Field(default=30.0, ge=1, le=240, description='frames a second [Hz], 1 to 240')
    safety: float = Field(
        default=0.8,
        gt=0,
        le=1,
        description='share of the stable step that is used [-], above 0 to 1',
    )
    frequency_growth: float = Field(
        default=3.0,
        ge=1,
        le=1000,
        description='how far cuts may raise the highest frequency before small nodes are '
        'integrated with more mass [-], 1 to 1000',
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


class ActiveRegion(SceneModel):
    """Nodes that nothing moves are not integrated."""

    mode: Literal['off', 'on', 'budget'] = Field(
        default='off',
        description='off: all nodes move; on: those that forces or neighbours move; budget: of '
        'those the nodes nearest to the tool',
    )
    nodes: int = Field(
        default=2000, ge=1, le=10**7, description='how many move at most with budget [-], 1 to 1e7'
    )
    tolerance: float = Field(
        default=1e-4,
        gt=0,
        le=1,
        description='speed below which a node may sleep [m/s], above 0 to 1',
    )


class TissueSettings(SceneModel):
    """The section `tissue`."""

    mesh: ScenePath = Field(
        description='file of tetrahedra that meshio reads, relative to the scene file'
    )
    unit: Literal['m', 'cm', 'mm'] = Field(
        default='m', description='unit of length of the mesh file: m, cm or mm'
    )
    material: Material = Field(description='preset, or youngs_modulus, poissons_ratio and density')
    damping: Damping = Field(default=Damping(), description='alpha [1/s] and beta [s]')
    fixed: tuple[FixedRegion, ...] = Field(
        min_length=1, description='regions whose nodes do not move, at least one'
    )
    stretch: tuple[Stretch, Stretch, Stretch] = Field(
        default=(0.0, 0.0, 0.0),
        description='how far the fixed nodes are pulled apart along x, y, z before the session '
        '[-], -0.3 to 0.3: the tension under which a cut opens',
    )
    cut_threshold: float = Field(
        default=0.5,
        gt=0,
        le=100,
        description='contact force that lets the blade in [N], above 0 to 100',
    )
    method: Literal['given', 'auto'] = Field(
        default='given',
        description='given: model and integrator of the scene; auto: the least that meet its '
        'budget, those of the scene where none does',
    )
    model: ModelName = Field(
        default='linear_smoothed',
        description='linear: tensor-mass; linear_smoothed: strains averaged over nodes, against '
        'locking; corotational: elements turn with the tissue; corotational_smoothed: both',
    )
    integrator: IntegratorName = Field(
        default='symplectic_euler',
        description='euler: forward, needs damping; symplectic_euler: one force a step; rk4: '
        'fourth-order Runge-Kutta; implicit: backward Euler, any step, damps',
    )
    active_region: ActiveRegion = Field(
        default=ActiveRegion(), description='which nodes are integrated: mode, nodes, tolerance'
    )
    integration: Integration = Field(
        default=Integration(), description='rate, safety, substeps and frequency_growth'
    )

    budget: Budget = Field(
        default=Budget(), description='what the method must be able to do, and what it may cost'
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
        """What the tissue is computed by, by dotted key below `tissue`."""
        region = {f'active_region.{k}': v for k, v in self.active_region.model_dump().items()}
        return {'model': self.model, 'integrator': self.integrator, **region}

    @property
    def unit_scale(self) -> float:
        """Metres by unit of the mesh file."""
        return UNIT_SCALE[self.unit]
