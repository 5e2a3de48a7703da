"""The tissue's surface for the 1 kHz loop: an immutable snapshot with a bounding volume hierarchy.

The broad phase is a bounding volume hierarchy in the form of a complete binary tree over the
triangles in Morton order: no pointers, rebuilt in about the time that other trees need for a refit.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.replica import MAX_COORDINATE

LEAF_SIZE = 4
"""Triangles of a leaf."""
_MORTON_BITS = 16
"""Of the Morton code along each axis."""


class Geometry(NamedTuple):
    """The arrays of a surface that compiled functions read.

    Attributes:
        start: positions of all nodes before [m], shape (n, 3).
        end: positions of all nodes now [m], shape (n, 3).
        triangles: node indices in Morton order, int32, shape (k, 3).
        boxes: lower and upper corner of each tree node [m], shape (2 p - 1, 6), over both start
            and end; children of i are 2 i + 1 and 2 i + 2, the last p are leaves.
    """

    start: np.ndarray
    end: np.ndarray
    triangles: np.ndarray
    boxes: np.ndarray


def _no_geometry() -> Geometry:
    arrays = (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 6)))
    for array in arrays:
        array.flags.writeable = False
    return Geometry(*arrays)


NO_GEOMETRY = _no_geometry()
"""What kernels get where no surface is known yet."""


class Surface:
    """A triangle surface between two revisions.

    Between two updates the surface is at `start + blend (end - start)`, so that it moves under the
    proxy instead of jumping at 30 Hz. Build it outside of the fast loop; it copies its arrays.

    Args:
        positions: all nodes of the mesh [m], shape (n, 3).
        triangles: node indices, outward counter-clockwise, shape (k, 3).
        revision, topology: of the mesh.
        previous: the surface before; its positions are the start of this one if it has the same
            triangles, and the tree's order is taken over.

    Attributes:
        geometry: for compiled functions.
        motion: largest displacement of a node from start to end [m].
        base: revision at the start, None when the surface does not continue another one.

    Raises:
        ValueError: positions are not finite, or a triangle names a node that does not exist.
    """

    def __init__(
        self,
        positions: np.ndarray,
        triangles: np.ndarray,
        *,
        revision: int,
        topology: int,
        previous: 'Surface | None' = None,
    ) -> None:
        end = np.array(positions, np.float64, order='C').reshape(-1, 3)
        faces = np.array(triangles, np.int32, order='C').reshape(-1, 3)
        _check(end, faces, revision)
        self.revision = revision
        self.topology = topology
        self.base: int | None = None
        self._given: np.ndarray = faces
        self.geometry: Geometry
        start = end
        if (
            previous is not None
            and previous.topology == topology
            and len(previous.geometry.end) == len(end)
            and np.array_equal(previous._given, faces)
        ):
            self.base = previous.revision
            self._given = previous._given
            start, ordered = previous.geometry.end, previous.geometry.triangles
        else:
            ordered = faces[np.argsort(_morton_codes(end, faces))]
        for array in (self._given, start, end, ordered):
            array.flags.writeable = False
        self.motion = _largest_motion(start, end)
        boxes = _fitted_boxes(start, end, ordered)
        boxes.flags.writeable = False
        self.geometry = Geometry(start, end, ordered, boxes)

    def continues(self, other: 'Surface | None') -> bool:
        """Return whether this surface starts where the other one ends."""
        return (
            other is not None
            and self.topology == other.topology
            and self.base == other.revision
            and self.geometry.start is other.geometry.end
        )


def _check(positions: np.ndarray, triangles: np.ndarray, revision: int) -> None:
    believable = np.abs(positions) <= MAX_COORDINATE  # a NaN is not
    if not believable.all():
        node = int(np.flatnonzero(~believable.all(axis=1))[0])
        raise ValueError(
            f'surface of revision {revision}: node {node} is at {positions[node]} m, which is not '
            f'finite or farther than {MAX_COORDINATE:g} m: has the simulation diverged?'
        )
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(positions)):
        raise ValueError(
            f'surface of revision {revision}: triangles name nodes {triangles.min()} to '
            f'{triangles.max()}, but the nodes go from 0 to {len(positions) - 1}'
        )


@kernel(nogil=True)
def _morton_codes(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the place of each triangle's centre on a Morton curve, int64, shape (k,)."""
    k = len(triangles)
    centres = np.empty((k, 3))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(k):
        a, b, c = triangles[i]
        for axis in range(3):
            x = (positions[a, axis] + positions[b, axis] + positions[c, axis]) / 3
            centres[i, axis] = x
            low[axis], high[axis] = min(low[axis], x), max(high[axis], x)
    size = max((high - low).max(), 1e-300)
    codes = np.zeros(k, np.int64)
    for i in range(k):
        for axis in range(3):
            cell = np.int64((centres[i, axis] - low[axis]) / size * (2**_MORTON_BITS - 1))
            for bit in range(_MORTON_BITS):
                codes[i] |= ((cell >> bit) & 1) << (3 * bit + axis)
    return codes


@kernel(nogil=True)
def _largest_motion(start: np.ndarray, end: np.ndarray) -> float:
    largest = 0.0
    for i in range(len(start)):
        motion2 = 0.0
        for axis in range(3):
            motion2 += (end[i, axis] - start[i, axis]) ** 2
        largest = max(largest, motion2)
    return np.sqrt(largest)


@kernel(nogil=True)
def _fitted_boxes(start: np.ndarray, end: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    k = len(triangles)
    leaves = 1
    while leaves * LEAF_SIZE < k:
        leaves *= 2
    boxes = np.empty((2 * leaves - 1, 6))
    for leaf in range(leaves):
        box = boxes[leaves - 1 + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for i in range(leaf * LEAF_SIZE, min(k, (leaf + 1) * LEAF_SIZE)):
            for node in triangles[i]:
                for axis in range(3):
                    x, y = start[node, axis], end[node, axis]
                    box[axis] = min(box[axis], x, y)
                    box[3 + axis] = max(box[3 + axis], x, y)
    for i in range(leaves - 2, -1, -1):
        for axis in range(3):
            boxes[i, axis] = min(boxes[2 * i + 1, axis], boxes[2 * i + 2, axis])
            boxes[i, 3 + axis] = max(boxes[2 * i + 1, 3 + axis], boxes[2 * i + 2, 3 + axis])
    return boxes
