"""Elastic force and energy at the end of a frame, recomputed where the tissue has moved."""

import numpy as np

from cutting_trainer.tissue_sim.elasticity.elastic_force import internal_force
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown


class ElasticState:
    """Force and energy by node, kept while parts of the tissue sleep.

    The energy of rotating models belongs to elements and domains: it is computed as a whole. So is
    the force of a viscous tissue, whose load changes around the nodes that move.

    Args:
        model: the elastic model.
    """

    def __init__(self, model: ElasticModel) -> None:
        self._model = model
        self._force = np.zeros((0, 3))
        self._products = np.zeros(0)
        self._scratch = np.zeros(0)

    def whole(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the force against a displacement, less the model's load, and the elastic energy.

        Args:
            u: displacement [m], shape (n, 3).
        """
        self._force, energy = self._model.evaluate(u)
        self._products = np.zeros(0)
        return self._force, energy

    @property
    def force(self) -> np.ndarray:
        """Force of the last call [N], shape (n, 3); a view that the next call overwrites."""
        return self._force

    def renewed(self, u: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the same, recomputed only at some nodes and their neighbours.

        Args:
            u: displacement [m], shape (n, 3).
            moved: nodes whose displacement or elements have changed since the last call; in any
                order and with repeats, shape (a,).

        Returns:
            Force [N], shape (n, 3), a view that the next call overwrites; energy [J].
        """
        model = self._model
        n = model.mesh.node_count
        viscous = bool(model.material.prony)
        if model.rotating or viscous or len(moved) >= n or len(self._force) == 0:
            return self.whole(u)
        if len(self._products) == 0:
            self._products = np.einsum('ij,ij->i', u[: len(self._force)], self._force[: len(u)])
        self._force, self._products = grown(self._force, n), grown(self._products, n)
        if len(self._scratch) < 3 * n:
            self._scratch = np.zeros(len(self._force) * 3)
        reach = 1 if model.smoothing is None else 2  # a domain has its node's neighbours
        level = model.neighbours.levels(moved, reach + 2)
        near = np.flatnonzero(level <= reach)
        f = self._scratch[: 3 * n]
        internal_force(model.operands_within(level, reach), u.reshape(-1), f, 1)
        self._force[near] = f.reshape(-1, 3)[near]
        self._products[near] = np.einsum('ij,ij->i', u[near], self._force[near])
        work = 0.5 * float(self._products[:n].sum())
        return self._force[:n], work + model.half_work(u.reshape(-1))
