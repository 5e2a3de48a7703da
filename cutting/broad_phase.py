"""Broad phase: the tetrahedra met by a sweep, found by neighbours after first contact (thesis
5.4).
"""

import numpy as np

from cutting_trainer.cutting.geometry import sweep_meets
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh


def quad(sweep: Sweep) -> np.ndarray:
    """Return the corners of a sweep in order around it [m], shape (4, 3)."""
    return np.array([sweep.root_from, sweep.tip_from, sweep.tip_to, sweep.root_to])


@kernel
def _spread(corners, positions, tetrahedra, first_corner, corner_next, seeds):
    """Return the met tetrahedra connected by nodes with met seeds."""
    met = [np.int64(0) for _ in range(0)]
    state = {}
    queue = [np.int64(s) for s in seeds]
    for s in seeds:
        state[np.int64(s)] = True
    while len(queue) > 0:
        tet = queue.pop()
        if not sweep_meets(corners, positions, tetrahedra[tet]):
            continue
        met.append(tet)
        for i in range(4):
            corner = first_corner[tetrahedra[tet, i]]
            while corner >= 0:
                other = np.int64(corner // 4)
                if other not in state:
                    state[other] = True
                    queue.append(other)
                corner = corner_next[corner]
    return met


@kernel
def _boxes(corners, positions, tetrahedra):
    """Return every tetrahedron whose bounding box meets that of the sweep."""
    low, high = np.empty(3), np.empty(3)
    for i in range(3):
        low[i], high[i] = corners[:, i].min(), corners[:, i].max()
    near = [np.int64(0) for _ in range(0)]
    for tet in range(len(tetrahedra)):
        apart = False
        for i in range(3):
            a, b = positions[tetrahedra[tet, 0], i], positions[tetrahedra[tet, 1], i]
            c, d = positions[tetrahedra[tet, 2], i], positions[tetrahedra[tet, 3], i]
            if min(min(a, b), min(c, d)) > high[i] or max(max(a, b), max(c, d)) < low[i]:
                apart = True
                break
        if not apart:
            near.append(np.int64(tet))
    return near


def touched_tetrahedra(
    mesh: TetMesh, positions: np.ndarray, sweep: Sweep, seeds: np.ndarray | None
) -> np.ndarray:
    """Return the tetrahedra met by a sweep.

    Args:
        mesh: the tissue.
        positions: current nodes [m], shape (n, 3).
        sweep: in the deformed tissue.
        seeds: tetrahedra at the previous position of the blade; None: all are searched.

    Returns:
        Sorted indices, shape (t,).
    """
    corners = quad(sweep)
    if seeds is None:
        seeds = np.array(_boxes(corners, positions, mesh.tetrahedra), np.int64)
    if len(seeds) == 0:
        return np.zeros(0, np.int64)
    links = mesh.links
    met = _spread(
        corners, positions, links.tetrahedra, links.first_corner, links.corner_next, seeds
    )
    return np.sort(np.array(met, np.int64))
