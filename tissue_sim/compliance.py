"""Static compliance of the tissue at a point, refined by a few conjugate-gradient steps a frame."""

import numpy as np
from numba import njit

from tissue_sim.elasticity import ElasticModel, stiffness_product
from tissue_sim.errors import MeshError
from tissue_sim.mesh import grown
from tissue_sim.rings import PATCH, spans_of, without

_AT_MOST = 100_000
"""Conjugate-gradient steps of a static solution: far more than a tissue needs that is held."""
_SETTLED = 1e-5
"""Residual, relative to the load, at which a compliance is known: its error is of second order."""
LIMP = 1e6
"""[m/N] that no tissue reaches: of a piece that nothing holds, in each direction."""


@njit(cache=True, fastmath=True, error_model='numpy')
def _conjugate_gradients(operands, preconditioner, b, x, work, steps, least):
    """Preconditioned conjugate gradients on K x = b from x; the residual is left in work[0].

    They end after some steps, or where the residual, weighed by the preconditioner, is `least`.
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


@njit(cache=True, fastmath=True, error_model='numpy')
def _patch_gradients(operands, spans, preconditioner, b, x, work, steps, least):
    """The same with all nodes outside of some intervals held, at the cost of those inside.

    Apart from the other, whose sums over all coordinates in one loop recorded sessions have.

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
    """Displacement under constant forces, the fixed nodes at rest.

    Args:
        model: the elastic model.
        free: True where a coordinate can move, shape (3 n,).
        load: forces [N], shape (n, 3); those on fixed nodes do not count.
        tolerance: of the residual, relative to the load.

    Returns:
        [m], shape (n, 3).

    Raises:
        MeshError: conjugate gradients did not come to it: a part of the tissue hangs on nothing.
    """
    b = np.where(free, load.ravel(), 0.0)
    x = np.zeros_like(b)
    preconditioner = _diagonal_preconditioner(model.diagonal, free)
    work = np.empty((3, len(b)))
    least = float(preconditioner @ np.square(b)) * tolerance**2
    left = 1.0
    # More than once: the residual that the recursion carries parts from the true one.
    for _ in range(4):
        _conjugate_gradients(model.operands(), preconditioner, b, x, work, _AT_MOST, least)
        residual = np.where(free, b - model.product(x.reshape(-1, 3)).ravel(), 0.0)
        left = float(np.linalg.norm(residual)) / max(float(np.linalg.norm(b)), 1e-300)
        if left <= tolerance:
            return x.reshape(-1, 3)
        least *= 0.01
    raise MeshError(
        f'no equilibrium: {left:.1e} of the load is left, {tolerance:.1e} is asked for; is every '
        'part of the tissue held by fixed nodes?'
    )


def _diagonal_preconditioner(diagonal: np.ndarray, free: np.ndarray) -> np.ndarray:
    return np.where(free, 1.0 / np.maximum(diagonal, 1e-30), 0.0)


class PointCompliance:
    """How far a point of the tissue yields to unit forces: a value that sharpens by the frame.

    The estimate is B.X + X.B - X.K X for the present X: never above the true compliance B.K^-1 B,
    equal to it in the end. The solution is kept while the contact stays near, so a few steps a
    frame suffice. Of a large tissue the PATCH nodes around the point yield, and the rest is held.

    Args:
        steps: conjugate-gradient steps a call and direction; of a large tissue, where what is known
            outlives cuts, no more than twice as many for all directions.

    Attributes:
        calls: since connectivity or number of directions last changed.
    """

    def __init__(self, steps: int = 12) -> None:
        self.calls = 0
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
        moving: np.ndarray | None = None,
    ) -> np.ndarray:
        """Refines and returns the compliance.

        Args:
            model: the elastic model.
            free: True where a coordinate can move, shape (3 n,).
            nodes, weights: that share the force, each once, shape (c,).
            axes: unit vectors, square to each other, along which forces act, shape (d, 3).
            moving: nodes that yield, where others are held whatever acts on them, shape (a,).

        Returns:
            Displacement along axis i for 1 N along axis j [m/N], positive semidefinite,
            shape (d, d). A piece that nothing holds has none: the iteration runs away, and is cut
            off at `LIMP`.
        """
        n = model.mesh.node_count
        if model.mesh.topology != self._topology or len(self._x) != len(axes):
            self._begin(len(axes), n)
            self._topology = model.mesh.topology
            self.calls = 0
        self.calls += 1
        if moving is not None:
            patch = np.union1d(moving, nodes)
        else:
            patch = model.neighbours.around(nodes, 0, PATCH) if n > PATCH else np.arange(n)
        operands = model.operands(patch if len(patch) < n else None)
        at = (3 * patch[:, None] + np.arange(3)).ravel()
        left = without(self._patch, patch)
        self._x.reshape(len(axes), -1, 3)[:, left] = 0.0
        self._patch = patch
        b, preconditioner, work = self._held[0], self._held[1], self._held[2:5]
        preconditioner[at] = _diagonal_preconditioner(model.diagonal[at], free[at])
        loads, residuals = np.empty((2, len(axes), len(at)))
        spans, steps = spans_of(patch), self._steps
        if len(patch) < n:
            steps = min(steps, 2 * steps // len(axes))
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
            self._x = np.zeros((0, 0))  # what it has come to is no start for the next
            return LIMP * np.eye(len(axes))
        sizes, vectors = np.linalg.eigh((value + value.T) / 2)
        return (vectors * np.clip(sizes, 0.0, LIMP)) @ vectors.T

    def _begin(self, axes: int, n: int) -> None:
        """Makes room for so many directions and nodes; in a large tissue what is known stays."""
        if n <= PATCH or len(self._x) != axes:
            self._x, self._held = np.zeros((axes, 3 * n)), np.zeros((5, 3 * n))
            self._patch = np.zeros(0, np.int64)
        elif self._x.shape[1] < 3 * n:
            self._x = grown(self._x.T, 3 * n).T.copy()
            self._held = np.zeros((5, self._x.shape[1]))
