"""Invariants of a cut (docs/cutting.md), as checks for tests and `trainer fuzz-cuts`."""

import numpy as np

from cutting_trainer.tissue_sim.mesh.checks import components
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT, FACE_NODES


class ViolationError(AssertionError):
    """A violated invariant of a cut."""


def _claim(holds: bool, message: str) -> None:
    if not holds:
        raise ViolationError(message)


def cut_faces(mesh: TetMesh) -> np.ndarray:
    """Return the rest positions of the corners of all cut faces [m], shape (k, 3, 3)."""
    return mesh.rest[mesh.triangles[mesh.triangle_kind == CUT]]


def cut_face_area(mesh: TetMesh) -> float:
    """Return the area of the cut faces at rest, one side [m^2]."""
    corners = cut_faces(mesh)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 4)


def check_area(mesh: TetMesh, area: float) -> None:
    """Check the area of the cut faces [m^2] against the sum of the reports, to 1e-9.

    Raises:
        ViolationError: the difference.
    """
    have = cut_face_area(mesh)
    _claim(
        abs(have - area) <= 1e-9 * max(have, area),
        f'the cut faces have an area of {have:.9g} m^2, reported were {area:.9g} m^2',
    )


def check_mesh(
    mesh: TetMesh, volume: float, old_faces: np.ndarray | None = None, *, tolerance: float = 1e-12
) -> None:
    """Check that a mesh is conforming, positive, free of pinches and orphans, and of given volume.

    Args:
        mesh: after a batch.
        volume: total rest volume [m^3].
        old_faces: `cut_faces` at the start of the stroke; these may be divided on one side only.
        tolerance: relative.

    Raises:
        ViolationError: the violated invariant and its place.
    """
    tets = mesh.tetrahedra.astype(np.int64)
    volumes = mesh.volumes()
    worst = int(volumes.argmin())
    _claim(volumes[worst] > 0, f'tetrahedron {worst} {tets[worst]} has volume {volumes[worst]:.3g}')
    error = abs(volumes.sum() / volume - 1)
    _claim(error < tolerance, f'the volume is off by {error:.3g}')
    used = np.unique(tets)
    _claim(
        len(used) == mesh.node_count and used[-1] == mesh.node_count - 1,
        'a node belongs to no tetrahedron',
    )
    faces = np.sort(tets[:, FACE_NODES].reshape(-1, 3), axis=1)
    unique, inverse, counts = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    _claim(
        counts.max() <= 2, f'face {unique[counts.argmax()]} belongs to {counts.max()} tetrahedra'
    )
    across = _pairs(inverse.ravel(), len(unique)).reshape(-1, 4)
    _claim(bool((across == mesh.neighbors).all()), 'the adjacency differs from a rebuild')
    _check_surface(mesh, tets)
    _check_pinches(tets, across, mesh.node_count)
    _check_hanging(mesh, np.zeros((0, 3, 3)) if old_faces is None else old_faces)


def _pairs(face: np.ndarray, count: int) -> np.ndarray:
    first = np.full(count, -1)
    last = np.full(count, -1)
    index = np.arange(len(face))
    last[face] = index
    first[face[::-1]] = index[::-1]
    other = np.where(first[face] == index, last[face], first[face])
    return np.where(other == index, -1, other)


def _check_surface(mesh: TetMesh, tets: np.ndarray) -> None:
    free = np.argwhere(mesh.neighbors < 0)
    want = np.sort(tets[free[:, :1], FACE_NODES[free[:, 1]]], axis=1)
    have = np.sort(mesh.triangles.astype(np.int64), axis=1)
    _claim(len(have) == len(want), 'the surface has another number of triangles than a rebuild')
    same = want[np.lexsort(want.T)] == have[np.lexsort(have.T)]
    _claim(bool(same.all()), 'the surface differs from a rebuild')


def corner_groups(tets: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the group of each corner, shape (4 m,): corners at a node connected by faces with the
    node.
    """
    tet, face = np.nonzero(across >= 0)
    other = across[tet, face] // 4
    ones, twos = [], []
    for i in range(4):
        for j in range(4):
            same = (i != face) & (tets[tet, i] == tets[other, j])
            ones.append(4 * tet[same] + i)
            twos.append(4 * other[same] + j)
    one, two = np.concatenate(ones), np.concatenate(twos)
    return components(4 * len(tets), np.stack([one, two], axis=1))[1]


def _check_pinches(tets: np.ndarray, across: np.ndarray, nodes: int) -> None:
    groups = corner_groups(tets, across)
    pairs = np.unique(np.stack([tets.ravel(), groups]), axis=1)
    stars = np.bincount(pairs[0], minlength=nodes)
    _claim(stars.max() == 1, f'node {int(stars.argmax())} connects parts that share no face')


def _check_hanging(mesh: TetMesh, old_faces: np.ndarray) -> None:
    """Check that every new cut face has its counterpart on the other side: no node hangs."""
    corners = cut_faces(mesh)
    if len(corners) == 0:
        return
    faces = np.sort(_place_numbers(corners), axis=1)
    _, inverse, counts = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    alone = corners[counts[inverse.ravel()] % 2 == 1].mean(axis=1)
    lost = alone[~_lie_in(alone, old_faces)]
    if len(lost):
        raise ViolationError(f'the cut face at {lost[0]} has no counterpart on the other side')


def _place_numbers(corners: np.ndarray) -> np.ndarray:
    """Return a number for each distinct place, shape (k, 3), of corners (k, 3, 3)."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return number.reshape(-1, 3)


def _lie_in(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return which points, shape (p, 3), lie in one of some triangles, shape (k, 3, 3), within
    rounding.
    """
    if len(points) == 0 or len(triangles) == 0:
        return np.zeros(len(points), bool)
    first = triangles[:, 0]
    normals = np.cross(triangles[:, 1] - first, triangles[:, 2] - first)
    sizes = np.linalg.norm(normals, axis=1)
    distances = points @ normals.T - np.einsum('kj,kj->k', first, normals)
    point, triangle = np.nonzero(np.abs(distances) <= 1e-7 * sizes**1.5)
    corners, normal = triangles[triangle], normals[triangle]
    sides = np.roll(corners, -1, axis=1) - corners
    inward = np.cross(sides, points[point][:, None] - corners)
    along = np.einsum('nij,nj->ni', inward, normal)
    inside = (along >= -1e-7 * sizes[triangle, None] ** 2).all(axis=1)
    return np.bincount(point[inside], minlength=len(points)) > 0


def pieces(mesh: TetMesh) -> np.ndarray:
    """Return the face-connected piece of each tetrahedron, shape (m,)."""
    tet, face = np.nonzero(mesh.neighbors >= 0)
    other = mesh.neighbors[tet, face] // 4
    return components(len(mesh.tetrahedra), np.stack([tet, other], axis=1))[1]
