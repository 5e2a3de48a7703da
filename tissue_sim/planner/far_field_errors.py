"""Error of a far field by the number of nodes that move on their own: static trials of one load.

The far nodes follow a coarse grid, so the tissue is too stiff under any load (Galerkin). The same
reduced operands as in a session are solved for rest, once for each number of nodes.
"""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static, solve_within
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.far_field import FarField
from cutting_trainer.tissue_sim.planner.indentation import Indenter

Floats = NDArray[np.float64]


class FarFieldTrial:
    """A tissue under one load, to be solved with any number of nodes that move on their own.

    Args:
        mesh: the tissue.
        material: its constants.
        indenter: the load.
        smoothed: whether strains are smoothed.
    """

    def __init__(
        self, mesh: TetMesh, material: Material, indenter: Indenter, *, smoothed: bool
    ) -> None:
        self._model = ElasticModel(mesh, material, 'linear_smoothed' if smoothed else 'linear')
        self._load = indenter.load(mesh)
        self._direction = indenter.direction
        self._free = np.repeat(mesh.fixed == 0, 3)
        self._whole = solve_static(self._model, self._free, self._load, 1e-5)

    def error(self, nodes: int) -> float:
        """Return the largest error of a node's displacement, relative to the largest displacement.

        Args:
            nodes: that move on their own.
        """
        far = FarField(self._model, nodes)
        n, extra = len(self._load), far.extra
        weights = self._load @ self._direction
        under = np.flatnonzero(weights)
        coupling = Coupling(PUSH, under, weights[under] / weights.sum())
        moves = np.repeat(self._model.mass, 3) * self._free
        inverse = np.where(moves > 0.0, 1.0 / np.maximum(moves, 1e-300), 0.0)
        u, v = np.zeros((2, 3 * n + extra))
        region = far.choose(u, v, np.zeros((n, 3)), inverse, [coupling])
        own = np.isin(np.arange(n), far.nodes).repeat(3) & self._free
        diagonal = far.diagonal(np.where(own, self._model.diagonal, 0.0))
        rim, axes = region.operands.coarse, np.arange(3)
        of_nodes = np.repeat(self._model.diagonal[rim.nodes[:, None] + axes], 8, axis=0)
        columns = 3 * n + rim.columns[:, None] + axes
        np.add.at(diagonal, columns, np.square(rim.weights)[:, None] * of_nodes)
        diagonal[far.inverse(inverse) == 0.0] = 0.0
        load = np.concatenate([np.where(own, self._load.ravel(), 0.0), np.zeros(extra)])
        u = solve_within(region.operands, region.spans, diagonal, load)
        far.follow(u, v, 3 * n)
        away = np.linalg.norm(u[: 3 * n].reshape(-1, 3) - self._whole, axis=1)
        return float(away.max() / np.linalg.norm(self._whole, axis=1).max())
