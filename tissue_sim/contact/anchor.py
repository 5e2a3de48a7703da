"""Where the blade's edge was in the tissue as it left: the last sweep goes with the tissue."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.contact.immersion import SHARES, Edge

_MIN_POINTS = 4
"""Points from which on they tell how the direction of the edge changes."""


class Anchor(NamedTuple):
    """Points of the edge, tied to the tissue.

    Attributes:
        corners: nodes of the tetrahedron around each, shape (p, 4).
        weights: barycentric coordinates in it, shape (p, 4).
        points: [m], shape (p, 3).
        shares: places along the edge, from 0 at its tip to 1 at its root, shape (p,).
    """

    corners: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    shares: np.ndarray

    def carried(self, positions: np.ndarray) -> tuple[np.ndarray, 'Anchor']:
        """Return how the tissue has moved tip and root relative to the tip, and the points now.

        Args:
            positions: nodes now, of the same mesh [m], shape (n, 3).

        Returns:
            Motion [m], shape (2, 3), and the anchor there.
        """
        if not len(self.points):
            return np.zeros((2, 3)), self
        points = np.einsum('pk,pkc->pc', self.weights, positions[self.corners])
        moved, shares = points - self.points, self.shares
        line = np.array([moved.mean(axis=0), np.zeros(3)])
        if len(points) >= _MIN_POINTS:  # the line with the least squares of distances
            off = shares - shares.mean()
            line[1] = off @ moved / (off @ off)
            line[0] -= shares.mean() * line[1]
        return line, self._replace(points=points)

    def loose(self) -> 'Anchor':
        """Return the anchor without points, which stays where it is."""
        return Anchor(*(values[:0] for values in self))


def anchor_of(edge: Edge) -> Anchor | None:
    """Return the anchor of the points in the tissue; None: there is none."""
    inside = edge.spans > 0.0
    if not inside.any():
        return None
    return Anchor(edge.corners[inside], edge.weights[inside], edge.points[inside], SHARES[inside])
