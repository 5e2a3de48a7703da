"""Static compliance of the tissue at a point, refined by conjugate gradients frame by frame."""

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, stiffness_product
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.adjacency import PATCH, spans_of, without
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown

_MAX_ITERATIONS = 100_000
"""Conjugate-gradient steps of a static solution: far more than a held tissue needs."""
_SETTLED = 1e-5
"""Residual, relative to the load, of a converged compliance: its error is of second order."""
MAX_COMPLIANCE = 1e6
"""[m/N] above any tissue: the compliance of an unattached piece, in each direction."""


@kernel(fastmath=True, error_model='numpy')
def _conjugate_gradients(operands, preconditioner, b, x, work, steps, least):
    """Solve K x = b from x by preconditioned conjugate gradients; the residual is left in work[0].

    The iteration ends after some steps, or at a preconditioned residual of `least`.
    """
    r, p, q = work[0], work[1], work[2]
    stiffness_product(operands, x, q)
    rho = 0.0
    for i in range(x.shape[0]):
        free = preconditioner[i] > 0.0
        r[i] = b[i] - q[i] if free else 0.0
        p[i] = preconditioner[i] * r[i]
        rho += r[i] * p[i]
    for _ in range(steps):
        if rho <= least:
            break
        stiffness_product(operands, p, q)
        curvature = 0.0
        for i in range(x.shape[0]):
            curvature += p[i] * q[i]
        if curvature <= 0.0:
            break
        step = rho / curvature
        after = 0.0
        for i in range(x.shape[0]):
            x[i] += step * p[i]
            if preconditioner[i] > 0.0:
                r[i] -= step * q[i]
            after += preconditioner[i] * r[i] * r[i]
        for i in range(x.shape[0]):
            p[i] = preconditioner[i] * r[i] + after / rho * p[i]
        rho = after


@kernel(fastmath=True, error_model='numpy')
def _patch_gradients(operands, spans, preconditioner, b, x, work, steps, least):
    """Solve the same with all nodes outside some intervals held, at the cost of the nodes inside.

    It is separate because recorded sessions depend on the other's sums over all coordinates in one
    loop.

    Args:
        spans: intervals of nodes, shape (s, 2); x is 0 outside of them.
    """
    r, p, q = work[0], work[1], work[2]
    for s in range(operands.reach.shape[0]):
        p[3 * operands.reach[s, 0] : 3 * operands.reach[s, 1]] = 0.0
    stiffness_product(operands, x, q)
    rho = 0.0
    for s in range(spans.shape[0]):
        for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
            r[i] = b[i] - q[i] if preconditioner[i] > 0.0 else 0.0
            p[i] = preconditioner[i] * r[i]
            rho += r[i] * p[i]
    for _ in range(steps):
        if rho <= least:
            break
        stiffness_product(operands, p, q)
        curvature = 0.0
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                curvature += p[i] * q[i]
        if curvature <= 0.0:
            break
        step = rho / curvature
        after = 0.0
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                x[i] += step * p[i]
                r[i] -= step * q[i] if preconditioner[i] > 0.0 else 0.0
                after += preconditioner[i] * r[i] * r[i]
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                p[i] = preconditioner[i] * r[i] + after / rho * p[i]
        rho = after


def solve_static(
    model: ElasticModel, free: np.ndarray, load: np.ndarray, tolerance: float = 1e-12
) -> np.ndarray:
    """Return the displacement under constant forces, with the fixed nodes at rest.

    Args:
        model: the elastic model.
        free: True where a coordinate can move, shape (3 n,).
        load: forces [N], shape (n, 3); those on fixed nodes are ignored.
        tolerance: of the residual, relative to the load.

    Returns:
        [m], shape (n, 3).

    Raises:
        MeshError: conjugate gradients did not converge: a part of the tissue is not held.
    """
    b = np.where(free, load.ravel(), 0.0)
    x = np.zeros_like(b)
    preconditioner = _diagonal_preconditioner(model.diagonal, free)
    work = np.empty((3, len(b)))
    least = float(preconditioner @ np.square(b)) * tolerance**2
    left = 1.0
    # Restarted: the residual of the recursion drifts away from the true one.
    for _ in range(4):
        _conjugate_gradients(model.operands(), preconditioner, b, x, work, _MAX_ITERATIONS, least)
        residual = np.where(free, b - model.product(x.reshape(-1, 3)).ravel(), 0.0)
        left = float(np.linalg.norm(residual)) / max(float(np.linalg.norm(b)), 1e-300)
        if left <= tolerance:
            return x.reshape(-1, 3)
        least *= 0.01
    raise MeshError(
        f'no equilibrium: {left:.1e} of the load is left, {tolerance:.1e} is asked for; is every '
        'part of the tissue held by fixed nodes?'
    )


def solve_within(
    operands: Operands,
    spans: np.ndarray,
    diagonal: np.ndarray,
    load: np.ndarray,
    tolerance: float = 1e-6,
) -> np.ndarray:
    """Return the displacement of a linear part under constant forces, all others held.

    Args:
        operands: of the part, such as those of a far field with its unknowns.
        spans: intervals of its nodes and unknowns, shape (s, 2).
        diagonal: of the stiffness, 0 where a coordinate cannot move [N/m], shape (c,).
        load: forces [N], shape (c,).
        tolerance: of the residual, relative to the load.

    Returns:
        [m], shape (c,); 0 outside of the spans.
    """
    preconditioner = _diagonal_preconditioner(diagonal, diagonal > 0.0)
    x, work = np.zeros_like(load), np.zeros((3, len(load)))
    least = float(preconditioner @ np.square(load)) * tolerance**2
    _patch_gradients(operands, spans, preconditioner, load, x, work, _MAX_ITERATIONS, least)
    return x


def _diagonal_preconditioner(diagonal: np.ndarray, free: np.ndarray) -> np.ndarray:
    return np.where(free, 1.0 / np.maximum(diagonal, 1e-30), 0.0)


class PointCompliance:
    """Compliance of a point of the tissue, refined frame by frame.

    The estimate is B.X + X.B - X.K X for the present X. It is never above the true compliance
    B.K^-1 B and converges to it. The solution is kept while the contact stays near, and over cuts,
    so a few steps per frame suffice. In a large tissue only the PATCH nodes around the point yield,
    and the others are held.

    Args:
        steps: conjugate-gradient steps per call and direction. In a large tissue and with a law,
            they are shared by the directions.
        most: nodes that yield in a large tissue.

    Attributes:
        calls: since the last change of connectivity or number of directions.
    """

    def __init__(self, steps: int = 12, most: int = PATCH) -> None:
        self.calls = 0
        self._most = most
        self._steps = steps
        self._x = np.zeros((0, 0))
        self._held = np.zeros((0, 0))
        self._patch = np.zeros(0, np.int64)
        self._topology = -1

    def estimate(
        self,
        model: ElasticModel,
        free: np.ndarray,
        nodes: np.ndarray,
        weights: np.ndarray,
        axes: np.ndarray,
    ) -> np.ndarray:
        """Refine and return the compliance.

        Args:
            model: the elastic model.
            free: True where a coordinate can move, shape (3 n,).
            nodes, weights: that share the force, each once, shape (c,).
            axes: unit vectors, square to each other, along which forces act, shape (d, 3).

        Returns:
            Displacement along axis i for 1 N along axis j [m/N], positive semidefinite,
            shape (d, d). An unattached piece has none: the iteration diverges, and is cut off at
            `MAX_COMPLIANCE`.
        """
        n = model.mesh.node_count
        if model.mesh.topology != self._topology or len(self._x) != len(axes):
            self._begin(len(axes), n)
            self._topology = model.mesh.topology
            self.calls = 0
        self.calls += 1
        patch = model.neighbours.around(nodes, 0, self._most) if n > self._most else np.arange(n)
        operands = model.operands(patch if len(patch) < n else None)
        at = (3 * patch[:, None] + np.arange(3)).ravel()
        left = without(self._patch, patch)
        self._x.reshape(len(axes), -1, 3)[:, left] = 0.0
        self._patch = patch
        b, preconditioner, work = self._held[0], self._held[1], self._held[2:5]
        preconditioner[at] = _diagonal_preconditioner(model.diagonal[at], free[at])
        loads, residuals = np.empty((2, len(axes), len(at)))
        spans, steps = spans_of(patch), self._steps
        if len(patch) < n or model.lawful:
            steps //= len(axes)
        for axis, load, x, residual in zip(axes, loads, self._x, residuals, strict=True):
            b[at] = 0.0
            b.reshape(-1, 3)[nodes] = weights[:, None] * axis
            b[at] = np.where(free[at], b[at], 0.0)
            load[:] = b[at]
            least = float((preconditioner[at] * np.square(load)).sum()) * _SETTLED**2
            x[at] *= free[at]
            if len(patch) == n:
                _conjugate_gradients(operands, preconditioner, b, x, work, steps, least)
            else:
                _patch_gradients(operands, spans, preconditioner, b, x, work, steps, least)
            residual[:] = work[0][at]
        x = np.ascontiguousarray(self._x[:, at])
        value = np.einsum('ai,bi->ab', loads, x) + np.einsum('ai,bi->ab', x, residuals)
        if not np.isfinite(value).all():
            self._x = np.zeros((0, 0))  # a diverged solution is no start for the next
            return MAX_COMPLIANCE * np.eye(len(axes))
        sizes, vectors = np.linalg.eigh((value + value.T) / 2)
        return (vectors * np.clip(sizes, 0.0, MAX_COMPLIANCE)) @ vectors.T

    def _begin(self, axes: int, n: int) -> None:
        """Allocate directions and nodes; the solution so far stays."""
        if len(self._x) != axes:
            self._x, self._patch = np.zeros((axes, 0)), np.zeros(0, np.int64)
        known = self._x.shape[1]
        if n <= self._most and known != 3 * n:
            x = np.zeros((axes, 3 * n))
            x[:, : min(known, 3 * n)] = self._x[:, : 3 * n]
            self._x, self._patch = x, self._patch[self._patch < n]
        elif known < 3 * n:
            self._x = grown(self._x.T, 3 * n).T.copy()
        if self._held.shape[1] != self._x.shape[1]:
            self._held = np.zeros((5, self._x.shape[1]))
