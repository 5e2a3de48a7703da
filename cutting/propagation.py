"""Which tetrahedra a sweep meets: a broad phase at first contact, then neighbours (thesis 5.4)."""

import numpy as np
from numba import njit

from cutting.geometry import sweep_meets
from tissue_sim.blade import Sweep
from tissue_sim.mesh import TetMesh


def quad(sweep: Sweep) -> np.ndarray:
    """The corners of a sweep in order around it [m], shape (4, 3)."""
    return np.array([sweep.root_from, sweep.tip_from, sweep.tip_to, sweep.root_to])


@njit(cache=True)
def _spread(corners, positions, tetrahedra, first_corner, corner_next, seeds):
    """Tetrahedra met that hang together by nodes with the seeds that are met themselves."""
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


@njit(cache=True)
def _boxes(corners, positions, tetrahedra):
    """Every tetrahedron whose box meets the box of the sweep."""
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
    """The tetrahedra that a sweep meets.

    Args:
        mesh: the tissue.
        positions: current nodes [m], shape (n, 3).
        sweep: in the deformed tissue.
        seeds: tetrahedra where the blade was, from which the sweep goes on; None: all are searched.

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
