"""Make the meshes of config/meshes: blocks by formula, an organ from a surface by a mesher.

Not part of a session. The mesher is a tool, not a dependency: give it an environment of its own,
see config/meshes/README.md, then run `python mesh_import/make_organ.py FOLDER`.
"""

import argparse
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

GRID_SPACING_M = 0.0015
"""Spacing of the samples from which the organ's surface is extracted."""
EDGE_LENGTH_M = 0.0074
"""Target edge length of the mesher."""
MAX_ATTEMPTS = 8
"""fTetWild is not deterministic: the mesh with the longest stable time step is kept."""

SUSPENDED_EDGES_M = (0.0052, 0.0125)
"""Edges of the graded organ: where it is cut, and from `GRADED_OVER_M` away."""
GRADED_OVER_M = 0.03
CUT_BOX_M = ((-0.046, 0.010), (-0.024, 0.024), 0.016, 0.012)
"""Where it is cut: along x and y, from what height, how deep below the surface."""

PAD_SIZE_M = (0.06, 0.04)
PAD_CELLS = (11, 7)
PAD_HEIGHTS_M = (0.0, 0.006, 0.011, 0.014)
"""Levels of nodes in the pad; the last layer is skin, the others are fat."""
SKIN, FAT = 1, 2
"""Labels of the pad's tetrahedra."""


def pad() -> tuple[Points, NDArray[np.int32], NDArray[np.int32]]:
    """Return a pad of skin on fat: nodes [m], shape (n, 3); tetrahedra and their labels."""
    nodes, tetrahedra = block((*PAD_CELLS, len(PAD_HEIGHTS_M) - 1), 1.0)
    layer = np.rint(nodes[:, 2]).astype(int)
    nodes[:, :2] *= np.array(PAD_SIZE_M) / PAD_CELLS
    nodes[:, 2] = np.array(PAD_HEIGHTS_M)[layer]
    top = layer[tetrahedra].min(axis=1) == len(PAD_HEIGHTS_M) - 2
    return nodes, tetrahedra, np.where(top, SKIN, FAT).astype(np.int32)


LUMPS_M = ((-0.015, -0.012, 0.013), (0.018, -0.003, 0.013), (-0.006, 0.018, 0.013))
"""Centres of the hard lumps in a block."""
LUMP_RADIUS_M = 0.009


def lumpy_block() -> tuple[Points, NDArray[np.int32], NDArray[np.int32]]:
    """Return a block with hidden lumps: nodes [m], shape (n, 3); tetrahedra and their labels."""
    nodes, tetrahedra = block((12, 12, 4), 0.006)
    middles = nodes[tetrahedra].mean(axis=1)
    off = np.linalg.norm(middles[:, None] - np.array(LUMPS_M), axis=2).min(axis=1)
    return nodes, tetrahedra, np.where(off < LUMP_RADIUS_M, 2, 1).astype(np.int32)


def block(cells: tuple[int, int, int], size: float) -> tuple[Points, NDArray[np.int32]]:
    """Return a block of cubes, each split into six tetrahedra around its diagonal (Kuhn).

    Args:
        cells: number of cubes along x, y and z.
        size: edge of a cube [m].

    Returns:
        nodes [m], shape (n, 3), their origin at the centre of the underside; tetrahedra, (m, 4).
    """
    corners = np.stack(np.meshgrid(*(np.arange(c + 1) for c in cells), indexing='ij'), axis=-1)
    shape = corners.shape[:3]
    nodes = (corners.reshape(-1, 3) - [cells[0] / 2, cells[1] / 2, 0]) * size
    origins = np.stack(np.meshgrid(*map(np.arange, cells), indexing='ij'), axis=-1).reshape(-1, 3)
    parts = []
    for order in permutations(range(3)):
        steps = np.cumsum(np.vstack((np.zeros(3, int), np.eye(3, dtype=int)[list(order)])), axis=0)
        path = origins[:, None] + steps
        part = np.ravel_multi_index(tuple(np.moveaxis(path, -1, 0)), shape)
        even = np.linalg.det(np.eye(3)[list(order)]) > 0
        parts.append(part if even else part[:, [0, 1, 3, 2]])
    return nodes, np.concatenate(parts).astype(np.int32)


def liver(points: Points) -> NDArray[np.float64]:
    """Return the approximate signed distance to a solid like a liver [m], negative inside.

    It has two blended lobes, a notch between them in the front edge, and a flat underside at z = 0
    with a rounded rim; about 14 x 9 x 4.5 cm.

    Args:
        points: [m], shape (..., 3).
    """
    right = _ellipsoid(points, (-0.022, 0.0, 0.004), (0.045, 0.045, 0.0405))
    left = _ellipsoid(points, (0.030, 0.006, 0.002), (0.042, 0.032, 0.026))
    notch = _ellipsoid(points, (0.018, -0.042, 0.0), (0.010, 0.016, 0.030))
    lobes = _smooth_minimum(right, left, 0.014)
    notched = -_smooth_minimum(-lobes, notch, 0.008)
    return -_smooth_minimum(-notched, points[..., 2], 0.005)


def suspended_liver(points: Points) -> NDArray[np.float64]:
    """Return the signed distance to a liver with a thinner left lobe, a notch,
    a fossa of the gallbladder and a hollow below, as `liver` does.
    """
    right = _ellipsoid(points, (-0.022, 0.002, 0.004), (0.047, 0.046, 0.0405))
    left = _ellipsoid(points, (0.030, 0.008, 0.003), (0.046, 0.031, 0.023))
    notch = _ellipsoid(points, (0.017, -0.043, 0.0), (0.009, 0.020, 0.040))
    fossa = _ellipsoid(points, (-0.012, -0.046, -0.002), (0.010, 0.016, 0.014))
    hollow = _ellipsoid(points, (0.004, 0.006, -0.006), (0.030, 0.018, 0.013))
    solid = _smooth_minimum(right, left, 0.014)
    for taken, width in ((notch, 0.008), (fossa, 0.005), (hollow, 0.006)):
        solid = -_smooth_minimum(-solid, taken, width)
    return -_smooth_minimum(-solid, points[..., 2], 0.005)


def _edge_lengths(points: Points) -> NDArray[np.float64]:
    """Return the edge lengths of the graded organ at some points [m]."""
    (left, right), (front, back), low, deep = CUT_BOX_M
    x, y, z = np.moveaxis(points, -1, 0)
    away = np.hypot(
        np.maximum(np.maximum(left - x, x - right), 0),
        np.maximum(np.maximum(front - y, y - back), 0),
    )
    below = np.maximum(-suspended_liver(points) - deep, 0) + np.maximum(low - z, 0) / 2
    share = np.clip(np.hypot(away, below) / GRADED_OVER_M, 0, 1)
    fine, coarse = SUSPENDED_EDGES_M
    return np.asarray(fine + (coarse - fine) * share)


def graded_organ() -> tuple[Points, NDArray[np.int32]]:
    """Fill `suspended_liver`, finer where it is cut; return nodes [m] and tetrahedra."""
    vertices, triangles = organ_surface(suspended_liver)
    cells = (35, 26, 17)
    corners, tetrahedra = block(cells, 0.006)
    corners += [0.0025, 0.0, -0.026]
    attempts = (
        _fill(
            vertices, triangles, SUSPENDED_EDGES_M[1],
            bg_vertices=corners, bg_tets=tetrahedra, bg_values=_edge_lengths(corners),
        )
        for _ in range(MAX_ATTEMPTS)
    )  # fmt: skip
    return min(attempts, key=lambda mesh: _stiffest_node(*mesh))


def organ_surface(
    solid: Callable[[Points], NDArray[np.float64]] = liver,
) -> tuple[Points, NDArray[np.int32]]:
    """Return the closed surface of a solid: vertices [m], shape (v, 3); triangles, shape (t, 3)."""
    from skimage.measure import marching_cubes

    low, high = np.array([-0.082, -0.056, -0.006]), np.array([0.086, 0.056, 0.054])
    axes = [np.arange(a, b, GRID_SPACING_M) for a, b in zip(low, high, strict=True)]
    samples = solid(np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1))
    vertices, triangles, _, _ = marching_cubes(samples, 0.0, spacing=(GRID_SPACING_M,) * 3)
    return vertices + low, triangles


def organ() -> tuple[Points, NDArray[np.int32]]:
    """Fill the organ; return nodes [m], shape (n, 3), and tetrahedra, shape (m, 4)."""
    vertices, triangles = organ_surface()
    attempts = (_fill(vertices, triangles) for _ in range(MAX_ATTEMPTS))
    return min(attempts, key=lambda mesh: _stiffest_node(*mesh))


def _fill(
    vertices: Points,
    triangles: NDArray[np.int32],
    edge: float = EDGE_LENGTH_M,
    **sizes: NDArray[Any],
) -> tuple[Points, NDArray[np.int32]]:
    import pytetwild

    nodes, tetrahedra = pytetwild.tetrahedralize(
        vertices,
        triangles,
        edge_length_abs=edge,
        epsilon=0.01,  # 1.7 mm of freedom for the surface, or small elements would follow it
        stop_energy=6.0,
        coarsen=True,
        num_threads=1,
        vtk_ordering=True,
        **sizes,
    )
    underside = _underside(nodes, tetrahedra)
    nodes[underside, 2] = 0.0
    low, high = nodes[underside].min(axis=0), nodes[underside].max(axis=0)
    return nodes - (low + high) / 2, tetrahedra.astype(np.int32)


def _stiffest_node(nodes: Points, tetrahedra: NDArray[np.int32]) -> float:
    """Return the largest nodal stiffness by mass, for unit modulus and density [1/m^2]."""
    edges = np.moveaxis(nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]], 1, 2)
    volumes = np.linalg.det(edges) / 6
    gradients = np.linalg.inv(edges)
    gradients = np.concatenate((-gradients.sum(axis=1, keepdims=True), gradients), axis=1)
    stiffness, mass = np.zeros(len(nodes)), np.zeros(len(nodes))
    np.add.at(stiffness, tetrahedra, volumes[:, None] * (gradients**2).sum(axis=2))
    np.add.at(mass, tetrahedra, volumes[:, None] / 4)
    return float((stiffness / mass).max())


def _underside(nodes: Points, tetrahedra: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return nodes of the surface triangles that face down near z = 0."""
    faces = tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces), axis=0, return_index=True, return_counts=True)
    surface = faces[first[count == 1]]
    a, b, c = (nodes[surface[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    down = normals[:, 2] < -0.9 * np.linalg.norm(normals, axis=1)
    found = np.unique(surface[down])
    return np.asarray(found[nodes[found, 2] < 0.002])


def _ellipsoid(
    points: Points, centre: tuple[float, float, float], radii: tuple[float, float, float]
) -> NDArray[np.float64]:
    scaled = (points - centre) / radii
    norm = np.linalg.norm(scaled, axis=-1)
    slope = np.linalg.norm(scaled / radii, axis=-1)
    return np.asarray(norm * (norm - 1) / np.maximum(slope, 1e-9))


def _smooth_minimum(
    a: NDArray[np.float64], b: NDArray[np.float64], width: float
) -> NDArray[np.float64]:
    """Return the lesser of two, rounded where they differ by less than `width`."""
    blend = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - blend**2 * width / 4


def _write(
    path: Path,
    nodes: Points,
    tetrahedra: NDArray[np.int32],
    labels: NDArray[np.int32] | None = None,
) -> None:
    names = () if labels is None else ('gmsh:physical', 'gmsh:geometrical')
    tags = {name: [labels] for name in names}
    mesh = meshio.Mesh(nodes, [('tetra', tetrahedra)], cell_data=tags)
    mesh.write(path, file_format='gmsh22', binary=False, float_fmt='.7g')
    print(f'{path}: {len(nodes)} nodes, {len(tetrahedra)} tetrahedra')


def main() -> None:
    """Write the meshes into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path, help='where the .msh files go, as config/meshes')
    folder = parser.parse_args().folder
    _write(folder / 'block_yi2007.msh', *block((4, 4, 1), 0.01))
    _write(folder / 'slab.msh', *block((12, 12, 5), 0.008))
    _write(folder / 'flap.msh', *block((12, 5, 3), 0.01 / 3))
    _write(folder / 'pad.msh', *pad())
    _write(folder / 'sheet.msh', *block((24, 24, 1), 0.004))
    _write(folder / 'lumps.msh', *lumpy_block())
    _write(folder / 'liver.msh', *organ())
    _write(folder / 'liver_suspended.msh', *graded_organ())


if __name__ == '__main__':
    main()
