"""Uniform refinement of a mesh."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def refined(mesh: TetMesh) -> TetMesh:
    """Return the mesh with each tetrahedron split into eight at its edge midpoints.

    The octahedron in the middle is split along its shortest diagonal, which preserves the shape
    best. A new node is fixed if both ends of its edge are.

    Args:
        mesh: not changed.
    """
    tets = mesh.tetrahedra.astype(np.int64)
    pairs = np.sort(np.concatenate([tets[:, edge] for edge in _EDGES]), axis=1)
    edges, place = np.unique(pairs, axis=0, return_inverse=True)
    middle = mesh.node_count + place.reshape(6, len(tets)).T
    rest = np.concatenate([mesh.rest, mesh.rest[edges].mean(axis=1)])
    fixed = np.concatenate([mesh.fixed, mesh.fixed[edges].min(axis=1)])
    children, parents = _children(rest, tets, middle)
    return TetMesh(rest, children, fixed, mesh.regions_at(parents))


def _children(
    rest: NDArray[np.float64], tets: NDArray[np.int64], middle: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the eight children of each tetrahedron, positively oriented, and their parents;
    `middle` has the edges in the order of `_EDGES`.
    """
    corners = [
        np.column_stack([tets[:, i], *(middle[:, e] for e, edge in enumerate(_EDGES) if i in edge)])
        for i in range(4)
    ]
    # Opposite edges of a tetrahedron: 0-5, 1-4, 2-3; the others make a ring around a diagonal.
    cycles = {(0, 5): (1, 3, 4, 2), (1, 4): (0, 3, 5, 2), (2, 3): (0, 1, 5, 4)}
    diagonals = np.stack(
        [np.linalg.norm(rest[middle[:, a]] - rest[middle[:, b]], axis=1) for a, b in cycles], axis=1
    )
    shortest = diagonals.argmin(axis=1)
    inner, parents = [], [np.arange(len(tets))] * 4
    for which, ((a, b), ring) in enumerate(cycles.items()):
        at = middle[shortest == which]
        parents += [np.flatnonzero(shortest == which)] * 4
        for i in range(4):
            inner.append(at[:, [a, b, ring[i], ring[(i + 1) % 4]]])
    children = np.concatenate([*corners, *inner])
    p, q, r, s = (rest[children[:, i]] for i in range(4))
    negative = np.einsum('ij,ij->i', np.cross(q - p, r - p), s - p) < 0
    children[negative, 2:] = children[negative, :1:-1]
    return children, np.concatenate(parents)
