"""The tool at one moment, in the tissue frame, from what device and haptic bridge say."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_bridge.convention import DeviceConvention
from haptic_bridge.orientation import from_quaternion, quaternion
from haptic_bridge.settings import DeviceSettings
from haptic_bridge.wire import ContactCodec, Sample, WrenchStampedCodec

Floats = NDArray[np.float64]


class Moment(NamedTuple):
    """Where the tool is, and what it feels.

    Attributes:
        tip: [m], shape (3,).
        turn: of the tool, quaternion w x y z, shape (4,).
        blade: its edge from root to tip [m], shape (2, 3).
        proxy: centre of the proxy sphere [m], shape (3,).
        contact: NONE, TOUCHING or INSIDE.
        force: on the hand [N], tissue axes, shape (3,).
    """

    tip: Floats
    turn: Floats
    blade: Floats
    proxy: Floats
    contact: int
    force: Floats


class Translator:
    """Makes moments of messages.

    Args:
        device: the scene's section `device`.
    """

    def __init__(self, device: DeviceSettings) -> None:
        self._convention = DeviceConvention(device)
        self._to_tissue = device.tissue_from_device.rotation()
        self._body = device.force_frame == 'body'

    def moment(self, contact: Sample, pose: Sample | None, wrench: Sample | None) -> Moment:
        """The newest of each message, together.

        Args:
            contact: `tool/contact`.
            pose: `arm/measured_cp`; None: not turned.
            wrench: `arm/servo_cf`; None: no force.
        """

        def get(name: str) -> Floats:
            return np.array(contact.values[ContactCodec.fields[name]], float)

        turned = np.eye(3)
        if pose is not None:
            turned = from_quaternion(self._convention.pose(pose).values[3:])
        force = np.zeros(3)
        if wrench is not None:
            felt = self._convention.force(wrench.values)[WrenchStampedCodec.fields['force']]
            force = self._to_tissue @ (turned @ felt if self._body else felt)
        return Moment(
            tip=get('device'),
            turn=np.roll(quaternion(self._to_tissue @ turned), 1),
            blade=np.stack([get('blade_root'), get('blade_tip')]),
            proxy=get('proxy'),
            contact=int(get('state')[0]),
            force=force,
        )
