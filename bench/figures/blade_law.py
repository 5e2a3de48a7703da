"""Figures of the law of the blade: work of the hand by a cut, and what leads it."""

import numpy as np

from bench.figures.figure import Figure
from bench.haptics.leading_side import DEPTH, TOUGHNESS, moved
from bench.haptics.turned_blade import PRICE, turned
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings


def measure() -> list[Figure]:
    """Return the figures of line 3."""
    work, paid = turned(DeviceSettings(), 1.0)
    name = 'turned by 57 degrees in tissue: price of the cut over J A, off 1'
    felt = 'work of the hand by force and torque over the price of the cut, off 1'
    return [
        Figure(3, name, abs(paid / PRICE - 1), 0.05, 'at most', '', 1),
        Figure(3, felt, abs(work / paid - 1), 0.05, 'at most', '', 1),
        *_leading(),
    ]


def _leading() -> list[Figure]:
    edge, flat, spine = (moved(np.radians(angle)) for angle in (0.0, 90.0, 180.0))
    opened = 1e6 * (spine.opened + flat.opened)
    cutting = abs(edge.force / (TOUGHNESS * DEPTH) - 1)
    return [
        Figure(3, 'edge leading: force over J w, off 1', cutting, 0.05, 'at most', '', 1),
        Figure(3, 'force, spine over edge', spine.force / edge.force, 1.02, 'at least', '', 1),
        Figure(3, 'force, flat over spine', flat.force / spine.force, 1.02, 'at least', '', 1),
        Figure(3, 'opened with spine and flat leading', opened, 0.0, 'at most', 'mm^2', 2),
    ]
