"""Hyperelastic tissue in static equilibrium: the reference for the planner's error estimates.

Its energy by volume is that of the law that stiffens (docs/method.md), at every point, however
small the strain: mu/(2b) (exp(b x) - 1) + lambda/2 (ln J)^2 with x = |F|^2 - 3 - 2 ln J; for b = 0
neo-Hookean (Bonet and Wood 2008, 6.28). It is linear elasticity where strains are small, right for
any rotation, and no volume ever vanishes. Models that are linear in strain, also the corotational
ones, collapse under deep indentation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, cg

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import PLAIN_SHARE
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import NodalSmoothing
from cutting_trainer.tissue_sim.elasticity.stiffening import MAX_EXPONENT
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

_ITERATIONS = 25
_CLOSE = 1e-4
"""Newton step, relative to the depth, at which the equilibrium is converged."""
_FLAT = 0.02
"""Smallest volume ratio that a step may reach."""


class Points(NamedTuple):
    """Evaluation points of the deformation gradient, with weights.

    Attributes:
        gradient: displacement by coordinate to its gradients [1/m], shape (9 k, 3 n).
        weight: volumes times relative stiffness [m^3], shape (k,).
        lame: lambda and mu [Pa].
        stiffening: b of the law.
    """

    gradient: csr_matrix
    weight: Floats
    lame: tuple[float, float]
    stiffening: float = 0.0


def smoothed_points(mesh: TetMesh, material: Material) -> list[Points]:
    """Return the evaluation points of the smoothed models.

    A share of mu is evaluated in elements, the rest averaged over nodes.
    """
    lam, mu, b = material.lame_lambda, material.lame_mu, material.stiffening
    relative = material.relative_stiffness
    domains = NodalSmoothing(mesh, lam, (1 - PLAIN_SHARE) * mu, relative).operands
    count = len(domains.used)
    rows = np.repeat(np.arange(count), domains.used)
    slots = np.repeat(domains.start - np.cumsum(domains.used) + domains.used, domains.used)
    slots = slots + np.arange(len(rows))
    vectors = domains.vectors.reshape(-1, 3)[slots]
    averaged = _gradient(rows, domains.columns[slots] // 3, vectors, count, mesh)
    tets = mesh.tetrahedra.astype(np.int64)
    edges = np.moveaxis(mesh.rest[tets[:, 1:]] - mesh.rest[tets[:, :1]], 1, 2)
    inner = np.linalg.inv(edges)
    shapes = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    rows = np.repeat(np.arange(len(tets)), 4)
    plain = _gradient(rows, tets.ravel(), shapes.reshape(-1, 3), len(tets), mesh)
    return [
        Points(averaged, domains.volume.copy(), (lam, (1 - PLAIN_SHARE) * mu), b),
        Points(plain, mesh.volumes() * mesh.by_region(relative), (0.0, PLAIN_SHARE * mu), b),
    ]


def _gradient(
    rows: NDArray[np.int64], nodes: NDArray[np.int64], vectors: Floats, count: int, mesh: TetMesh
) -> csr_matrix:
    """Return the gradient operator; row 9 r + 3 i + j has the derivative of component i along j."""
    i, j = np.divmod(np.arange(9), 3)
    at = 9 * rows[:, None] + np.arange(9)
    columns = 3 * nodes.astype(np.int64)[:, None] + i
    shape = (9 * count, 3 * mesh.node_count)
    return csr_matrix((vectors[:, j].ravel(), (at.ravel(), columns.ravel())), shape=shape)


class Hyperelastic:
    """Hyperelastic tissue under an indenting load.

    Args:
        points: points whose energies add up.
        free: True where a coordinate can move, shape (c,).
        preconditioner: solves approximately with the stiffness at rest, by free coordinates.
    """

    def __init__(
        self, points: Sequence[Points], free: NDArray[np.bool_], preconditioner: LinearOperator
    ) -> None:
        self._points = points
        self._free = free
        self._preconditioner = preconditioner
        self._transposed = [p.gradient.T.tocsr() for p in points]

    def press(self, load: Floats, depth: float, steps: int = 4) -> tuple[float, Floats]:
        """Return the multiple of a load that indents by a given depth.

        Args:
            load: total of 1 N, so that its work is the mean displacement under it [N], shape (c,).
            depth: that displacement [m].
            steps: of equal depth, one after the other.

        Returns:
            Force [N], and displacement by coordinate [m], shape (c,).

        Raises:
            MeshError: no equilibrium was found.
        """
        u, force = np.zeros(len(load)), 0.0
        for step in range(1, steps + 1):
            if step > 1:
                u = self._shortened(u, u * (1.0 / (step - 1)))
            u, force = self._settle(u, force, load, depth * step / steps)
        return force, u

    def _settle(self, u: Floats, force: float, load: Floats, depth: float) -> tuple[Floats, float]:
        f = load[self._free]
        for _ in range(_ITERATIONS):
            internal, tangent = self._linearised(u)
            out = (force * load - internal)[self._free]
            balanced, pushed = self._solve(tangent, out), self._solve(tangent, f)
            more = (depth - load @ u - f @ balanced) / (f @ pushed)
            step = np.zeros_like(u)
            step[self._free] = balanced + more * pushed
            ahead = self._shortened(u, step)
            share = float((ahead - u) @ step) / max(float(step @ step), 1e-300)
            u, force = ahead, force + share * float(more)
            if share > 0.99 and float(np.abs(step).max()) < _CLOSE * depth:
                return u, force
        raise MeshError(f'no equilibrium at a depth of {1e3 * depth:.3g} mm')

    def _solve(self, tangent: LinearOperator, right: Floats) -> Floats:
        found, _ = cg(tangent, right, rtol=1e-3, maxiter=200, M=self._preconditioner)
        return np.asarray(found)

    def _deformation(self, points: Points, u: Floats) -> Floats:
        return np.eye(3) + (points.gradient @ u).reshape(-1, 3, 3)

    def _shortened(self, u: Floats, step: Floats) -> Floats:
        """Return the sum, with a shorter step where volume would vanish."""
        for share in 0.5 ** np.arange(10):
            ahead = u + share * step
            least = min(np.linalg.det(self._deformation(p, ahead)).min() for p in self._points)
            if least > _FLAT:
                return np.asarray(ahead)
        raise MeshError('no equilibrium: elements turn inside out')

    def _linearised(self, u: Floats) -> tuple[Floats, LinearOperator]:
        """Return the internal force [N], shape (c,), and the tangent stiffness of free
        coordinates.
        """
        internal, parts = np.zeros_like(u), []
        for p, transposed in zip(self._points, self._transposed, strict=True):
            stress, change = law_stress(self._deformation(p, u), *p.lame, p.stiffening)
            internal += transposed @ (p.weight[:, None, None] * stress).ravel()
            change *= p.weight[:, None, None, None, None]
            parts.append((p.gradient, change.reshape(-1, 9, 9), transposed))
        whole = np.zeros_like(u)

        def product(x: Floats) -> Floats:
            whole[self._free] = x.ravel()
            out = np.zeros_like(u)
            for gradient, change, transposed in parts:
                strained = (gradient @ whole).reshape(-1, 9, 1)
                out += transposed @ (change @ strained).ravel()
            return np.asarray(out[self._free])

        size = int(self._free.sum())
        return internal, LinearOperator((size, size), matvec=product, dtype=float)


def law_stress(
    gradient: Floats, lam: float, mu: float, stiffening: float = 0.0
) -> tuple[Floats, Floats]:
    """Return the first Piola-Kirchhoff stress and its derivative.

    Args:
        gradient: of the deformation, F, shape (k, 3, 3).
        lam, mu: Lame coefficients [Pa].
        stiffening: b of the law; 0: neo-Hookean.

    Returns:
        P [Pa], shape (k, 3, 3), and dP/dF, shape (k, 3, 3, 3, 3).
    """
    inverse = np.linalg.inv(gradient)
    turned = np.swapaxes(inverse, 1, 2)
    logarithm = np.log(np.linalg.det(gradient))[:, None, None]
    sheared = gradient - turned
    x = np.square(gradient).sum(axis=(1, 2)) - 3 - 2 * logarithm[:, 0, 0]
    stiff = (mu * np.exp(np.minimum(stiffening * x, MAX_EXPONENT)))[:, None, None]
    stress = stiff * sheared + lam * logarithm * turned
    change = (stiff - lam * logarithm)[..., None, None] * np.einsum(
        'kpa,kjb->kbpaj', inverse, inverse
    ) + lam * np.einsum('kpb,kja->kbpaj', inverse, inverse)
    change += np.einsum('kpq,ba,pj->kbpaj', stiff, np.eye(3), np.eye(3))
    if stiffening > 0.0:
        steeper = 2 * stiffening * stiff[:, 0, 0] * (stiffening * x < MAX_EXPONENT)
        change += np.einsum('k,kbp,kaj->kbpaj', steeper, sheared, sheared)
    return stress, change
