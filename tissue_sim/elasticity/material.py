"""Constants of linear isotropic elasticity for the kernels."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RegionMaterial:
    """Constants of a region that are not those of the tissue's material.

    Attributes:
        youngs_modulus: E [Pa].
        density: rho [kg/m^3].
    """

    youngs_modulus: float
    density: float


@dataclass(frozen=True)
class Material:
    """An isotropic tissue, of one material or of several that differ in stiffness and density.

    Attributes:
        youngs_modulus: E [Pa].
        poissons_ratio: nu, below 0.5.
        density: rho [kg/m^3].
        alpha: mass-proportional damping [1/s] (thesis eq. 7.3).
        beta: stiffness-proportional damping [s] (thesis eq. 7.3; its unit is seconds).
        stiffening: b of the law exp(b x) of the model `stiffening`, 0: neo-Hookean.
        prony: share g of the shear modulus that relaxes, and its time [s], by term: shear has
            G(t) = G (1 - sum of g (1 - exp(-t / tau))). E is that of the first moment, t = 0.
        regions: constants of regions 1, 2, ... of the mesh; region 0 has those above. Poisson's
            ratio, stiffening and prony are common: all stresses of a region are then in proportion
            to its E.

    Raises:
        ValueError: a constant of the tissue's own is not that of a tissue.
    """

    youngs_modulus: float
    poissons_ratio: float
    density: float
    alpha: float = 0.0
    beta: float = 0.0
    stiffening: float = 0.0
    prony: tuple[tuple[float, float], ...] = ()
    regions: tuple[RegionMaterial, ...] = ()

    def __post_init__(self) -> None:
        for name, value in (('youngs_modulus', self.youngs_modulus), ('density', self.density)):
            if not 0.0 < value < math.inf:
                raise ValueError(f'{name} is {value}: it must be above 0, and finite')
        if not -1.0 < self.poissons_ratio < 0.5:
            raise ValueError(
                f'poissons_ratio is {self.poissons_ratio}: it must be between -1 and 0.5'
            )
        for name in ('alpha', 'beta', 'stiffening'):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f'{name} is {getattr(self, name)}: it must be 0 or above, and finite'
                )

    @property
    def relative_stiffness(self) -> np.ndarray:
        """E by region, relative to that of region 0, shape (1 + r,)."""
        return np.array([1.0, *(r.youngs_modulus / self.youngs_modulus for r in self.regions)])

    @property
    def densities(self) -> np.ndarray:
        """Density by region [kg/m^3], shape (1 + r,)."""
        return np.array([self.density, *(r.density for r in self.regions)])

    @property
    def lame_lambda(self) -> float:
        """First Lame coefficient [Pa] (thesis eq. 7.1)."""
        nu = self.poissons_ratio
        return nu * self.youngs_modulus / ((1 - 2 * nu) * (1 + nu))

    @property
    def lame_mu(self) -> float:
        """Shear modulus [Pa] (thesis eq. 7.2)."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def plane_modulus(self) -> float:
        """Modulus of contact, E / (1 - nu^2) [Pa]."""
        return self.youngs_modulus / (1 - self.poissons_ratio**2)

    @property
    def line_compliance(self) -> float:
        """Displacement by a load along a line, by load per length and logarithm of the distance
        from the line (Kelvin's solution, plane strain) [m^2/N].
        """
        nu = self.poissons_ratio
        return (3 - 4 * nu) * (1 + nu) / (4 * math.pi * self.youngs_modulus * (1 - nu))
