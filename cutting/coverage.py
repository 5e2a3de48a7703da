"""Coverage: whether the mesh has opened the surface that a stroke has swept."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.front import Opened
from cutting_trainer.cutting.swept_surface import Floats, Surface
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.locate import distances_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT

GAP = 1.0
"""Way between two remembered places of the blade from which it was outside between, in edges."""
_STEP = 0.25
"""Way between two places that are looked at, in edges."""
_NEAR = 0.6
"""Distance from the opened faces up to which a place counts as opened, in edges."""
_MIN_AREA = 0.5
"""Closed area that matters, in squared edges."""
_THIN, _SHARES = 0.15, (0.25, 0.5, 0.75, 1.0)
"""Thickness from which on a shaving counts in full, in edges, and shares of it that are looked at:
cut faces lie up to as far off the surface."""


def uncovered_points(mesh: TetMesh, surface: Surface, opened: Opened, h: float) -> Floats:
    """Return the points of a swept surface without an opened face before or behind them.

    Unlike `closed_area`, this finds a strip that is narrower than an edge.

    Args:
        mesh: the tissue.
        surface: swept, away from its borders, where a cut ends within half an edge.
        opened: faces opened by cuts around the stroke.
        h: length of an edge [m].

    Returns:
        In the rest shape [m], shape (k, 3).
    """
    found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, surface.points)
    inside = found >= 0
    points, normals = surface.points[inside], surface.normals[inside]
    earlier = _cuts_around(mesh, points, _NEAR * h)
    new = opened.triangles.astype(earlier.dtype)
    covered = _covered(points, normals, _NEAR * h, opened.rest, new)
    covered |= _covered(points, normals, _NEAR * h, mesh.rest, earlier)
    return points[~covered]


def _cuts_around(mesh: TetMesh, points: Floats, reach: float) -> NDArray[np.integer]:
    """Return the faces of earlier cuts in a box around some points, shape (t, 3).

    Args:
        mesh: the tissue.
        points: at rest [m], shape (p, 3).
        reach: from the points to the sides of the box [m].
    """
    triangles = mesh.triangles[mesh.triangle_kind == CUT]
    if not len(points):
        return triangles[:0]
    corners = mesh.rest[triangles]
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    met = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
    return triangles[met.all(axis=1)]


@kernel
def _covered(points, normals, reach, rest, triangles):
    """Return whether a line through each point meets a triangle, shape (p,).

    Args:
        points: [m], shape (p, 3).
        normals: unit vectors along the lines, shape (p, 3).
        reach: of the lines, before and behind [m].
        rest: nodes [m], shape (n, 3).
        triangles: shape (t, 3).
    """
    covered = np.zeros(len(points), np.bool_)
    away, sides = np.empty((3, 3)), np.empty(3)
    for k in range(len(points)):
        for t in range(len(triangles)):
            least = most = 0.0
            for j in range(3):
                height = 0.0
                for i in range(3):
                    away[j, i] = rest[triangles[t, j], i] - points[k, i]
                    height += away[j, i] * normals[k, i]
                least, most = (
                    (height, height) if j == 0 else (min(least, height), max(most, height))
                )
            if least > reach or most < -reach:
                continue
            for j in range(3):  # signed areas seen along the line: all of one sign inside
                a, b, n = away[j], away[(j + 1) % 3], normals[k]
                sides[j] = (
                    n[0] * (a[1] * b[2] - a[2] * b[1])
                    + n[1] * (a[2] * b[0] - a[0] * b[2])
                    + n[2] * (a[0] * b[1] - a[1] * b[0])
                )
            if sides.min() >= 0.0 or sides.max() <= 0.0:
                covered[k] = True
                break
    return covered


def closed_area(mesh: TetMesh, lines: Floats, opened: Opened, h: float) -> tuple[float, Floats]:
    """Return the swept area that is not opened [m^2], and its middle [m], shape (3,).

    Less than half a squared edge does not matter, and counts as none. Where the blade shaves less
    than 0.15 edges off a side of the tissue, the area counts by the share of that thickness: a
    flake of half an element does not matter.

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
    normals = np.cross(ways, sides).reshape(-1, 3)
    areas = np.linalg.norm(normals, axis=1)
    found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, places)
    outside = np.linalg.norm(along, axis=2).mean(axis=1) > GAP * h
    inside = (found >= 0) & ~np.repeat(outside, count)
    places, areas, normals = places[inside], areas[inside], normals[inside]
    earlier = _cuts_around(mesh, places, _NEAR * h)
    new = opened.triangles.astype(earlier.dtype)
    distance = distances_to_triangles(places, opened.rest, new)
    closed = np.minimum(distance, distances_to_triangles(places, mesh.rest, earlier)) > _NEAR * h
    places, areas, normals = places[closed], areas[closed], normals[closed]
    across = _THIN * h / areas.clip(1e-300)[:, None] * normals
    if areas @ _thickness(mesh, places, across) < _MIN_AREA * h**2:
        return 0.0, np.zeros(3)
    area = float(areas.sum())
    return area, areas @ places / area


def _thickness(mesh: TetMesh, places: Floats, across: Floats) -> Floats:
    """Return how much of a way across a surface is tissue on both of its sides, from 0 to 1, (p,).

    Args:
        mesh: the tissue.
        places: in the rest shape [m], shape (p, 3).
        across: the ways [m], shape (p, 3).
    """
    shares = np.array([*_SHARES, *(-share for share in _SHARES)])[:, None, None]
    around = (places + shares * across).reshape(-1, 3)
    found, _ = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, around)
    both = (found >= 0).reshape(2, len(_SHARES), len(places)).all(axis=0)
    return both.mean(axis=0)
