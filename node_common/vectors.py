"""Kernels' arithmetic of short vectors and their lists, in loops.

Numba takes a tenth of a second and more for an expression of whole arrays, each time it meets one,
and four tenths where they have two dimensions.
"""

import numpy as np

from cutting_trainer.node_common.kernels import inner


@inner
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def norm(v):
    """Return the length of a vector; NaN where a component is."""
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@inner
def assign(target, values):
    """Copy a vector over another."""
    target[0], target[1], target[2] = values[0], values[1], values[2]


@inner
def cross(a, b, out):
    """Write the vector product of two vectors to a third, shape (3,), which is neither."""
    for c in range(3):
        d, e = (c + 1) % 3, (c + 2) % 3
        out[c] = a[d] * b[e] - a[e] * b[d]


@inner
def area_vector(a, b, c, out):
    """Write the vector square to a triangle whose length is twice its area."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = (b[j] - a[j]) * (c[k] - a[k]) - (b[k] - a[k]) * (c[j] - a[j])


@inner
def differences(a, b):
    """Return the vectors of a less those of b, each shape (n, 3)."""
    found = np.empty((len(a), 3))
    for i in range(len(a)):
        for c in range(3):
            found[i, c] = a[i, c] - b[i, c]
    return found


@inner
def assign_all(target, values):
    """Copy vectors, shape (n, 3), over others."""
    for i in range(len(values)):
        assign(target[i], values[i])


@inner
def sum_of(values):
    """Return the sum of numbers, from the first to the last."""
    total = 0.0
    for i in range(len(values)):
        total += values[i]
    return total


@inner
def weighted_sum(weights, values):
    """Return the sum of numbers, each times its weight."""
    total = 0.0
    for i in range(len(weights)):
        total += weights[i] * values[i]
    return total
