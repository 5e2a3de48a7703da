"""Surface that a blade has swept, as points with normals: places near it and their heights."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.kernels import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BLOCK = 8
"""Points of a surface that are passed over together if they are too far away."""


class Surface(NamedTuple):
    """Points of a swept surface [m] and unit normals, each shape (p, 3)."""

    points: Floats
    normals: Floats


@kernel
def _nearest(points, places):
    """Return the nearest point of some, and its distance [m], by place."""
    blocks = (len(points) + _BLOCK - 1) // _BLOCK
    middle, radius = np.empty((blocks, 3)), np.zeros(blocks)
    for block in range(blocks):
        own = points[block * _BLOCK : (block + 1) * _BLOCK]
        for i in range(3):
            middle[block, i] = (own[:, i].min() + own[:, i].max()) / 2
        for point in own:
            radius[block] = max(radius[block], np.sqrt(_square(point, middle[block])))
    nearest, distance = np.empty(len(places), np.int64), np.empty(len(places))
    row = 0
    for k in range(len(places)):
        best = _square(points[row], places[k])
        length = np.sqrt(best)
        for block in range(blocks):
            if _square(middle[block], places[k]) > (length * (1 + 1e-9) + radius[block]) ** 2:
                continue
            for p in range(block * _BLOCK, min((block + 1) * _BLOCK, len(points))):
                square = _square(points[p], places[k])
                if square < best or (square == best and p < row):
                    best, row = square, p
                    length = np.sqrt(best)
        nearest[k], distance[k] = row, length
    return nearest, distance


@inner
def _square(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


def nearest_points(surface: Surface, places: Floats) -> tuple[Ints, Floats]:
    """Return the nearest point of a surface, and its distance [m], by place."""
    nearest, distance = _nearest(surface.points, places)
    return nearest, distance


def heights(surface: Surface, places: Floats) -> tuple[Floats, Floats]:
    """Return the heights of places above a surface, and their distances aside of it [m]."""
    nearest, distance = nearest_points(surface, places)
    away = places - surface.points[nearest]
    height: Floats = (away * surface.normals[nearest]).sum(axis=1)
    return height, np.sqrt(np.maximum(distance**2 - height**2, 0.0))
