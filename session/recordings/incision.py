"""How a cut went, in numbers: lengths, depth, and how far from the plan."""

import numpy as np
from numpy.typing import NDArray

from haptic_bridge.arm_settings import ScriptSettings
from tissue_sim.replica import MeshReplica

Floats = NDArray[np.float64]


def surface_length(tissue: MeshReplica) -> float:
    """Length of the incision on the surface, at rest [m].

    Half of the edges between what was surface before and what a cut has opened: each lip of the
    incision is one of them.
    """
    edges = np.sort(tissue.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    cut = np.repeat(tissue.triangle_kind == 1, 3)
    pairs, number = np.unique(edges, axis=0, return_inverse=True)
    number = number.ravel()
    of_cut = np.bincount(number, cut, len(pairs))
    of_outside = np.bincount(number, ~cut, len(pairs))
    lips = pairs[(of_cut > 0) & (of_outside > 0)]
    ends = tissue.rest[lips]
    return 0.5 * float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def planned_ways(script: ScriptSettings) -> list[Floats]:
    """The way of the tip in each phase that cuts, corner by corner [m], each of shape (k, 3)."""
    ways, here = [], script.start.position
    for phase in script.phases:
        route = [here]
        for _ in range(phase.repeat):
            route += [point.position for point in phase.waypoints]
        if phase.kind == 'cut':
            ways.append(np.array(route, float))
        here = route[-1]
    return ways


def extent(way: Floats) -> float:
    """The farthest two corners of a way are from each other, seen along z [m]."""
    corners = way[:, :2]
    return float(np.linalg.norm(corners[:, None] - corners[None], axis=2).max())


def distance_to_ways(points: Floats, ways: list[Floats]) -> Floats:
    """Distance of each point to the nearest of some ways, seen along z [m], shape (p,)."""
    points = points[:, :2]
    begins = np.concatenate([way[:-1, :2] for way in ways])
    along = np.concatenate([np.diff(way[:, :2], axis=0) for way in ways])
    square = np.maximum((along**2).sum(axis=1), 1e-300)
    nearest = np.full(len(points), np.inf)
    for begin, direction, size in zip(begins, along, square, strict=True):
        share = np.clip((points - begin) @ direction / size, 0.0, 1.0)
        off = np.linalg.norm(points - begin - share[:, None] * direction, axis=1)
        nearest = np.minimum(nearest, off)
    return nearest
