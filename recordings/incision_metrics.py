"""Measures of an incision: lengths, and distance from the plan."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.opened_tissue import distance_to_line
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ScriptSettings
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]


def surface_length(tissue: MeshReplica | TetMesh) -> float:
    """Return the length of the incision on the surface, at rest [m].

    It is half of the length of all edges between the outer surface and cut faces, because each edge
    of the incision appears on both sides.
    """
    edges = np.sort(tissue.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    cut = np.repeat(tissue.triangle_kind == 1, 3)
    pairs, number = np.unique(edges, axis=0, return_inverse=True)
    number = number.ravel()
    of_cut = np.bincount(number, cut, len(pairs))
    of_outside = np.bincount(number, ~cut, len(pairs))
    borders = pairs[(of_cut > 0) & (of_outside > 0)]
    ends = tissue.rest[borders]
    return 0.5 * float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def planned_paths(script: ScriptSettings) -> list[Floats]:
    """Return the path of the tip in each phase that cuts, as corners [m], each of shape (k, 3)."""
    paths, here = [], script.start.position
    for phase in script.phases:
        route = [here]
        for _ in range(phase.repeat):
            route += [point.position for point in phase.waypoints]
        if phase.kind == 'cut':
            paths.append(np.array(route, float))
        here = route[-1]
    return paths


def extent(path: Floats) -> float:
    """Return the largest distance between two corners of a path, seen along z [m]."""
    corners = path[:, :2]
    return float(np.linalg.norm(corners[:, None] - corners[None], axis=2).max())


def distance_to_paths(points: Floats, paths: list[Floats]) -> Floats:
    """Return the distance of each point to the nearest path, seen along z [m], shape (p,)."""
    seen = [distance_to_line(points[:, :2], path[:, :2]) for path in paths]
    return np.asarray(np.min(seen, axis=0))
