"""Meshes of any resolution for the problems of the chart, and loads on them."""

from collections.abc import Callable
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.reference import Solid
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

PLANE_TOLERANCE_M = 1e-9
"""[m] within which a node lies in a plane."""


def kuhn_block(cells: tuple[int, int, int], size: tuple[float, float, float]) -> TetMesh:
    """Return a block of bricks, six tetrahedra each, all diagonals alike.

    Args:
        cells: bricks along each axis.
        size: of the block [m].
    """
    shape = tuple(c + 1 for c in cells)
    grid = np.argwhere(np.ones(shape))
    index = np.arange(len(grid)).reshape(shape)
    corners = np.argwhere(np.ones(cells))
    parts = []
    for order in permutations(range(3)):
        at = corners.copy()
        path = [index[tuple(at.T)]]
        for axis in order:
            at[:, axis] += 1
            path.append(index[tuple(at.T)])
        even = np.linalg.det(np.eye(3)[list(order)]) > 0
        parts.append(np.stack(path if even else [path[0], path[2], path[1], path[3]], axis=1))
    return TetMesh(grid * (np.array(size) / cells), np.concatenate(parts))


def pressed(mesh: TetMesh, loaded: Bools, pressure: Callable[[Floats], Floats]) -> Floats:
    """Return nodal forces [N], shape (n, 3), of a pressure along -z, by quadrature of degree 5.

    Args:
        mesh: the tissue.
        loaded: which surface triangles, shape (k,).
        pressure: [Pa] at points, shape (p, 3).
    """
    triangles = mesh.triangles[loaded]
    corners = mesh.rest[triangles]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1) / 2
    a, b = (6 - np.sqrt(15)) / 21, (6 + np.sqrt(15)) / 21
    points = [(1 / 3,) * 3, *_turned(a), *_turned(b)]
    weights = [9 / 40, *[(155 - np.sqrt(15)) / 1200] * 3, *[(155 + np.sqrt(15)) / 1200] * 3]
    load = np.zeros_like(mesh.rest)
    for point, weight in zip(points, weights, strict=True):
        shape = np.array(point)
        force = weight * area * pressure(np.einsum('i,tij->tj', shape, corners))
        for i in range(3):
            np.add.at(load[:, 2], triangles[:, i], -shape[i] * force)
    return load


def _turned(a: float) -> list[tuple[float, float, float]]:
    return [(a, a, 1 - 2 * a), (a, 1 - 2 * a, a), (1 - 2 * a, a, a)]


def on_plane(mesh: TetMesh, axis: int, value: float) -> Bools:
    """Return the surface triangles that lie in a plane of constant x, y or z, shape (k,)."""
    return np.asarray(
        (abs(mesh.rest[mesh.triangles][:, :, axis] - value) < PLANE_TOLERANCE_M).all(axis=1)
    )


def beam(solid: Solid, resolution: int) -> TetMesh:
    """Return a beam along x with so many bricks over its depth, clamped at x = 0."""
    cells = tuple(round(s / solid.size[2] * resolution) for s in solid.size)
    whole = kuhn_block((cells[0], cells[1], cells[2]), solid.size)
    return TetMesh(whole.rest, whole.tetrahedra, whole.rest[:, 0] < PLANE_TOLERANCE_M)


def end_load(mesh: TetMesh, solid: Solid, force: float) -> Floats:
    """Return a force [N] along -z spread over the end of a beam; shape (n, 3)."""
    pressure = force / solid.size[1] / solid.size[2]
    end = on_plane(mesh, 0, solid.size[0])
    return pressed(mesh, end, lambda points: np.full(len(points), pressure))
