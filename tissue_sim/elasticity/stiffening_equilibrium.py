"""Newton's method for the stiffening law: assembled tangent, energy that falls with every step.

A difference quotient of forces and full steps lose their way where points of the tissue soften or
turn far. Here each step lowers the energy, so that a stable equilibrium is found.
"""

import contextlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.stiffening import blended_difference, linear_stress

Floats = NDArray[np.float64]

_REACH = 1e-6
"""Step of the central difference of a point's stress."""
_INEXACT = 0.02
"""Share of the residual that a Newton step may leave."""
_REFACTOR = 60
"""Iterations from which the preconditioner is factorised anew."""
_SOFTEST = 1e-3
"""Least eigenvalue of a point's tangent after projection, relative to mu."""
_HALVINGS = 12


@kernel(error_model='numpy')
def _total_stress(h, constants, tolerance, p, linear):
    square = 0.0
    for i in range(9):
        square += h[i] * h[i]
    energy = linear_stress(h, constants, linear)
    if square < tolerance * tolerance:
        p[:] = linear
        return energy
    energy += blended_difference(h, square, constants, tolerance, p, linear)
    for i in range(9):
        p[i] += linear[i]
    return energy


@kernel(error_model='numpy')
def _points(h, volume, constants, tolerance, stress, tangent):
    """Compute stresses [N m], tangents [N m] and the energy [J] of points.

    Args:
        h: displacement gradients, shape (k, 9).
        volume: [m^3], shape (k,).
        constants, tolerance: see `blended_difference`.
        stress: output, shape (k, 9).
        tangent: output, shape (k, 9, 9); empty: not wanted.
    """
    linear, ahead, behind, moved = np.empty(9), np.empty(9), np.empty(9), np.empty(9)
    total = 0.0
    for k in range(h.shape[0]):
        total += volume[k] * _total_stress(h[k], constants, tolerance, stress[k], linear)
        stress[k] *= volume[k]
        if tangent.shape[0] == 0:
            continue
        for j in range(9):
            moved[:] = h[k]
            moved[j] = h[k, j] + _REACH
            _total_stress(moved, constants, tolerance, ahead, linear)
            moved[j] = h[k, j] - _REACH
            _total_stress(moved, constants, tolerance, behind, linear)
            for i in range(9):
                tangent[k, i, j] = volume[k] * (ahead[i] - behind[i]) / (2.0 * _REACH)
    return total


class _Points:
    """Points of one kind: nine components of strain by displacement, volumes and a law."""

    def __init__(
        self, gradient: csr_matrix, volume: Floats, constants: Floats, tolerance: float
    ) -> None:
        along = [gradient[j::3] for j in range(3)]
        self._volume, self._constants, self._tolerance = volume, constants, tolerance
        n = gradient.shape[1]
        rows, columns, values = [], [], []
        for i in range(3):
            for j in range(3):
                d = along[j].tocoo()
                rows.append(9 * d.row.astype(np.int64) + 3 * i + j)
                columns.append(3 * d.col.astype(np.int64) + i)
                values.append(d.data)
        self._operator = csr_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(9 * len(volume), 3 * n),
        )
        self._transposed = self._operator.T.tocsr()

    def evaluate(self, u: Floats, tangent: bool) -> tuple[float, Floats, Floats]:
        """Return energy [J], forces [N] and tangents of the points [J], shape (k, 9, 9)."""
        h = (self._operator @ u).reshape(-1, 9)
        stress = np.empty_like(h)
        change = np.empty((len(h) if tangent else 0, 9, 9))
        energy = _points(h, self._volume, self._constants, self._tolerance, stress, change)
        return energy, self._transposed @ stress.ravel(), change

    def any_inside_out(self, u: Floats) -> bool:
        """Return whether a point has no volume left or is turned inside out."""
        h = (self._operator @ u).reshape(-1, 3, 3)
        return bool((np.linalg.det(np.eye(3) + h) <= 0.0).any())

    def assembled(self, change: Floats, projected: bool) -> csr_matrix:
        """Return the stiffness of tangents, of their positive parts if projected."""
        change = 0.5 * (change + np.swapaxes(change, 1, 2))
        if projected:
            values, vectors = np.linalg.eigh(change)
            least = _SOFTEST * abs(self._constants[:2]).sum() * self._volume
            values = np.maximum(values, least[:, None])
            change = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        k = len(change)
        middle = bsr_matrix((change, np.arange(k), np.arange(k + 1)), shape=(9 * k, 9 * k))
        return (self._transposed @ middle.tocsr() @ self._operator).tocsr()


def _kinds(model: ElasticModel) -> list[_Points]:
    """Return the smoothing domains and the elements of a model."""
    o, mesh = model.operands(), model.mesh
    d, law, n = o.domains, o.law, model.mesh.node_count
    count = len(d.used)
    slot = np.concatenate([np.arange(a, a + c) for a, c in zip(d.start, d.used, strict=True)])
    row = np.repeat(np.arange(count), d.used)
    rows = (3 * row[:, None] + np.arange(3)).ravel()
    columns = np.repeat(d.columns[slot].astype(np.int64) // 3, 3)
    values = d.vectors.reshape(-1, 3)[slot].ravel()
    smooth = csr_matrix((values, (rows, columns)), shape=(3 * count, n))
    tets = mesh.tetrahedra.astype(np.int64)
    edges = np.moveaxis(mesh.rest[tets[:, 1:]] - mesh.rest[tets[:, :1]], 1, 2)
    inner = np.linalg.inv(edges)
    g = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    rows = (3 * np.arange(len(tets))[:, None, None] + np.arange(3)) + np.zeros((1, 4, 1), int)
    columns = np.repeat(tets.ravel(), 3)
    own = csr_matrix((g.ravel(), (rows.ravel(), columns)), shape=(3 * len(tets), n))
    weight = mesh.volumes() * mesh.by_region(model.material.relative_stiffness)
    return [
        _Points(smooth, d.volume.copy(), law.domains, float(law.tolerance[0])),
        _Points(own, weight, law.elements, float(law.tolerance[1])),
    ]


class LawEquilibrium:
    """Equilibria of one mesh with the stiffening law.

    Args:
        model: of the name `stiffening`.
        held: nodes that are moved only by `start`, shape (n,).
    """

    def __init__(self, model: ElasticModel, held: NDArray[np.bool_]) -> None:
        self._kinds = _kinds(model)
        self._free = np.repeat(~held, 3)
        self._factors: SuperLU | None = None

    def _evaluate(
        self, u: Floats, load: Floats, tangent: bool
    ) -> tuple[float, Floats, list[Floats]]:
        """Return potential energy [J], residual at free coordinates [N], tangents."""
        found = [kind.evaluate(u, tangent) for kind in self._kinds]
        energy = sum(f[0] for f in found) - float(load @ u)
        return energy, (load - sum(f[1] for f in found))[self._free], [f[2] for f in found]

    def _stiffness(self, tangents: list[Floats], projected: bool) -> csr_matrix:
        """Return the stiffness of all points; arguments as of `_Points.assembled`."""
        parts = [k.assembled(t, projected) for k, t in zip(self._kinds, tangents, strict=True)]
        return sum(parts[1:], parts[0])

    def _step(self, tangents: list[Floats], out: Floats, projected: bool) -> Floats | None:
        """Return a Newton step, None where the energy is not convex."""
        matrix = self._stiffness(tangents, projected)[self._free][:, self._free].tocsr()
        for attempt in range(2):
            if self._factors is None or attempt:
                self._factors = _factorised(matrix)
                if self._factors is None:  # at the end of a stable path
                    return None
            step, converged = _conjugate_gradients(matrix, out, self._factors.solve)
            if converged:
                return step
        return None

    def find(
        self, load: Floats, start: Floats, *, tolerance: float = 1e-6, iterations: int = 60
    ) -> Floats:
        """Return the displacement under constant forces; arguments as of `equilibrium`.

        Points that are inside out, or wound twice around a node, can hold each other, or leave no
        way on. Then the descent begins again at the shape of a linear tissue, and the end with
        less energy is returned.
        """
        force, found = load.ravel(), []
        with contextlib.suppress(MeshError):
            found.append(self._descend(force, start.ravel().copy(), tolerance, iterations))
        if not found or self._is_held_wrongly(found[0], force):
            try:
                linear = self._linear(force, start)
                found.append(self._descend(force, linear, tolerance, iterations))
            except MeshError:
                if not found:
                    raise
        return min(found, key=lambda u: self._energy(u, force)).reshape(-1, 3)

    def _energy(self, u: Floats, load: Floats) -> float:
        """Return the potential energy [J]."""
        return self._evaluate(u, load, False)[0]

    def _is_held_wrongly(self, u: Floats, load: Floats) -> bool:
        """Return whether points are inside out, or free nodes in their first places have less
        energy.
        """
        if any(kind.any_inside_out(u) for kind in self._kinds):
            return True
        return self._energy(np.where(self._free, 0.0, u), load) < self._energy(u, load)

    def _linear(self, load: Floats, start: Floats) -> Floats:
        """Return the displacement of a linear tissue, held as in `start` [m], shape (3 n,).

        Free nodes keep their first places where its stiffness is singular.
        """
        u = np.where(self._free, 0.0, start.ravel())
        tangents = self._evaluate(np.zeros_like(u), load, True)[2]
        matrix = self._stiffness(tangents, False)
        out = (load - matrix @ u)[self._free]
        if (factors := _factorised(matrix[self._free][:, self._free])) is not None:
            u[self._free] = factors.solve(out)
        return u

    def _descend(self, load: Floats, u: Floats, tolerance: float, iterations: int) -> Floats:
        """Return the end of a path on which the energy falls [m], shape (3 n,)."""
        largest = 0.0
        for _ in range(iterations):
            energy, out, tangents = self._evaluate(u, load, True)
            size = float(np.linalg.norm(out))
            if not np.isfinite(size):
                break
            largest = max(largest, size)
            if size <= tolerance * largest:
                return u
            step = self._step(tangents, out, False)
            if step is None or float(step @ out) <= 0.0:
                step = self._step(tangents, out, True)
            if step is None:
                break
            u = self._along(u, step, energy, float(step @ out), load)
        raise MeshError(
            f'no equilibrium after {iterations} Newton steps: {size / largest:.1e} of the residual '
            'is left; apply the load in smaller parts'
        )

    def _along(self, u: Floats, step: Floats, energy: float, slope: float, load: Floats) -> Floats:
        """Return the place after the longest part of a step that lowers the energy."""
        part = 1.0
        for _ in range(_HALVINGS):
            ahead = u.copy()
            ahead[self._free] += part * step
            there = self._energy(ahead, load)
            # At the end of the convergence rounding is all that changes.
            if there <= energy - 1e-4 * part * slope + 1e-12 * abs(energy):
                return ahead
            part /= 2
        return ahead


def _factorised(matrix: csr_matrix) -> SuperLU | None:
    """Return the factors of a symmetric matrix, None where it is singular."""
    order = {'permc_spec': 'MMD_AT_PLUS_A', 'diag_pivot_thresh': 0.0}
    try:
        return splu(matrix.tocsc(), **order, options={'SymmetricMode': True})
    except RuntimeError:
        return None


def _conjugate_gradients(
    matrix: csr_matrix, right: Floats, precondition: Callable[[Floats], Floats]
) -> tuple[Floats, bool]:
    """Return x with matrix x = right, and whether it was found and the matrix is positive."""
    x = np.zeros_like(right)
    r = right.copy()
    z = precondition(r)
    p, rz = z.copy(), float(r @ z)
    first = float(np.linalg.norm(right))
    for _ in range(_REFACTOR):
        if rz <= 0.0:
            return x, False
        q = matrix @ p
        curvature = float(p @ q)
        if curvature <= 0.0:
            return x, False
        share = rz / curvature
        x += share * p
        r -= share * q
        if float(np.linalg.norm(r)) <= _INEXACT * first:
            return x, True
        z = precondition(r)
        rz, before = float(r @ z), rz
        p = z + (rz / before) * p
    return x, False
