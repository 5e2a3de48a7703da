"""Error of a tool's footprint on a mesh: too wide for its elements, on a surface that is not flat.

The tool is the sphere whose footprint at the required depth is the area that the budget names. The
coupling spring has the settlement of a flat half-space under it (docs/method.md). Two things are
not in it: what a disc widened to the size of the elements leaves out of the rest of the tissue, and
the curvature of the surface.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from cutting_trainer.tissue_sim.contact.footprint import RESOLVED, SETTLEMENT, WIDENING, node_sizes
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.refine import refined
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.indentation import Indenter, settlement, surroundings

Floats = NDArray[np.float64]

_NEAR = 1500
"""Elements nearest to the tool, which are split into eight."""


def contact_error(
    mesh: TetMesh,
    material: Material,
    indenter: Indenter,
    depth: float,
    settled: Callable[[Indenter], float] | None = None,
) -> float:
    """Return the error of the tool's depth under a given force, relative to that depth [-].

    Args:
        mesh: the tissue.
        material: its constants.
        indenter: place, and radius of the footprint at that depth.
        depth: of the tool [m].
        settled: settlement of the tissue by force [m/N]; None: of smoothed elements half as large.
    """
    around = surroundings(mesh, indenter, most=_NEAR)
    near = np.linalg.norm(around.rest - indenter.centre, axis=1) < indenter.radius
    edge = float(np.median(node_sizes(around)[near])) if near.any() else 0.0
    hertz = indenter.radius / WIDENING
    radius = hertz**2 / depth
    true, wide = max(indenter.radius, RESOLVED * edge / 2), max(indenter.radius, RESOLVED * edge)
    if settled is None:
        model = ElasticModel(refined(around), material, 'linear_smoothed')

        def settled(disc: Indenter) -> float:
            return settlement(model, disc.load(model.mesh))[0]

    discs = [Indenter(indenter.centre, b, indenter.direction) for b in sorted({true, wide})]
    modulus = material.plane_modulus
    rest = [
        settled(disc) - SETTLEMENT / (modulus * disc.radius) for disc in discs
    ]  # compliance of the tissue beyond a half-space [m/N]

    def left(force: float) -> float:
        return depth - force * max(rest[0], 0.0) - _sphere(force, modulus, radius)

    force = float(brentq(left, 0.0, 1.4 * modulus * np.sqrt(radius) * depth**1.5))
    curved = abs(curvature(mesh, indenter)) * radius / 3 * _sphere(force, modulus, radius)
    return (abs(rest[-1] - rest[0]) * force + curved) / depth


def _sphere(force: float, modulus: float, radius: float) -> float:
    """Return Hertz's settlement under a sphere [m]: in proportion to radius^(-1/3)."""
    return float(np.cbrt(9 * force**2 / (16 * modulus**2 * radius)))


def curvature(mesh: TetMesh, indenter: Indenter) -> float:
    """Return the mean curvature of the surface under an indenter [1/m], above 0 on a dome.

    It is the change of the normal with the place, by least squares.
    """
    corners = mesh.rest[mesh.triangles]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = sides / np.linalg.norm(sides, axis=1)[:, None]
    places = corners.mean(axis=1) - indenter.centre
    near = (np.linalg.norm(places, axis=1) < 2 * indenter.radius) & (
        normals @ indenter.direction < -0.5
    )
    if near.sum() < 3:
        return 0.0
    weight = np.linalg.norm(sides[near], axis=1) / 2
    x, n = (v[near] - np.average(v[near], axis=0, weights=weight) for v in (places, normals))
    across = np.eye(3) - np.outer(indenter.direction, indenter.direction)
    x, n = x @ across, n @ across
    spread = float(weight @ np.square(x).sum(axis=1))
    return float(weight @ (x * n).sum(axis=1)) / spread if spread > 0.0 else 0.0
