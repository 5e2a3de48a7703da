"""Masses with which nodes are integrated, and the highest frequency that follows from them."""

import numpy as np

from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.strain import Strain
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound
from cutting_trainer.tissue_sim.motion.stiffened_mass import StiffenedMass


class NodalMass:
    """Mass of each node in the integration: more than its own where a cut or strain makes it fast.

    Args:
        model: the elastic model.
        growth: largest growth of the highest frequency by cuts, see `TimeStepping`.

    Attributes:
        uncut: bound of the highest frequency before any cut [rad/s].
    """

    def __init__(self, model: ElasticModel, growth: float) -> None:
        self._model = model
        fixed, n = model.mesh.fixed == 1, model.mesh.node_count
        self._inverse = np.repeat(np.where(fixed, 0.0, 1.0 / model.mass), 3)
        self._inertia = model.mass.copy()
        self._frequency = FrequencyBound(model, self._inverse, growth)
        unscaled = self._frequency.unscaled
        if growth < 1.0:
            self._inertia[:] = self._frequency.limit(np.arange(n), self._inverse)
        self.uncut = self._frequency.omega
        self._stiffened: StiffenedMass | None = None
        if model.lawful:
            self._stiffened = StiffenedMass(model, unscaled, self._inverse, growth)

    @property
    def omega(self) -> float:
        """Bound of the highest frequency, for the step [rad/s]."""
        bound = self._frequency.omega
        return bound if self._stiffened is None else max(self._stiffened.omega, bound)

    @property
    def inverse(self) -> np.ndarray:
        """Inverse mass without strain by coordinate, 0 where fixed [1/kg], shape (3 n,); a view."""
        return self._inverse[: 3 * self._model.mesh.node_count]

    @property
    def present_inverse(self) -> np.ndarray:
        """Present inverse mass by coordinate, 0 where fixed [1/kg], shape (3 n,)."""
        stiffened, base = self._stiffened, self.inverse
        return base if stiffened is None else stiffened.inverse(base)

    @property
    def strain(self) -> Strain | None:
        """Strain at the last adaptation; None: masses do not follow it."""
        return None if self._stiffened is None else self._stiffened.strain

    @property
    def follows_strain(self) -> bool:
        """Whether masses follow the strain: the model has a law."""
        return self._stiffened is not None

    def begin(self, u: np.ndarray, operands: Operands) -> None:
        """Choose the frequency of a frame; see `StiffenedMass.begin`."""
        if self._stiffened is not None:
            base = self._frequency.omega
            self._stiffened.begin(u, base, self.inverse, operands)

    def adapt(self, u: np.ndarray, v: np.ndarray, operands: Operands, *, begun: bool) -> None:
        """Adapt masses to the strain; see `StiffenedMass.adapt`."""
        if self._stiffened is not None:
            self._stiffened.adapt(u, v, self.inverse, operands, begun=begun)

    def hold(self, nodes: np.ndarray) -> None:
        """Fix nodes for good, of shape (r,)."""
        self.inverse.reshape(-1, 3)[nodes] = 0.0

    def kinetic_energy(self, velocity: np.ndarray, nodes: np.ndarray | None) -> float:
        """Return the kinetic energy [J].

        Args:
            velocity: of all nodes [m/s], shape (n, 3).
            nodes: that move, of shape (r,); None: all.
        """
        inertia = self._inertia[: self._model.mesh.node_count]
        if self._stiffened is not None:
            inertia = 1.0 / np.maximum(self.present_inverse[::3], 1e-300)
            inertia = np.where(self.inverse[::3] > 0.0, inertia, 0.0)
        if nodes is not None:
            velocity, inertia = velocity[nodes], inertia[nodes]
        return 0.5 * float((inertia * np.square(velocity).sum(axis=1)).sum())

    def follow_cut(self, nodes: np.ndarray) -> None:
        """Choose masses where a cut touched nodes, of shape (r,)."""
        n = self._model.mesh.node_count
        if len(self._inertia) < n:
            self._inertia = grown(self._inertia, n)
            self._inverse = grown(self._inverse, 3 * len(self._inertia))
        self._inertia[nodes] = self._frequency.limit(nodes, self.inverse)
        if self._stiffened is not None:
            self._stiffened.follow_cut()
