"""Path of the blade in the rest shape: its edge, mapped by the elements that it passes through."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.geometry import orientation
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

Floats = NDArray[np.float64]

_ROUNDING = 1e-9


@kernel
def parts_at_rest(tip, root, positions, rest, elements):
    """Return the parts of an edge within some elements, and where they lie at rest.

    Args:
        tip, root: of the edge [m], shape (3,).
        positions, rest: nodes now and at rest [m], shape (n, 3).
        elements: their nodes, shape (a, 4).

    Returns:
        Ends of each part as shares of the edge from the tip, shape (k, 2), and at rest [m], shape
        (k, 2, 3).
    """
    shares, places = np.empty((len(elements), 2)), np.zeros((len(elements), 2, 3))
    at_tip, at_root = np.empty(4), np.empty(4)
    count = 0
    for e in range(len(elements)):
        corners = elements[e]
        low, high = 0.0, 1.0
        for face in range(4):
            a = positions[corners[FACE_NODES[face, 0]]]
            b = positions[corners[FACE_NODES[face, 1]]]
            c = positions[corners[FACE_NODES[face, 2]]]
            # Volumes with the node opposite, whose share they are; negative outside.
            at_tip[face] = -orientation(a, b, c, tip)
            at_root[face] = -orientation(a, b, c, root)
            s, t = at_tip[face], at_root[face]
            if s < 0.0 and t < 0.0:
                high = -1.0
            elif s < 0.0:
                low = max(low, s / (s - t))
            elif t < 0.0:
                high = min(high, s / (s - t))
        if high - low <= _ROUNDING:
            continue
        shares[count, 0], shares[count, 1] = low, high
        for end in range(2):
            u = shares[count, end]
            whole = (1.0 - u) * at_tip.sum() + u * at_root.sum()
            for face in range(4):
                weight = ((1.0 - u) * at_tip[face] + u * at_root[face]) / whole
                for i in range(3):
                    places[count, end, i] += weight * rest[corners[face], i]
        count += 1
    return shares[:count], places[:count]


def map_to_rest(
    tip: Floats, root: Floats, positions: Floats, rest: Floats, elements: NDArray[np.int64]
) -> Floats:
    """Return the affine map to the rest shape that fits the nodes around a blade, shape (4, 3).

    The tip is mapped as by the element that it lies in; if it lies in none, the parts of the blade
    in the elements are, in the mean. (x, y, z, 1) times the map is a place at rest [m].

    Args:
        tip, root: of the blade [m], shape (3,).
        positions, rest: nodes now and at rest [m], shape (n, 3).
        elements: around the blade, by their nodes, shape (a, 4), at least one.
    """
    nodes = np.unique(elements)
    near = np.column_stack([positions[nodes], np.ones(len(nodes))])
    affine = np.asarray(np.linalg.lstsq(near, rest[nodes], rcond=None)[0], np.float64)
    shares, places = parts_at_rest(tip, root, positions, rest, elements)
    if not len(shares):
        return affine
    ends = tip + shares[:, :, None] * (root - tip)
    off = places - ends @ affine[:3] - affine[3]
    first = shares[:, 0] <= _ROUNDING
    if first.any():
        affine[3] += off[first, 0].mean(axis=0)
    else:
        length = np.diff(shares, axis=1)[:, 0]
        affine[3] += length @ off.mean(axis=1) / length.sum()
    return affine
