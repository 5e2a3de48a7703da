"""Quadratic tetrahedra of scikit-fem: the reference for plans.

Shape functions, quadrature and loads are scikit-fem's; in a deep dent the tissue is hyperelastic.
"""

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, splu
from skfem.models.elasticity import linear_elasticity

from cutting_trainer.tissue_sim.elasticity.hyperelastic import Hyperelastic, Points
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.indentation import Indenter

Floats = NDArray[np.float64]


class QuadraticTissue:
    """A tissue of quadratic tetrahedra on a mesh.

    Args:
        mesh: mesh with corners and fixed nodes.
        material: its constants.
    """

    def __init__(self, mesh: TetMesh, material: Material) -> None:
        whole = skfem.MeshTet(mesh.rest.T.copy(), mesh.tetrahedra.T.astype(np.int64))
        self._basis = skfem.Basis(whole, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
        self._surface = self._basis.boundary()
        self._material = material
        lam, mu = material.lame_lambda, material.lame_mu
        stiffness = linear_elasticity(lam, mu).assemble(self._basis)
        held = mesh.fixed == 1
        facets = np.flatnonzero(held[whole.facets].all(axis=0))
        fixed = [self._basis.get_dofs(facets).all(), self._basis.nodal_dofs[:, held].ravel()]
        self._free = np.ones(stiffness.shape[0], bool)
        self._free[np.concatenate(fixed)] = False
        inside = stiffness[self._free][:, self._free].tocsc()
        symmetric = {'SymmetricMode': True}
        self._factors = splu(
            inside, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options=symmetric
        )

    def load(self, press: Indenter) -> Floats:
        """Return the press as forces of 1 N in all [N], shape (c,)."""
        towards = np.einsum('iqp,i->qp', np.asarray(self._surface.normals), press.direction) < 0

        @skfem.LinearForm
        def work(v, w):
            away = np.sqrt(sum((w.x[i] - press.centre[i]) ** 2 for i in range(3))) / press.radius
            pressure = np.where(away < 1, (1 - away**2) ** 2, 0.0) * towards
            return pressure * sum(press.direction[i] * v[i] for i in range(3))

        load = work.assemble(self._surface)
        basis = self._basis
        parts = [np.concatenate([basis.nodal_dofs[i], basis.edge_dofs[i]]) for i in range(3)]
        return np.asarray(load / sum(press.direction[i] * load[parts[i]].sum() for i in range(3)))

    def settlement(self, press: Indenter) -> float:
        """Return the settlement of the linear tissue under 1 N [m]."""
        load = self.load(press)[self._free]
        return float(load @ self._factors.solve(load))

    def corners(self, press: Indenter) -> Floats:
        """Return the displacement of the mesh's nodes under 1 N [m], shape (n, 3)."""
        u = np.zeros(len(self._free))
        u[self._free] = self._factors.solve(self.load(press)[self._free])
        return np.asarray(u[self._basis.nodal_dofs].T)

    def force(self, press: Indenter, depth: float, steps: int = 8) -> float:
        """Return the force that presses the hyperelastic tissue to a depth [N].

        Args:
            press: where.
            depth: [m].
            steps: that it is pressed in.

        Raises:
            MeshError: no equilibrium was found.
        """
        solve = LinearOperator(self._factors.shape, self._factors.solve)
        tissue = Hyperelastic([self._points()], self._free, solve)
        return tissue.press(self.load(press), depth, steps)[0]

    def _points(self) -> Points:
        basis = self._basis
        scalar = basis.with_element(skfem.ElementTetP2())
        shapes = np.stack([np.asarray(scalar.basis[a][0].grad) for a in range(scalar.Nbfun)])
        nodes, _, count, quadrature = shapes.shape
        i, j = np.divmod(np.arange(9), 3)
        # By shape function, tetrahedron, point, and entry of the gradient.
        values = np.moveaxis(shapes, 1, 3)[..., j]
        point = np.arange(count)[:, None] * quadrature + np.arange(quadrature)
        rows = np.broadcast_to(9 * point[None, :, :, None] + np.arange(9), values.shape)
        dofs = basis.element_dofs.reshape(nodes, 3, count)
        columns = np.moveaxis(dofs, 1, 2)[:, :, None, i]
        columns = np.broadcast_to(columns, values.shape)
        shape = (9 * count * quadrature, basis.N)
        gradient = csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
        lame = (self._material.lame_lambda, self._material.lame_mu)
        weight = np.asarray(scalar.dx).ravel()
        return Points(gradient, weight, lame, self._material.stiffening)
