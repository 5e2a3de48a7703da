"""Constants of the blade's law with which the force loop fills the time between two frames."""

import math
from typing import NamedTuple


class BladeConstants(NamedTuple):
    """Constants of the blade's law that the force loop knows.

    Attributes:
        crack_length: of a step of the crack [m]; 0: it runs steadily.
        friction: of the blade by its length in the tissue [N/m].
        entry_force: contact force that lets the blade in [N]; inf: another rule does.
        toughness: largest of the tissue's [J/m^2]; inf: unknown.
        tip_resistance: of the tip to going deeper [N].
    """

    crack_length: float = 0.0
    friction: float = 0.0
    entry_force: float = math.inf
    toughness: float = math.inf
    tip_resistance: float = 0.0


UNKNOWN_BLADE = BladeConstants()
