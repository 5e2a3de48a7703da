"""Relaxation of far nodes along the forces that the unknowns of the coarse grid cannot answer.

The unknowns carry the smooth part of the far field, and steps of descent find the rest, as the
smoother of a multigrid method does (Brandt 1977). They only take energy away, and no velocity is
given.
"""

import math

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown
from cutting_trainer.tissue_sim.motion.coarse_grid import CoarseGrid

_SWEEPS, _RANGE = 4, 20.0
"""Steps of a relaxation, and ratio of the greatest to the least squared frequency that they are
for: a third at most is left of a shape within it."""


def _chebyshev(sweeps: int, ratio: float) -> tuple[float, ...]:
    """Return the lengths of descent whose product is smallest over a range of stiffness (Young
    1953), relative to the reciprocal of the greatest.
    """
    middle, half = (1 + 1 / ratio) / 2, (1 - 1 / ratio) / 2
    angles = (math.pi * (2 * k + 1) / (2 * sweeps) for k in range(sweeps))
    return tuple(1 / (middle + half * math.cos(angle)) for angle in angles)


LENGTHS = _chebyshev(_SWEEPS, _RANGE)
"""Of the steps, relative to that of steepest descent."""


@kernel
def gathered(far, columns, weights, values, width, out):
    """Add the nodes' values times their weights to those of the unknowns.

    Args:
        far: nodes, shape (k,).
        columns, weights: see `CoarseGrid`.
        values: so many numbers for each node, shape (width n,).
        width: of these.
        out: shape (width c,).
    """
    for node in far:
        for k in range(8):
            w = weights[node, k]
            if w > 0.0:
                for i in range(width):
                    out[width * columns[node, k] + i] += w * values[width * node + i]


@kernel
def _descend(far, columns, weights, u, force, pull, inverse_mass, squared):
    """Move far nodes along the acceleration that the unknowns do not have.

    Args:
        far: nodes, shape (k,).
        columns, weights: see `CoarseGrid`.
        u: displacement [m], changed, shape (3 n,).
        force: elastic force [N], shape (3 n,).
        pull: that on the unknowns over their mass [m/s^2], shape (3 c,).
        inverse_mass: by coordinate [1/kg], shape (3 n,).
        squared: displacement by an acceleration [s^2].
    """
    for node in far:
        for i in range(3):
            own = force[3 * node + i] * inverse_mass[3 * node + i]
            for k in range(8):
                w = weights[node, k]
                if w > 0.0:
                    own -= w * pull[3 * columns[node, k] + i]
            u[3 * node + i] -= squared * own


def descend(
    grid: CoarseGrid,
    nodes: np.ndarray,
    mass: np.ndarray,
    u: np.ndarray,
    force: np.ndarray,
    inverse_mass: np.ndarray,
    squared: float,
) -> None:
    """Move far nodes by one step.

    Args:
        grid: of the unknowns.
        nodes: that move, shape (k,).
        mass: of the unknowns [kg], shape (<= c,).
        u: displacement [m], changed, shape (>= 3 n,).
        force: elastic force there [N], shape (n, 3).
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        squared: displacement by an acceleration [s^2].
    """
    arrays, flat = (nodes, grid.columns, grid.weights), force.reshape(-1)
    pull = np.zeros((grid.count, 3))
    gathered(*arrays, flat, 3, pull.reshape(-1))
    mass = grown(mass, grid.count)[: grid.count, None]
    pull = np.where(mass > 0.0, pull / np.maximum(mass, 1e-300), 0.0)
    _descend(*arrays, u, flat, pull.reshape(-1), inverse_mass, squared)
