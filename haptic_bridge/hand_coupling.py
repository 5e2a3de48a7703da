"""How hand and tool are coupled: scales of force and motion, and a clutch, which may change.

An order comes from one thread, and the loop of 1 kHz carries it out between two poses. The tool
stays where it is.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from cutting_trainer.haptic_bridge import force_kernels
from cutting_trainer.haptic_bridge.indexing import Indexing, scaled
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    check_together,
)
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE, BladeConstants

_MAX_UNSENT = 1000


class Order(NamedTuple):
    """How hand and tool are to be coupled.

    Attributes:
        motion_scale: tool motion over hand motion.
        haptics: section of the scene, with the scale of the force.
        clutched: whether the hand moves without the tool, and without force.
    """

    motion_scale: float
    haptics: HapticsSettings
    clutched: bool = False


class HandCoupling:
    """Holds the constants of the kernels, and changes them as ordered.

    Args:
        tool, device, haptics: sections of the scene.
        profile: limits of the device.
        constants: of the blade in this tissue.

    Attributes:
        setup: constants of the kernels, dtype `force_kernels.SETUP`, shape (1,).
        indexing: how the hand moves the tool now.
        unsent: changes of it, for another thread to take away.

    Raises:
        SettingsError: the settings do not fit together.
    """

    def __init__(
        self,
        tool: ToolSettings,
        device: DeviceSettings,
        haptics: HapticsSettings,
        profile: DeviceProfile,
        constants: BladeConstants = UNKNOWN_BLADE,
    ) -> None:
        check_together(tool, device, haptics, profile)
        self._tool, self._device, self._profile = tool, device, profile
        self._constants = constants
        self.indexing = Indexing.of(device.tissue_from_device)
        self.unsent: deque[Indexing] = deque(maxlen=_MAX_UNSENT)
        self._order = self._done = Order(self.indexing.scale, haptics)
        self._renew()

    @property
    def haptics(self) -> HapticsSettings:
        """Return the section of the scene with the ordered scale of the force."""
        return self._order.haptics

    @property
    def ordered(self) -> bool:
        """Return whether an order is to be carried out."""
        return self._order is not self._done

    def change(
        self,
        *,
        force_scale: float | None = None,
        motion_scale: float | None = None,
        clutched: bool | None = None,
    ) -> None:
        """Order a change; None: as it is.

        Args:
            force_scale: hand force over tissue force.
            motion_scale: tool motion over hand motion.
            clutched: whether the hand moves without the tool, and without force.

        Raises:
            SettingsError: a scale is out of range, or the coupling would be stiffer than the device
                bears.
        """
        order = self.check(force_scale=force_scale, motion_scale=motion_scale)
        self._order = order if clutched is None else order._replace(clutched=clutched)

    def check(
        self, *, force_scale: float | None = None, motion_scale: float | None = None
    ) -> Order:
        """Return the order of `change`, or raise as it does; nothing changes."""
        order = self._order
        if force_scale is not None:
            values = order.haptics.model_dump() | {'force_scale': force_scale}
            try:
                order = order._replace(haptics=HapticsSettings.model_validate(values))
            except ValidationError as error:
                raise _out_of_range('force_scale', force_scale, error) from None
        if motion_scale is not None:
            order = order._replace(motion_scale=motion_scale)
        try:
            device = scaled(self._device, order.motion_scale)
        except ValidationError as error:
            raise _out_of_range('motion_scale', order.motion_scale, error) from None
        check_together(self._tool, device, order.haptics, self._profile)
        return order

    def resume(self, indexing: Indexing) -> None:
        """Take an indexing that a session had already; before the first tick."""
        self.indexing = indexing
        self._order = self._done = self._order._replace(
            motion_scale=indexing.scale, clutched=indexing.clutched
        )
        self._renew()

    def carry_out(self, state: np.ndarray, stamp_ns: int) -> bool:
        """Carry out the newest order.

        Args:
            state: of the kernels, dtype `force_kernels.STATE`, shape (1,).
            stamp_ns: stamp of the device pose in it [ns].

        Returns:
            Whether the hand has got hold of the tool again.
        """
        order, before = self._order, self.indexing
        self._done = order
        if (order.clutched, order.motion_scale) != (before.clutched, before.scale):
            self.indexing = before.changed(
                state[0]['device'],
                state[0]['orientation'],
                self.setup[0]['rotation'],
                clutched=order.clutched,
                scale=order.motion_scale,
                after_ns=stamp_ns,
            )
            self.unsent.append(self.indexing)
        self._renew()
        return before.clutched and not order.clutched

    def _renew(self) -> None:
        order = self._done
        device = scaled(self._device, order.motion_scale)
        self.setup = force_kernels.make_setup(
            self._tool, device, order.haptics, self._profile, self._constants, self.indexing
        )


def _out_of_range(name: str, value: float, error: ValidationError) -> SettingsError:
    """Return the reason without the model's name and the link that pydantic adds."""
    reason = error.errors()[0]['msg']
    return SettingsError(f'{name} is {value:g}: {reason[0].lower()}{reason[1:]}')
