"""Faults of a device driver, injected into an emulated arm to test the device probe."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class DriverFaults:
    """Faults between the motors and the topics of an emulated arm.

    Attributes:
        turn: [deg] rotation of the force about (1, 1, 1).
        gain: force on the hand over force commanded.
        scale: position sent over true position.
        w_first: 1: quaternions are sent as w x y z.
        frame_after: [s] after which frame_id changes; 0: never.
        held: 1: the last force stays on after commands stop.
    """

    turn: float = 0.0
    gain: float = 1.0
    scale: float = 1.0
    w_first: float = 0.0
    frame_after: float = 0.0
    held: float = 0.0

    @classmethod
    def read(cls, text: str) -> 'DriverFaults':
        """Parse words such as `turn=30 gain=5`.

        Raises:
            ValueError: a word is none of these.
        """
        known = [field.name for field in fields(cls)]
        values = {}
        for word in text.split():
            name, _, value = word.partition('=')
            try:
                values[name] = float(value)
            except ValueError:
                values[name] = math.nan
            if name not in known or not math.isfinite(values[name]):
                example = ', '.join(f'{one}=NUMBER' for one in known)
                raise ValueError(f'{word!r} is no fault of a driver: use {example}')
        return cls(**values)

    def force(self, force: Sequence[float]) -> tuple[float, ...]:
        """Return the force of the motors [N] for a commanded one, shape (3,)."""
        x, y, z = force
        return tuple(a * x + b * y + c * z for a, b, c in self._rows)

    @cached_property
    def _rows(self) -> list[list[float]]:
        rows: list[list[float]] = (self.gain * _about_diagonal(self.turn)).tolist()
        return rows

    def pose(self, values: tuple[float, ...]) -> tuple[float, ...]:
        """Return a pose as it is sent: position and quaternion."""
        position = tuple(self.scale * x for x in values[:3])
        orientation = (values[6], *values[3:6]) if self.w_first else values[3:]
        return (*position, *orientation)

    def frame(self, frame_id: str, seconds: float) -> str:
        """Return the frame_id that is sent at a time [s] after the start."""
        return f'{frame_id}_2' if 0 < self.frame_after < seconds else frame_id


def _about_diagonal(degrees: float) -> np.ndarray:
    """Return the rotation about (1, 1, 1), shape (3, 3)."""
    axis = np.ones(3) / math.sqrt(3)
    cross = np.cross(np.eye(3), -axis)
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
