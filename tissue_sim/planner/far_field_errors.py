"""Error of a far field by the number of nodes that move on their own: static trials of one load.

The far nodes follow a coarse grid, so the tissue is too stiff under any load (Galerkin), the less
so the longer the load stays, as the nodes around the free ones relax. The same reduced operands as
in a session are solved for rest, frame by frame.
"""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static, solve_within
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, internal_force
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.far_field import FarField
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound
from cutting_trainer.tissue_sim.planner.indentation import Indenter

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FRAMES = 3
"""Frames since the load came, in which the far nodes around the free ones relax."""


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
        omega = FrequencyBound(self._model, inverse).omega
        u, v = np.zeros((2, 3 * n + extra))
        for _ in range(_FRAMES):
            force = self._model.product(u[: 3 * n].reshape(-1, 3))
            region = far.choose(u, v, force, inverse, [coupling], omega)
            own = np.isin(np.arange(n), far.nodes).repeat(3) & self._free
            diagonal = self._diagonal(far, region.operands, own, inverse)
            load, f = np.zeros((2, 3 * n + extra))
            load[: 3 * n] = self._load.ravel()
            internal_force(region.operands, u, f, 1)
            moving = np.append(own, np.ones(extra, bool))
            u += solve_within(
                region.operands, region.spans, diagonal, np.where(moving, load - f, 0.0)
            )
            far.follow(u, v, 3 * n)
        away = np.linalg.norm(u[: 3 * n].reshape(-1, 3) - self._whole, axis=1)
        return float(away.max() / np.linalg.norm(self._whole, axis=1).max())

    def _diagonal(self, far: FarField, operands: Operands, own: Bools, inverse: Floats) -> Floats:
        """Return the diagonal of the stiffness, 0 where nothing moves [N/m], shape (3 (n + c),)."""
        diagonal = far.diagonal(np.where(own, self._model.diagonal, 0.0))
        rim, axes = operands.coarse, np.arange(3)
        of_nodes = np.repeat(self._model.diagonal[rim.nodes[:, None] + axes], 8, axis=0)
        columns = len(own) + rim.columns[:, None] + axes
        np.add.at(diagonal, columns, np.square(rim.weights)[:, None] * of_nodes)
        diagonal[far.inverse(inverse) == 0.0] = 0.0
        return diagonal
