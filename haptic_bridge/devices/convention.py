"""Conventions of a device: unit of length, handedness of its frame, sign of the force.

All other code uses metres, right-handed frames, and the force on the hand.
"""

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.cdr_codec import StampedMessage

METRES = {'m': 1.0, 'dm': 0.1, 'cm': 0.01, 'mm': 0.001}
_MIRRORS = {
    'none': (1.0, 1.0, 1.0),
    'x': (-1.0, 1.0, 1.0),
    'y': (1.0, -1.0, 1.0),
    'z': (1.0, 1.0, -1.0),
}


class DeviceConvention:
    """Converts between a device's messages and ours, both ways.

    With a mirrored axis the map is v -> M v, M = diag(1, ..., -1, ..., 1), and a rotation R becomes
    M R M: rotations about the mirrored axis keep their sense, the others turn around.

    Args:
        settings: the scene's section `device`.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        self._unit = METRES[settings.length_unit]
        self._mirror = _MIRRORS[settings.mirrored_axis]
        mirrored = settings.mirrored_axis != 'none'
        self._torque_signs = tuple(-sign if mirrored else 1.0 for sign in self._mirror)
        self._sign = float(settings.force_sign)
        self._plain_pose = not mirrored and self._unit == 1.0
        self._plain_force = not mirrored and self._sign == 1.0

    def pose(self, sample: StampedMessage) -> StampedMessage:
        """Return the pose of a device: position [m] and quaternion x y z w, right-handed."""
        if self._plain_pose:
            return sample
        return sample._replace(values=self._moved(sample.values, self._unit))

    def to_device_pose(self, values: tuple[float, ...]) -> tuple[float, ...]:
        """Return the inverse: position [m] and quaternion as the device would send them."""
        return values if self._plain_pose else self._moved(values, 1 / self._unit)

    def to_device_twist(self, values: tuple[float, ...]) -> tuple[float, ...]:
        """Return linear [m/s] and angular velocity [rad/s] as the device would send them."""
        return values if self._plain_pose else self._moved(values, 1 / self._unit)

    def force(self, wrench: tuple[float, ...]) -> tuple[float, ...]:
        """Convert force [N] and torque [N m] to the device's convention; its own inverse."""
        if self._plain_force:
            return wrench
        # `+ 0.0` so that a zero force has no sign.
        linear = (self._sign * m * f + 0.0 for m, f in zip(self._mirror, wrench[:3], strict=True))
        turned = (
            self._sign * t * m + 0.0 for t, m in zip(self._torque_signs, wrench[3:], strict=True)
        )
        return (*linear, *turned)

    def _moved(self, values: tuple[float, ...], unit: float) -> tuple[float, ...]:
        linear = (unit * m * x for m, x in zip(self._mirror, values[:3], strict=True))
        turned = (t * w for t, w in zip(self._torque_signs, values[3:6], strict=True))
        return (*linear, *turned, *values[6:])
