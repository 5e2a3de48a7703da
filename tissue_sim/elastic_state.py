"""Elastic force and energy at the end of a frame, computed anew where the tissue has moved."""

import numpy as np

from tissue_sim.elasticity import ElasticModel, internal_force
from tissue_sim.mesh import grown


class ElasticState:
    """What a displacement costs, kept by node while parts of the tissue sleep.

    Of models that turn the energy belongs to elements and domains: they are computed as a whole.

    Args:
        model: the elastic model.
    """

    def __init__(self, model: ElasticModel) -> None:
        self._model = model
        self._force = np.zeros((0, 3))
        self._products = np.zeros(0)
        self._scratch = np.zeros(0)

    def whole(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Force that resists a displacement [m], shape (n, 3), and energy: `ElasticModel.evaluate`.

        Args:
            u: displacement [m], shape (n, 3).
        """
        self._force, energy = self._model.evaluate(u)
        self._products = np.zeros(0)
        return self._force, energy

    def renewed(self, u: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, float]:
        """The same, computed at some nodes and their neighbours only.

        Args:
            u: displacement [m], shape (n, 3).
            moved: nodes whose displacement or elements have changed since the last call; in any
                order and with repeats, shape (a,).

        Returns:
            Force [N], shape (n, 3), a view of what the next call writes; energy [J].
        """
        model = self._model
        n = model.mesh.node_count
        if model.rotating or len(moved) >= n or len(self._force) == 0:
            return self.whole(u)
        if len(self._products) == 0:
            self._products = np.einsum('ij,ij->i', u[: len(self._force)], self._force[: len(u)])
        self._force, self._products = grown(self._force, n), grown(self._products, n)
        if len(self._scratch) < 3 * n:
            self._scratch = np.zeros(len(self._force) * 3)
        level = model.neighbours.levels(moved, 3)
        near = np.flatnonzero(level <= 1)
        f = self._scratch[: 3 * n]
        internal_force(model.operands_within(level, 1), u.reshape(-1), f, 1)
        self._force[near] = f.reshape(-1, 3)[near]
        self._products[near] = np.einsum('ij,ij->i', u[near], self._force[near])
        return self._force[:n], 0.5 * float(self._products[:n].sum())
