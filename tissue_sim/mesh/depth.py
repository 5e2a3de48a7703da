"""Depth of points below the surface of the tissue at rest."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.mesh.locate import distances_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]


class SurfaceDepth:
    """Computes depths below the free surface of a tissue.

    Args:
        tissue: replica; cut faces do not count as surface.
    """

    def __init__(self, tissue: MeshReplica) -> None:
        self._mesh = mesh = TetMesh(tissue.rest, tissue.tetrahedra, tissue.fixed)
        outer = np.array(tissue.triangles[tissue.triangle_kind == 0], mesh.triangles.dtype)
        self._free = outer[~(mesh.fixed[outer] == 1).all(axis=1)]

    def depths(self, points: Floats) -> Floats:
        """Return the depth of points below the surface at rest, 0 outside [m], shape (p,).

        Args:
            points: [m], shape (p, 3).
        """
        mesh, points = self._mesh, np.ascontiguousarray(points)
        found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, points)
        out = np.zeros(len(points))
        inside = found >= 0
        out[inside] = distances_to_triangles(points[inside], mesh.rest, self._free)
        return out
