"""Where a tissue comes to rest, for any elastic model: Newton's method with conjugate gradients."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, cg, splu

from tissue_sim.elasticity import ElasticModel
from tissue_sim.errors import MeshError

Floats = NDArray[np.float64]


_REACH = 1e-6
"""Difference that a tangent is taken over, as a part of the tissue's length."""
_INEXACT = 0.02
"""What a Newton step may leave of the residual."""
_FACTORISED = 20_000
"""Unknowns up to which the preconditioner is a factorised matrix."""


def equilibrium(
    model: ElasticModel,
    load: Floats,
    *,
    held: NDArray[np.bool_] | None = None,
    start: Floats | None = None,
    tolerance: float = 1e-6,
    iterations: int = 60,
) -> Floats:
    """Displacement under constant forces.

    The tangent is a difference of two forces, so that any model serves; for a linear one it is
    exact.

    Args:
        model: the elastic model.
        load: [N], shape (n, 3); forces on held nodes do not count.
        held: nodes that stay where `start` has them, shape (n,); by default the mesh's fixed ones.
        start: displacement to begin from [m], shape (n, 3); by default none.
        tolerance: of the residual, relative to the largest one met.
        iterations: Newton steps at most.

    Returns:
        [m], shape (n, 3).

    Raises:
        MeshError: no equilibrium was found.
    """
    mesh = model.mesh
    free = np.repeat((mesh.fixed == 0) if held is None else ~held, 3)
    u = np.zeros(3 * mesh.node_count) if start is None else start.ravel().copy()
    scale = _REACH * float(np.linalg.norm(np.ptp(mesh.rest, axis=0)))
    largest = 0.0

    def residual(at: Floats) -> Floats:
        return np.asarray((load - model.force(at.reshape(-1, 3))).ravel()[free])

    out = residual(u)
    for _ in range(iterations):
        size = float(np.linalg.norm(out))
        if not np.isfinite(size):
            raise MeshError('no equilibrium: the tissue gives way; apply the load in smaller parts')
        largest = max(largest, size)
        if size <= tolerance * largest:
            return u.reshape(-1, 3)
        step = _newton_step(residual, u, free, out, preconditioner(model, u, free), scale)
        # Whole steps: on the way round a bend the residual grows before it falls.
        u[free] += step
        out = residual(u)
    raise MeshError(
        f'no equilibrium after {iterations} Newton steps: {size / largest:.1e} of the residual is '
        'left; apply the load in smaller parts'
    )


def _newton_step(
    residual: Callable[[Floats], Floats],
    u: Floats,
    free: NDArray[np.bool_],
    out: Floats,
    preconditioner: LinearOperator,
    scale: float,
) -> Floats:
    def tangent(direction: Floats) -> Floats:
        size = scale / max(float(np.abs(direction).max()), 1e-300)
        ahead = u.copy()
        ahead[free] += size * direction
        return np.asarray((out - residual(ahead)) / size)

    count = len(out)
    matrix = LinearOperator((count, count), matvec=tangent, dtype=float)
    with np.errstate(all='ignore'):  # a tissue that gives way shows in the residual
        most = 200 if count <= _FACTORISED else 2000
        step, _ = cg(matrix, out, rtol=_INEXACT, maxiter=most, M=preconditioner)
    return np.asarray(step)


def preconditioner(model: ElasticModel, u: Floats, free: NDArray[np.bool_]) -> LinearOperator:
    """Solves with the plain elements' stiffness under their present rotations, or its diagonal.

    A slender part that has turned is where conjugate gradients without it would not end.

    Args:
        model: whose mesh and material it has.
        u: displacement by coordinate [m], shape (3 n,).
        free: True where a coordinate can move, shape (3 n,).
    """
    count = int(free.sum())
    if count > _FACTORISED:
        weight = 1.0 / np.maximum(model.diagonal[free], 1e-30)
        return LinearOperator((count, count), matvec=lambda x: weight * x, dtype=float)
    factors = splu(turned_stiffness(model, u)[free][:, free].tocsc())
    return LinearOperator((count, count), matvec=factors.solve, dtype=float)


def turned_stiffness(model: ElasticModel, u: Floats) -> csr_matrix:
    """Stiffness of plain elements [N/m], turned with the tissue if the model turns.

    Args:
        model: whose mesh and material it has.
        u: displacement by coordinate [m], shape (3 n,).

    Returns:
        Shape (3 n, 3 n).
    """
    mesh, material = model.mesh, model.material
    tets = mesh.tetrahedra.astype(np.int64)
    edges = np.moveaxis(mesh.rest[tets[:, 1:]] - mesh.rest[tets[:, :1]], 1, 2)
    inner = np.linalg.inv(edges)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    if model.rotating:
        moved = (mesh.rest + u.reshape(-1, 3))[tets]
        left, _, right = np.linalg.svd(np.einsum('mki,mkj->mij', moved, gradients))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        gradients = gradients @ np.swapaxes(left @ right, 1, 2)
    volume = mesh.volumes()[:, None, None]
    lam, mu = material.lame_lambda, material.lame_mu
    blocks = np.einsum('mai,mbj->maibj', gradients, gradients)
    dots = mu * np.einsum('mai,mbi->mab', gradients, gradients)
    blocks = lam * blocks + mu * np.swapaxes(blocks, 2, 4)
    blocks += np.einsum('mab,ij->maibj', dots, np.eye(3))
    slots = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    values = volume * blocks.reshape(-1, 12, 12)
    rows, columns = np.broadcast_arrays(slots[:, :, None], slots[:, None, :])
    size = 3 * mesh.node_count
    return csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))
