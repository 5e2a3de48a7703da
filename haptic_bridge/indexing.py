"""How the hand moves the tool, and how a clutch or another scale changes that without a jump.

A point p of the device is at t + R (s p) of the tissue, and the tool is turned by R Q A, where Q is
the device's orientation and R the rotation of `device.tissue_from_device`. A change takes the
translation t and the alignment A at which the tool stays where it is. The alignment is on the right
of Q: the tool always turns about the axis about which the hand turns.
"""

from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, Transform
from cutting_trainer.node_common.stamps import nanoseconds

_UNTURNED = (0.0, 0.0, 0.0, 1.0)


class Indexing(NamedTuple):
    """How the hand moves the tool.

    Attributes:
        scale: motion of the tool over that of the hand.
        translation: t [m], 3 numbers.
        alignment: A, quaternion x y z w.
        clutched: the tool stays at `translation`, turned by R A, wherever the hand goes.
        after_ns: it holds for device poses with a later stamp [ns].
    """

    scale: float
    translation: tuple[float, ...]
    alignment: tuple[float, ...] = _UNTURNED
    clutched: bool = False
    after_ns: int = 0

    @classmethod
    def of(cls, frame: Transform) -> 'Indexing':
        """Return the indexing that a scene begins with."""
        return cls(frame.scale, tuple(map(float, frame.translation)))

    @classmethod
    def read(cls, message: Any) -> 'Indexing':
        """Return the indexing of a message `Indexing`."""
        return cls(
            float(message.scale),
            tuple(map(float, message.translation)),
            tuple(map(float, message.alignment)),
            bool(message.clutched),
            nanoseconds(message.header.stamp),
        )

    def write(self, setup: np.ndarray) -> None:
        """Write it to the constants of the kernels, dtype `force_kernels.SETUP`, shape (1,)."""
        setup['scale'], setup['translation'] = self.scale, self.translation
        setup['alignment'], setup['clutched'] = self.alignment, self.clutched

    def changed(
        self,
        position: np.ndarray,
        orientation: np.ndarray,
        rotation: np.ndarray,
        *,
        clutched: bool,
        scale: float,
        after_ns: int,
    ) -> 'Indexing':
        """Return the indexing with another clutch or scale in which the tool is where it was.

        Args:
            position: of the device [m], shape (3,).
            orientation: of the device, quaternion x y z w, shape (4,).
            rotation: R, shape (3, 3).
            clutched: whether the hand is to move without the tool.
            scale: motion of the tool over that of the hand.
            after_ns: stamp of that device pose [ns].
        """
        tip = np.array(self.translation)
        if not self.clutched:
            tip = tip + self.scale * (rotation @ position)
        alignment = np.array(self.alignment)
        if clutched and not self.clutched:
            alignment = _product(orientation, alignment)
        elif self.clutched and not clutched:
            alignment = _product(_inverse(orientation), alignment)
        if not clutched:
            tip = tip - scale * (rotation @ position)
        return Indexing(scale, tuple(tip.tolist()), tuple(alignment.tolist()), clutched, after_ns)


def scaled(device: DeviceSettings, scale: float) -> DeviceSettings:
    """Return the settings of a device with another scale of motion.

    Raises:
        ValidationError: the scale is out of range.
    """
    frame = device.tissue_from_device
    frame = Transform.model_validate(frame.model_dump() | {'scale': scale})
    return device.model_copy(update={'tissue_from_device': frame})


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions x y z w, shape (4,)."""
    x, y, z, w = first
    a, b, c, d = second
    return np.array(
        [
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        ]
    )


def _inverse(quaternion: np.ndarray) -> np.ndarray:
    """Return the inverse of a quaternion x y z w of any norm, shape (4,)."""
    conjugate = np.array([-1.0, -1.0, -1.0, 1.0]) * quaternion
    return np.asarray(conjugate / (quaternion @ quaternion))
