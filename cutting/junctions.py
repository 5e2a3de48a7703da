"""Junctions of strokes: tissue that hangs on where a stroke meets the end of an earlier one.

A front follows the elements, and ends within half an edge or so of where the blade stopped. Where
two strokes meet, each is at its front, and the tissue between may hang on, although the blades have
swept all of it.
"""

import numpy as np

from cutting_trainer.cutting.parting import part_along
from cutting_trainer.cutting.swept_surface import Floats, Ints, Surface, nearest_points
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta

_SPACING = 0.2
_MEET = 0.4
"""Distance between two surfaces that meet, in edges."""
_PARALLEL = 0.7
"""Cosine between the normals of two surfaces from which they are one."""


def part_junctions(
    mesh: TetMesh,
    delta: TopologyDelta,
    nodes: Ints,
    ends: list[Floats],
    earlier: list[Floats],
    h: float,
) -> tuple[TopologyDelta, float]:
    """Part the tissue that hangs on where a stroke meets the ends of earlier ones.

    Args:
        mesh: before the last batch of the stroke.
        delta: that batch.
        nodes: of the mesh, that the stroke has passed, shape (k,).
        ends: the blade's edge along the two ends of the stroke, its end first, in the rest shape
            [m], each shape (k, 2, 3).
        earlier: the same of earlier strokes.
        h: length of an edge [m].

    Returns:
        The batch with the parting, and the further area [m^2].
    """
    area = 0.0
    for one in earlier:
        for two in ends:
            for surface, at in _sheets(one, two, h):
                delta, more = part_along(mesh, delta, nodes, surface, at, h)
                area += more
    return delta, area


def _sheets(one: Floats, two: Floats, h: float) -> list[tuple[Surface, Floats]]:
    """Return the surfaces to be judged where two ends of strokes meet, each with the lines where
    the strokes end, shape (e, 2, 3).
    """
    if (one.max(axis=(0, 1)) < two.min(axis=(0, 1)) - h).any():
        return []
    if (two.max(axis=(0, 1)) < one.min(axis=(0, 1)) - h).any():
        return []
    a, b = _surface(one, h), _surface(two, h)
    if not len(a.points) or not len(b.points):
        return []
    nearest, distance = nearest_points(b, a.points)
    meets = distance < _MEET * h
    if not meets.any():
        return []
    cosine = (a.normals * b.normals[nearest]).sum(axis=1)[meets]
    lines = np.stack([one[0], two[0]])
    if np.abs(cosine).mean() > _PARALLEL:
        if not (_goes_on(one, b, h) and _goes_on(two, a, h)):
            return []
        sign = np.sign(cosine.sum())
        both = Surface(
            np.concatenate([a.points, b.points]), np.concatenate([a.normals, sign * b.normals])
        )
        return [(both, lines)]
    return [
        (within, line[None])
        for within, line in (
            (_inner_part(a, one, b, h), one[0]),
            (_inner_part(b, two, a, h), two[0]),
        )
        if len(within.points)
    ]


def _surface(lines: Floats, h: float) -> Surface:
    """Return points of a swept surface, about equally far from each other."""
    length = float(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).max())
    across = np.linspace(0, 1, int(np.ceil(length / (_SPACING * h))) + 1)
    points = lines[:, :1] + across[:, None] * (lines[:, 1:] - lines[:, :1])
    along = np.gradient(points, axis=0)
    normals = np.cross(along, (lines[:, 1] - lines[:, 0])[:, None])
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    size = np.linalg.norm(normals, axis=1)
    return Surface(points[size > 0], normals[size > 0] / size[size > 0, None])


def _goes_on(lines: Floats, other: Surface, h: float) -> bool:
    """Return whether another surface goes on where a stroke ends."""
    beyond = lines[0] - lines[1]
    beyond = lines[0] + 0.5 * h * beyond / np.linalg.norm(beyond, axis=1)[:, None].clip(1e-12)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    _, distance = nearest_points(other, beyond[0] + share * (beyond[1] - beyond[0]))
    return bool((distance < _MEET * h).mean() > 0.5)


def _inner_part(own: Surface, lines: Floats, other: Surface, h: float) -> Surface:
    """Return the points of a surface that lie before its crossing with another; none if its end
    does not lie beyond.
    """
    places = np.concatenate([own.points, lines[[0, -1]].mean(axis=1)])
    nearest, distance = nearest_points(other, places)
    height = ((places - other.points[nearest]) * other.normals[nearest]).sum(axis=1)
    end, begin = height[-2:]
    if end * begin >= 0.0 or distance.min() > _MEET * h:
        return Surface(own.points[:0], own.normals[:0])
    keep = height[:-2] * np.sign(begin) > -0.1 * h
    return Surface(own.points[keep], own.normals[keep])
