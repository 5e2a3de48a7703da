"""A flat square of tissue surface at z = 0, outward +z, for tests of the haptic bridge."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.surface import Surface

HALF = 0.05
POSITIONS = np.array([[-HALF, -HALF, 0], [HALF, -HALF, 0], [HALF, HALF, 0], [-HALF, HALF, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def flat_surface(revision=1, topology=1, previous=None):
    """Two triangles that make a square of 0.1 m."""
    return Surface(POSITIONS, TRIANGLES, revision=revision, topology=topology, previous=previous)
