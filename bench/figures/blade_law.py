"""Figures of the law of the blade: work of the hand by a cut."""

from bench.figures.figure import Figure
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
    ]
