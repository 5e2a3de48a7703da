"""Indentation loads on a tissue, and the settlement under them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]

WHOLE = 4000
"""Elements nearest to a press that are loaded: farther ones are the same for all models."""
_PLACES = 3
_A, _B = (6 - np.sqrt(15)) / 21, (6 + np.sqrt(15)) / 21
_POINTS = np.array(
    [
        (1 / 3, 1 / 3, 1 / 3),
        *((a, a, 1 - 2 * a) for a in (_A, _B)),
        *((a, 1 - 2 * a, a) for a in (_A, _B)),
        *((1 - 2 * a, a, a) for a in (_A, _B)),
    ]
)
_WEIGHTS = np.array([9 / 40, *[(155 - np.sqrt(15)) / 1200, (155 + np.sqrt(15)) / 1200] * 3])


@dataclass(frozen=True)
class Indenter:
    """A smooth pressure on a round patch of the surface, along its mean normal, 1 N in all.

    Attributes:
        centre: [m], shape (3,).
        radius: of the patch [m].
        direction: unit vector into the tissue, shape (3,).
    """

    centre: Floats
    radius: float
    direction: Floats

    def load(self, mesh: TetMesh) -> Floats:
        """Return nodal forces [N], shape (n, 3), by quadrature of degree 5 over the surface."""
        corners = mesh.rest[mesh.triangles]
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(sides, axis=1) / 2
        points = np.einsum('qi,tij->tqj', _POINTS, corners)
        away = np.linalg.norm(points - self.centre, axis=2) / self.radius
        facing = sides @ self.direction < 0
        pressure = np.where(away < 1, (1 - away**2) ** 2, 0.0) * facing[:, None]
        shares = np.einsum('q,tq,t,qi->ti', _WEIGHTS, pressure, area, _POINTS)
        total = float(shares.sum())
        if total == 0.0:
            raise MeshError(
                f'no surface within {1e3 * self.radius:.3g} mm of {self.centre.tolist()}: '
                'give a larger contact_radius'
            )
        load = np.zeros_like(mesh.rest)
        for i in range(3):
            np.add.at(load, mesh.triangles[:, i], shares[:, i, None] * self.direction / total)
        return load


def places(mesh: TetMesh, radius: float, count: int = _PLACES) -> list[Indenter]:
    """Return indenters far from fixed nodes and far from each other.

    Args:
        mesh: the tissue.
        radius: of the patches, enlarged where elements are larger [m].
        count: number of indenters.
    """
    corners = mesh.rest[mesh.triangles]
    free = (mesh.fixed[mesh.triangles] == 0).all(axis=1)
    if not free.any():
        raise MeshError('every surface triangle has a fixed node: fix fewer nodes to plan a method')
    middles = corners.mean(axis=1)
    held = mesh.rest[mesh.fixed == 1]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    from_held = _distance(middles, held) if len(held) else np.ones(len(middles))
    away = np.where(free, from_held, -1.0)
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    wide = max(radius, edge)
    indenters: list[Indenter] = []
    for _ in range(count):
        chosen = int(away.argmax())
        near = (np.linalg.norm(middles - middles[chosen], axis=1) < wide) & free
        near &= sides @ sides[chosen] > 0
        normal = sides[near].sum(axis=0)
        indenters.append(Indenter(middles[chosen], wide, -normal / np.linalg.norm(normal)))
        reach = np.linalg.norm(middles - middles[chosen], axis=1)
        away = np.where(free, np.minimum(away, reach), -1.0)
    return indenters


def _distance(points: Floats, others: Floats) -> Floats:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[0])


def settlement(model: ElasticModel, load: Floats) -> tuple[float, Floats]:
    """Return the work of a load of 1 N on a linear tissue in equilibrium [m], and the displacement
    [m].
    """
    u = solve_static(model, np.repeat(model.mesh.fixed == 0, 3), load, 1e-6)
    return float(np.sum(load * u)), u


def surroundings(
    mesh: TetMesh, indenter: Indenter, reach: float = np.inf, most: int = WHOLE
) -> TetMesh:
    """Return the elements around an indenter, fixed where they touch others; the mesh itself if
    these are all.

    Args:
        mesh: the whole.
        indenter: at the centre.
        reach: radius of the region [m], at least 1.5 radii of the indenter.
        most: elements at most, if the indenter needs no more.
    """
    middles = mesh.rest[mesh.tetrahedra].mean(axis=1)
    away = np.linalg.norm(middles - indenter.centre, axis=1)
    last = np.partition(away, most - 1)[most - 1] if len(away) > most else np.inf
    kept = away <= min(reach, max(last, 1.5 * indenter.radius))
    if kept.all():
        return mesh
    held = mesh.fixed.copy()
    held[mesh.tetrahedra[~kept].ravel()] = 1
    nodes, tetrahedra = np.unique(mesh.tetrahedra[kept].astype(np.int64), return_inverse=True)
    regions = mesh.regions_at(np.flatnonzero(kept))
    return TetMesh(mesh.rest[nodes], tetrahedra.reshape(-1, 4), held[nodes], regions)
