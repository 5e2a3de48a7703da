"""Coverage: whether the mesh has opened the surface that a stroke has swept."""

import numpy as np

from cutting_trainer.cutting.bridges import GAP
from cutting_trainer.cutting.front import Opened
from cutting_trainer.cutting.parting import Floats
from cutting_trainer.tissue_sim.mesh.locate import distances_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT

_STEP = 0.25
"""Way between two places that are looked at, in edges."""
_NEAR = 0.6
"""Distance from the opened faces up to which a place counts as opened, in edges."""
_MIN_AREA = 0.5
"""Closed area that matters, in squared edges."""


def closed_area(mesh: TetMesh, lines: Floats, opened: Opened, h: float) -> tuple[float, Floats]:
    """Return the swept area that is not opened [m^2], and its middle [m], shape (3,).

    Less than half a squared edge does not matter, and counts as none.

    Args:
        mesh: the tissue.
        lines: the blade's edge along the stroke, root and tip, in the rest shape [m], shape
            (k, 2, 3).
        opened: faces opened by cuts around the stroke.
        h: length of an edge [m].
    """
    if len(opened.triangles):  # slivers are longer than their altitudes say
        sides = np.diff(opened.rest[opened.triangles[:, [0, 1, 2, 0]]], axis=1)
        h = max(h, float(np.median(np.linalg.norm(sides, axis=2))))
    edges = lines[:, 1] - lines[:, 0]
    longest = float(np.linalg.norm(edges, axis=1).max())
    count = int(np.ceil(longest / (_STEP * h)))
    shares = (np.arange(count) + 0.5)[:, None] / count
    along, middles = np.diff(lines, axis=0), (lines[1:] + lines[:-1]) / 2
    places = (middles[:, :1] + shares * np.diff(middles, axis=1)).reshape(-1, 3)
    ways = along[:, :1] + shares * np.diff(along, axis=1)
    sides = np.repeat(np.diff(middles, axis=1) / count, count, axis=1)
    areas = np.linalg.norm(np.cross(ways, sides), axis=2).ravel()
    found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, places)
    outside = np.linalg.norm(along, axis=2).mean(axis=1) > GAP * h
    inside = (found >= 0) & ~np.repeat(outside, count)
    places, areas = places[inside], areas[inside]
    earlier = mesh.triangles[mesh.triangle_kind == CUT]
    new = opened.triangles.astype(earlier.dtype)
    distance = distances_to_triangles(places, opened.rest, new)
    closed = np.minimum(distance, distances_to_triangles(places, mesh.rest, earlier)) > _NEAR * h
    area = float(areas[closed].sum())
    if area < _MIN_AREA * h**2:
        return 0.0, np.zeros(3)
    return area, areas[closed] @ places[closed] / area
