"""How far a mesh is wrong: loads on its surface, solved on it and on one twice as fine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tissue_sim.compliance import solve_static
from tissue_sim.elasticity import ElasticModel, ModelName
from tissue_sim.equilibrium import equilibrium
from tissue_sim.errors import MeshError
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.refine import refined

Floats = NDArray[np.float64]

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
class Press:
    """A smooth pressure on a round patch of the surface, along its mean normal, 1 N in all.

    Attributes:
        centre: [m], shape (3,).
        radius: beyond which there is none [m].
        direction: unit vector into the tissue, shape (3,).
    """

    centre: Floats
    radius: float
    direction: Floats

    def load(self, mesh: TetMesh) -> Floats:
        """Nodal forces [N], shape (n, 3), by quadrature of degree 5 over the surface."""
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


@dataclass(frozen=True)
class Probing:
    """What the loads came to.

    Attributes:
        elements: largest relative error of the settlement by the size of the elements, of plain
            and of smoothed ones [-].
        depth: relative change of the settlement by what a linear model leaves out, when it is as
            deep as asked; infinite where the tissue gave way before [-].
        frequency: of the slowest motion that a load excites [rad/s], at most.
    """

    elements: dict[bool, float]
    depth: float
    frequency: float


def places(mesh: TetMesh, radius: float, count: int = _PLACES) -> list[Press]:
    """Where to press: far from what is fixed, and far from each other.

    Args:
        mesh: the tissue.
        radius: of the patches, enlarged where the elements are larger than it [m].
        count: how many.
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
    presses: list[Press] = []
    for _ in range(count):
        chosen = int(away.argmax())
        near = (np.linalg.norm(middles - middles[chosen], axis=1) < wide) & free
        near &= sides @ sides[chosen] > 0
        normal = sides[near].sum(axis=0)
        presses.append(Press(middles[chosen], wide, -normal / np.linalg.norm(normal)))
        reach = np.linalg.norm(middles - middles[chosen], axis=1)
        away = np.where(free, np.minimum(away, reach), -1.0)
    return presses


def _distance(points: Floats, others: Floats) -> Floats:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[0])


def settlement(model: ElasticModel, load: Floats) -> tuple[float, Floats]:
    """Work of a load of 1 N on a linear tissue at rest under it [m], and displacement [m]."""
    u = solve_static(model, np.repeat(model.mesh.fixed == 0, 3), load, 1e-6)
    return float(np.sum(load * u)), u


def probe(mesh: TetMesh, material: Material, radius: float, displacement: float) -> Probing:
    """Presses a tissue at some places.

    Args:
        mesh: the tissue.
        material: its constants.
        radius: of the area that a tool loads [m].
        displacement: how deep it goes [m].
    """
    fine = refined(mesh)
    names: dict[bool, ModelName] = {False: 'linear', True: 'linear_smoothed'}
    here = {smoothed: ElasticModel(mesh, material, name) for smoothed, name in names.items()}
    there = {smoothed: ElasticModel(fine, material, name) for smoothed, name in names.items()}
    errors: dict[bool, list[float]] = {False: [], True: []}
    softest, slowest = (0.0, np.zeros(0)), np.inf
    for press in places(mesh, radius):
        load, finer = press.load(mesh), press.load(fine)
        coarse = {smoothed: settlement(model, load) for smoothed, model in here.items()}
        half = {smoothed: settlement(model, finer)[0] for smoothed, model in there.items()}
        # Both converge to the same: plain elements from below, smoothed ones nearer by far.
        limits = [half[s] + (half[s] - coarse[s][0]) / 3 for s in names]
        for smoothed in names:
            value = coarse[smoothed][0]
            errors[smoothed].append(max(abs(value / limit - 1) for limit in limits))
        value, u = coarse[True]
        if value > softest[0]:
            softest = (value, load)
        inertia = float(here[True].mass @ np.square(u).sum(axis=1))
        slowest = min(slowest, float(np.sqrt(value / inertia)))
    return Probing(
        {smoothed: max(found) for smoothed, found in errors.items()},
        _depth(mesh, material, softest, displacement),
        slowest,
    )


def _depth(
    mesh: TetMesh, material: Material, softest: tuple[float, Floats], displacement: float
) -> float:
    value, load = softest
    force = displacement / value
    model = ElasticModel(mesh, material, 'corotational_smoothed')
    u = np.zeros_like(mesh.rest)
    try:
        for share in (0.25, 0.5, 0.75, 1.0):
            u = equilibrium(model, share * force * load, start=u, tolerance=1e-4, iterations=25)
    except MeshError:
        return float('inf')
    return abs(displacement / float(np.sum(load * u)) - 1)
