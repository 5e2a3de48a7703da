"""Static equilibrium of any elastic model, by Newton's method with conjugate gradients."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, cg, splu

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.stiffening_equilibrium import LawEquilibrium

Floats = NDArray[np.float64]


_REACH = 1e-6
"""Step of the finite difference for a tangent, relative to the tissue's length."""
_INEXACT = 0.02
"""Share of the residual that a Newton step may leave."""
_FACTORISED = 20_000
"""Unknowns up to which the preconditioner is factorised."""


def equilibrium(
    model: ElasticModel,
    load: Floats,
    *,
    held: NDArray[np.bool_] | None = None,
    start: Floats | None = None,
    tolerance: float = 1e-6,
    iterations: int = 60,
    force: Callable[[Floats], Floats] | None = None,
) -> Floats:
    """Return the displacement under constant forces.

    The tangent is a difference of two forces, so any model will do; for a linear one it is exact.
    The stiffening law has its own method (`LawEquilibrium`) where its force is the model's own.

    Args:
        model: the elastic model.
        load: [N], shape (n, 3); forces on held nodes are ignored.
        held: nodes that keep their displacement in `start`, shape (n,); by default the mesh's fixed
            ones.
        start: initial displacement [m], shape (n, 3); by default zero.
        tolerance: of the residual, relative to the largest one met.
        iterations: Newton steps at most.
        force: elastic force [N] of a displacement [m], both shape (n, 3); by default the model's.

    Returns:
        [m], shape (n, 3).

    Raises:
        MeshError: no equilibrium was found.
    """
    mesh = model.mesh
    held = mesh.fixed == 1 if held is None else held
    if model.lawful and force is None:
        first = np.zeros_like(mesh.rest) if start is None else start
        law, own = LawEquilibrium(model, held), model.load
        forces = load + own.reshape(-1, 3) if len(own) else load
        return law.find(forces, first, tolerance=tolerance, iterations=iterations)
    free = np.repeat(~held, 3)
    u = np.zeros(3 * mesh.node_count) if start is None else start.ravel().copy()
    resisting = force or model.force
    scale = _REACH * float(np.linalg.norm(np.ptp(mesh.rest, axis=0)))
    largest = 0.0

    def residual(at: Floats) -> Floats:
        return np.asarray((load - resisting(at.reshape(-1, 3))).ravel()[free])

    out = residual(u)
    for _ in range(iterations):
        size = float(np.linalg.norm(out))
        if not np.isfinite(size):
            raise MeshError('no equilibrium: the tissue gives way; apply the load in smaller parts')
        largest = max(largest, size)
        if size <= tolerance * largest:
            return u.reshape(-1, 3)
        step = _newton_step(residual, u, free, out, preconditioner(model, u, free), scale)
        # Full steps: along a curved path the residual grows before it falls.
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
    """Return a solver with the plain elements' stiffness under their present rotations, or its
    diagonal.

    Conjugate gradients need it where a slender part has rotated.

    Args:
        model: its mesh and material are used.
        u: displacement by coordinate [m], shape (3 n,).
        free: True where a coordinate can move, shape (3 n,).
    """
    count = int(free.sum())
    if count > _FACTORISED:
        weight = 1.0 / np.maximum(model.diagonal[free], 1e-30)
        return LinearOperator((count, count), matvec=lambda x: weight * x, dtype=float)
    factors = splu(rotated_stiffness(model, u)[free][:, free].tocsc())
    return LinearOperator((count, count), matvec=factors.solve, dtype=float)


def rotated_stiffness(model: ElasticModel, u: Floats) -> csr_matrix:
    """Return the stiffness of plain elements [N/m], rotated with the tissue if the model rotates.

    Args:
        model: its mesh and material are used.
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
    volume = (mesh.volumes() * mesh.by_region(material.relative_stiffness))[:, None, None]
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
