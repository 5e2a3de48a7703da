"""Detached pieces of a batch, found from the batch outward in time independent of the mesh size."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel

SMALL = 48
"""Largest number of tetrahedra of a reported piece."""


@kernel
def small_pieces(patch, pieces, links):
    """Return the sizes of the small detached pieces of a batch, in tetrahedra.

    Args:
        patch: of the batch, with renumbered corners; it has the face neighbours of all removed
            elements.
        pieces: the children of the batch.
        links: connectivity before the batch.

    Returns:
        Shape (p,).
    """
    place = {}
    for e in range(len(patch.corners)):
        if patch.tetrahedra[e] >= 0:
            place[patch.tetrahedra[e]] = np.int64(e)
    place[np.int64(-1)] = np.int64(-1)
    offset = len(patch.corners)
    # Elements of the patch are known by index, tetrahedra beyond it by number + offset.
    known = {}
    known[np.int64(-1)] = np.int64(0)
    sizes = [np.int64(0) for _ in range(0)]
    for start in range(len(pieces.corners)):
        if np.int64(start) in known:
            continue
        queue = [np.int64(start)]
        known[np.int64(start)] = np.int64(start)
        size = 0
        while len(queue) > 0 and 0 <= size <= SMALL:
            at = queue.pop()
            size += 1
            for face in range(4):
                other = _next(patch, links, place, offset, at, face)
                if other < 0:
                    continue
                if other not in known:
                    known[other] = np.int64(start)
                    queue.append(other)
                elif known[other] != start:
                    size = -1
                    break
        if 0 < size <= SMALL:
            sizes.append(np.int64(size))
    return np.array(sizes, np.int64)


@inner
def _next(patch, links, place, offset, at, face):
    """Return the element across a face, or -1."""
    if at < offset:
        across = patch.across[at, face]
        if across >= 0:
            return np.int64(across // 4)
        if patch.tetrahedra[at] < 0:
            return np.int64(-1)
        other = links.neighbors[patch.tetrahedra[at], face]
        # Elements in the patch that it does not connect are separated by the cut.
        return np.int64(-1) if other < 0 or other // 4 in place else np.int64(other // 4 + offset)
    other = np.int64(links.neighbors[at - offset, face])
    if other < 0:
        return np.int64(-1)
    other //= 4
    return place[other] if other in place else other + offset
