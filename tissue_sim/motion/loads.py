"""Nodal forces beside the elastic ones: weight, and what viscosity takes from the elastic force."""

from typing import Any

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.viscosity import Viscosity
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta, Touched

_MAX_SUBSTEPS = 24
"""Substeps for which a viscous stress is constant at most."""
_SHARE_OF_TIME = 1 / 16
"""Longest time for which it is, as a share of the shortest relaxation time."""


class Loads:
    """The load of a model: true weights, and the relief by viscosity.

    Args:
        model: the elastic model; its `load` is kept here.
        gravity: acceleration [m/s^2], shape (3,).
    """

    def __init__(self, model: ElasticModel, gravity: tuple[float, float, float]) -> None:
        self._model = model
        self._gravity = np.array(gravity)
        self._viscosity = Viscosity(model) if model.material.prony else None
        self._stale = False
        self._weigh()

    @property
    def viscosity(self) -> Viscosity | None:
        """The viscous state, if the material has a Prony series."""
        return self._viscosity

    @property
    def settled(self) -> bool:
        """Whether the load stays as it is while nothing moves."""
        return self._viscosity is None or self._viscosity.settled

    def substeps(self, dt: float) -> int | None:
        """Return for how many substeps of a length [s] the load may be constant; None: all."""
        if self._viscosity is None:
            return None
        longest = _SHARE_OF_TIME * self._viscosity.shortest
        return max(1, min(_MAX_SUBSTEPS, int(longest / dt)))

    def energy(self, u: np.ndarray) -> float:
        """Return what weight and viscosity add to the elastic energy [J].

        Args:
            u: displacement by coordinate [m], shape (3 n,).
        """
        viscous = 0.0 if self._viscosity is None else self._viscosity.energy
        return viscous - float((u.reshape(-1, 3) @ self._gravity) @ self._model.mass)

    def advance(self, u: np.ndarray, seconds: float, spans: np.ndarray) -> None:
        """Let viscous stresses of some nodes follow, see `Viscosity.advance`."""
        if self._viscosity is not None:
            self._viscosity.advance(u, seconds, spans, self._model.load)

    def relax(self, u: np.ndarray) -> None:
        """Relax viscous stresses in full, as after a long time in this shape.

        Args:
            u: displacement by coordinate [m], shape (3 n,).
        """
        if self._viscosity is not None:
            self._viscosity.relax(u, self._model.load)

    def at_rest(self, u: np.ndarray) -> np.ndarray:
        """Return the shape at rest after a long time under weight.

        Args:
            u: displacement to begin from, with that of the fixed nodes [m], shape (n, 3).

        Returns:
            [m], shape (n, 3).

        Raises:
            MeshError: no such shape was found.
        """

        def force(at: np.ndarray) -> np.ndarray:
            self.relax(at.ravel())
            return self._model.force(at)

        try:
            return equilibrium(self._model, np.zeros_like(u), start=u, force=force)
        except MeshError as error:
            raise MeshError(
                f'the tissue finds no rest under its weight ({error}): hold it at more places, or '
                'lessen gravity'
            ) from None

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Carry the state through a change of connectivity; the load follows with `refresh`.

        Args:
            count: of nodes before it.
            delta: the change, which mesh and model have followed.
            touched: the written slots.
        """
        if self._viscosity is not None:
            self._viscosity.apply_cut(count, delta, touched)
        self._stale = True
        self._weigh()

    def refresh(self, u: np.ndarray) -> None:
        """Compute the load anew if a cut has changed it.

        Args:
            u: displacement by coordinate [m], shape (3 n,).
        """
        if self._stale and self._viscosity is not None:
            self._weigh()
            self._viscosity.reload(u, self._model.load)
        self._stale = False

    def kept(self) -> tuple[Any, ...] | None:
        """Return a copy of the viscous state and its load, for `restore`."""
        if self._viscosity is None:
            return None
        return self._viscosity.kept(), self._model.load.copy()

    def restore(self, kept: tuple[Any, ...] | None) -> None:
        """Return to a state of `kept`, of the same mesh."""
        if kept is not None and self._viscosity is not None:
            self._viscosity.restore(kept[0])
            self._model.load[:] = kept[1]

    def _weigh(self) -> None:
        weight = (self._model.mass[:, None] * self._gravity).ravel()
        if len(self._model.load) == len(weight):
            self._model.load[:] = weight
        else:
            self._model.load = weight
