"""Follows one button of the device; `device_inputs.py` gives each button its action."""

from collections.abc import Callable

from sensor_msgs.msg import Joy

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.crtk import is_pressed
from cutting_trainer.node_common.lifecycle import ManagedNode


class DeviceButton:
    """Calls a function each time that a button goes down or up.

    Args:
        node: to subscribe with.
        name: topic of the button below `arm`.
        button: index into its `buttons`.
        change: called with whether it is pressed now.
    """

    def __init__(
        self, node: ManagedNode, name: str, button: int, change: Callable[[bool], None]
    ) -> None:
        self._button, self._change = button, change
        self._is_held = False
        self._presses = ros.listen(node, Joy, f'{ros.ARM}/{name}', self._event, qos.EVENTS)

    def _event(self, message: Joy) -> None:
        """Follow the button.

        Raises:
            MessageError: the message has no such button.
        """
        was_held, self._is_held = self._is_held, is_pressed(message, self._button)
        if self._is_held != was_held:
            self._change(self._is_held)
