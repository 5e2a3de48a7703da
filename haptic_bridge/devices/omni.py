"""Conversion between an omni_msgs driver and CRTK, without ROS.

Public omni_msgs drivers differ: positions in millimetres by default although the message says
metres, a force whose axes are swapped, a force that stays on until the next one comes.
"""

import math
from dataclasses import dataclass

_METRES = {'m': 1.0, 'mm': 0.001}
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class OmniConvention:
    """Units and axes of a driver.

    Attributes:
        unit: of position and velocity in OmniState: m or mm.
        force_axes: which of our axes the driver's x, y and z of the force are, with sign: the
            default is 'x y z'; 'x -z y' is a driver that turns the force about x.
        timeout: [s] without a new command after which the driver is sent a zero force.
    """

    unit: str = 'mm'
    force_axes: str = 'x y z'
    timeout: float = 0.03

    def __post_init__(self) -> None:
        if self.unit not in _METRES:
            raise ValueError(f'unit is {self.unit!r}: use m or mm')
        if sorted(word.lstrip('-') for word in self.force_axes.split()) != ['x', 'y', 'z']:
            raise ValueError(
                f'force_axes is {self.force_axes!r}: name x, y and z once each, with - or without'
            )
        if not 0.005 <= self.timeout <= 0.3:
            raise ValueError(f'timeout is {self.timeout:g} s: use 0.005 to 0.3')

    def metres(self, values: tuple[float, float, float]) -> tuple[float, ...]:
        """Return position or velocity in [m] or [m/s]."""
        return tuple(_METRES[self.unit] * value for value in values)

    def driver_force(self, force: tuple[float, ...]) -> tuple[float, ...]:
        """Return a force [N] on the hand, axes of the poses, in the driver's axes."""
        return tuple(
            (-1.0 if word[0] == '-' else 1.0) * force['xyz'.index(word[-1])]
            for word in self.force_axes.split()
        )


class ForceLatch:
    """Holds the newest command, and drops it when it is old: OmniFeedback has no stamp.

    Args:
        convention: of the driver.
    """

    def __init__(self, convention: OmniConvention) -> None:
        self._convention = convention
        self._force: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._stamp = 0
        self._taken: int | None = None

    def take(self, stamp_ns: int, force: tuple[float, ...], now_ns: int) -> None:
        """Store a servo_cf command.

        One whose stamp is not newer is ignored; stamp 0, or a force that is not finite, gives zero.
        """
        if stamp_ns == 0 or not all(map(math.isfinite, force)):
            self._force, self._taken = (0.0, 0.0, 0.0), None
        elif stamp_ns > self._stamp:
            self._force, self._stamp, self._taken = tuple(force), stamp_ns, now_ns

    def force(self, now_ns: int) -> tuple[float, ...]:
        """Return the force for the driver now [N], its axes; zero when the command is too old."""
        if self._taken is None:
            return (0.0, 0.0, 0.0)
        if now_ns - self._taken > round(self._convention.timeout * _NANOSECONDS):
            # The next publisher may have another clock.
            self._taken, self._stamp = None, 0
            return (0.0, 0.0, 0.0)
        return self._convention.driver_force(self._force)
