"""Kernels' geometry of the blade's edge: its direction, its surroundings, and lines along it."""

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import dot, norm
from cutting_trainer.tissue_sim.contact.fracture import BLADE_THICKNESS, KNOTS
from cutting_trainer.tissue_sim.contact.immersion import POINTS, SHARES

KNOT_POINTS = np.rint(np.linspace(0, POINTS - 1, KNOTS)).astype(np.int64)
"""Points of the edge that are its knots."""
_MIN_POINTS = 4
"""Points in the tissue from which on they tell the direction of the edge."""


@inner
def edge_direction(device):
    """Return the unit vector from tip to root, and the length that a point stands for [m]."""
    edge = np.empty(3)
    for c in range(3):
        edge[c] = device[POINTS - 1, c] - device[0, c]
    length = norm(edge)
    for c in range(3):
        edge[c] /= length
    return edge, length / (POINTS - 1)


@inner
def edge_box(edge, device):
    """Return a box around the edge and the device's, where they are in the tissue [m], (3,)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(POINTS):
        if edge.spans[i] > 0.0:
            for c in range(3):
                x, y = edge.points[i, c], device[i, c]
                low[c], high[c] = min(low[c], min(x, y)), max(high[c], max(x, y))
    for c in range(3):
        low[c], high[c] = low[c] - BLADE_THICKNESS, high[c] + BLADE_THICKNESS
    return low, high


@inner
def edge_knots(edge, device):
    """Return some points of the edge, half a piece more at its ends [m], shape (KNOTS, 3)."""
    knots = np.empty((KNOTS, 3))
    for c in range(3):
        for k in range(KNOTS):
            knots[k, c] = edge.points[KNOT_POINTS[k], c]
        half = (device[1, c] - device[0, c]) / 2
        knots[0, c] -= half
        knots[KNOTS - 1, c] += half
    return knots


@inner
def edge_line(spans, values):
    """Return the line a + s b nearest to values at the points' places s, and their mean.

    It is level where too few points are in the tissue.

    Args:
        spans: `Edge.spans`, shape (POINTS,).
        values: shape (POINTS, 3).

    Returns:
        a and b, shape (2, 3), and the mean, shape (3,).
    """
    count, mean, middle = 0, np.zeros(3), 0.0
    line, square = np.zeros((2, 3)), 0.0
    for i in range(POINTS):
        if spans[i] > 0.0:
            count += 1
            middle += SHARES[i]
            for c in range(3):
                mean[c] += values[i, c]
    if count == 0:
        return line, mean
    middle /= count
    for i in range(POINTS):
        if spans[i] > 0.0:
            square += (SHARES[i] - middle) ** 2
            for c in range(3):
                line[1, c] += (SHARES[i] - middle) * values[i, c]
    for c in range(3):
        mean[c] /= count
        line[1, c] = line[1, c] / square if count >= _MIN_POINTS else 0.0
        line[0, c] = mean[c] - middle * line[1, c]
    return line, mean


@inner
def split_way(way, direction):
    """Return the lengths of a way along a direction and across it [m]."""
    along, square = dot(way, direction), 0.0
    for c in range(3):
        square += (way[c] - along * direction[c]) ** 2
    return abs(along), np.sqrt(square)
