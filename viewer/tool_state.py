"""State of the tool at one moment, in the tissue frame, from the messages of device and bridge."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.haptic_bridge.devices.convention import DeviceConvention
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.cdr_codec import ContactCodec, StampedMessage, WrenchStampedCodec
from cutting_trainer.node_common.orientation import from_quaternion, quaternion

Floats = NDArray[np.float64]


class Moment(NamedTuple):
    """State of the tool, and the force on the hand.

    Attributes:
        tip: [m], shape (3,).
        orientation: quaternion of the tool, w x y z, shape (4,).
        blade: its edge from root to tip [m], shape (2, 3).
        proxy: centre of the proxy sphere [m], shape (3,).
        contact: NONE, TOUCHING or INSIDE.
        force: on the hand [N], tissue axes, shape (3,).
        clutched: whether a clutch has the hand off the tool.
    """

    tip: Floats
    orientation: Floats
    blade: Floats
    proxy: Floats
    contact: int
    force: Floats
    clutched: bool = False

    @property
    def is_finite(self) -> bool:
        """Return whether every number is finite."""
        return all(np.isfinite(part).all() for part in self)


class Translator:
    """Converts messages to moments.

    Args:
        device: the scene's section `device`.
    """

    def __init__(self, device: DeviceSettings) -> None:
        self._convention = DeviceConvention(device)
        self._to_tissue = device.tissue_from_device.rotation()
        self._body = device.force_frame == 'body'

    def moment(
        self,
        contact: StampedMessage,
        pose: StampedMessage | None,
        wrench: StampedMessage | None,
        indexing: Indexing | None = None,
    ) -> Moment:
        """Combine the newest of each message.

        Args:
            contact: `tool/contact`.
            pose: `arm/measured_cp`; None: identity orientation.
            wrench: `arm/servo_cf`; None: no force.
            indexing: how the hand moves the tool; None: as the scene says.
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
        if indexing is not None:
            aligned = from_quaternion(indexing.alignment)
            turned = aligned if indexing.clutched else turned @ aligned
        return Moment(
            tip=get('device'),
            orientation=np.roll(quaternion(self._to_tissue @ turned), 1),
            blade=np.stack([get('blade_root'), get('blade_tip')]),
            proxy=get('proxy'),
            contact=int(get('state')[0]),
            force=force,
            clutched=indexing is not None and indexing.clutched,
        )


def drawn(moment: Moment | None) -> dict[str, Any] | None:
    """Return a further tool in the format of the message `moment`; None: nothing is to be drawn."""
    if moment is None or not moment.is_finite:
        return None
    return {'tip': moment.tip.tolist(), 'wxyz': moment.orientation.tolist()}
