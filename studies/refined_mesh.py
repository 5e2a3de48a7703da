"""Meshes refined once: each tetrahedron is split into eight of half its size."""

import hashlib
import tempfile
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from cutting_trainer.bags.reader import Bag
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.session.scene_loader import load_scene

_EDGES = np.array(list(combinations(range(4), 2)))
# Corners 0 to 3 and the middles 4 to 9 of the edges 01, 02, 03, 12, 13, 23. The four in the middle
# share the diagonal from 5 to 8 (Bey, Computing 55, 1995, figure 1).
_CHILDREN = np.array(
    [
        [0, 4, 5, 6],
        [4, 1, 7, 8],
        [5, 7, 2, 9],
        [6, 8, 9, 3],
        [4, 5, 6, 8],
        [4, 5, 8, 7],
        [5, 6, 8, 9],
        [5, 7, 9, 8],
    ]
)


def refine(
    points: NDArray[np.float64], tetrahedra: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points [m], shape (n, 3), and tetrahedra, shape (8 m, 4), of a mesh refined once.

    Args:
        points: [m], shape (k, 3).
        tetrahedra: positively oriented, shape (m, 4).
    """
    ends = np.sort(tetrahedra[:, _EDGES], axis=2).reshape(-1, 2)
    edges, of = np.unique(ends, axis=0, return_inverse=True)
    middles = len(points) + of.reshape(len(tetrahedra), len(_EDGES))
    all_points = np.vstack([points, points[edges].mean(axis=1)])
    children = np.hstack([tetrahedra, middles])[:, _CHILDREN].reshape(-1, 4)
    corners = all_points[children]
    sides = corners[:, 1:] - corners[:, :1]
    turned = np.linalg.det(sides) < 0.0
    children[turned] = children[turned][:, [0, 2, 1, 3]]
    return all_points, children


def write_refined(bag: Bag, folder: Path, changes: Mapping[str, str]) -> Path:
    """Write the mesh of a bag's scene refined once; return the file, one for each content.

    Args:
        bag: with the scene.
        folder: where to.
        changes: of the scene by dotted key, in YAML.
    """
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = load_scene(str(restore_scene(bag, Path(temporary), changes)))
        mesh = meshio.read(scene.tissue.mesh)
    cells = mesh.cells_dict['tetra'].astype(np.int64)
    points, children = refine(np.asarray(mesh.points, float), cells)
    labels = {
        name: [np.repeat(np.asarray(by_type['tetra']), 8)]
        for name, by_type in mesh.cell_data_dict.items()
        if 'tetra' in by_type
    }
    digest = hashlib.sha256(points.tobytes() + children.tobytes()).hexdigest()[:12]
    file = folder / f'refined-{digest}.vtk'
    meshio.Mesh(points, [('tetra', children)], cell_data=labels).write(file, file_format='vtk')
    return file
