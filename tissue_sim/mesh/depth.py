"""Depth of a blade below the surface of the tissue at rest."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.locate import distances_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]


class SurfaceDepth:
    """Computes depths of a blade below the free surface of a tissue.

    Args:
        tissue: replica; cut faces do not count as surface.
    """

    def __init__(self, tissue: MeshReplica) -> None:
        self._mesh = mesh = TetMesh(tissue.rest, tissue.tetrahedra, tissue.fixed)
        outer = np.array(tissue.triangles[tissue.triangle_kind == 0], mesh.triangles.dtype)
        self._free = outer[~(mesh.fixed[outer] == 1).all(axis=1)]

    def depths(self, blades: Floats) -> Floats:
        """Return the depth of the ends of blades below the surface at rest [m], shape (p,).

        It is the distance of the end from the plane of the triangle by which the blade enters, also
        where it leaves the tissue below; for a blade that is in the tissue as a whole, the distance
        of its end from the surface; 0 outside.

        Args:
            blades: root and end of each [m], shape (p, 2, 3).
        """
        mesh, blades = self._mesh, np.ascontiguousarray(blades)
        out = depths_behind_entry(blades, mesh.rest, self._free)
        other = np.flatnonzero(np.isnan(out))
        ends = np.ascontiguousarray(blades[other, 1])
        found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, ends)
        out[other] = 0.0
        inside = found >= 0
        out[other[inside]] = distances_to_triangles(ends[inside], mesh.rest, self._free)
        return np.asarray(out)


@kernel(error_model='numpy')
def depths_behind_entry(blades, positions, triangles):
    """Return how far ends of blades are behind the first triangle that each blade enters [m].

    A triangle is met where the line through root and end crosses it (Moeller and Trumbore 1997).

    Args:
        blades: root and end of each [m], shape (p, 2, 3).
        positions: [m], shape (n, 3).
        triangles: corners, outward orientation, shape (k, 3).

    Returns:
        Distances from the planes of the triangles, shape (p,); NaN where none is entered.
    """
    out = np.full(len(blades), np.nan)
    for b in range(len(blades)):
        x, y, z = blades[b, 0, 0], blades[b, 0, 1], blades[b, 0, 2]
        wx, wy, wz = blades[b, 1, 0] - x, blades[b, 1, 1] - y, blades[b, 1, 2] - z
        nearest = np.inf
        for t in range(len(triangles)):
            i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            ax, ay, az = positions[i, 0], positions[i, 1], positions[i, 2]
            ux, uy, uz = positions[j, 0] - ax, positions[j, 1] - ay, positions[j, 2] - az
            vx, vy, vz = positions[k, 0] - ax, positions[k, 1] - ay, positions[k, 2] - az
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            inward = -(wx * nx + wy * ny + wz * nz)
            if inward <= 0.0:
                continue
            sx, sy, sz = x - ax, y - ay, z - az
            share = (sx * nx + sy * ny + sz * nz) / inward
            if not 0.0 <= share <= 1.0 or share >= nearest:
                continue
            cx, cy, cz = sy * wz - sz * wy, sz * wx - sx * wz, sx * wy - sy * wx
            one = (vx * cx + vy * cy + vz * cz) / inward
            two = -(ux * cx + uy * cy + uz * cz) / inward
            if one >= 0.0 and two >= 0.0 and one + two <= 1.0:
                nearest = share
                out[b] = (1.0 - share) * inward / np.sqrt(nx * nx + ny * ny + nz * nz)
    return out
