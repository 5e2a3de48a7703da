"""Linear isotropic elasticity: the constants that the kernels take."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """A homogeneous isotropic tissue.

    Attributes:
        youngs_modulus: E [Pa].
        poissons_ratio: nu, below 0.5.
        density: rho [kg/m^3].
        alpha: mass-proportional damping [1/s] (thesis eq. 7.3).
        beta: stiffness-proportional damping [s] (thesis eq. 7.3; its unit is seconds).
    """

    youngs_modulus: float
    poissons_ratio: float
    density: float
    alpha: float = 0.0
    beta: float = 0.0

    @property
    def lame_lambda(self) -> float:
        """First Lame coefficient [Pa] (thesis eq. 7.1)."""
        nu = self.poissons_ratio
        return nu * self.youngs_modulus / ((1 - 2 * nu) * (1 + nu))

    @property
    def lame_mu(self) -> float:
        """Shear modulus [Pa] (thesis eq. 7.2)."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))
