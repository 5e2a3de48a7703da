"""A button of the device that changes the mode of the tool, and back."""

from collections.abc import Callable

from sensor_msgs.msg import Joy

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.crtk import is_pressed
from cutting_trainer.node_common.lifecycle import ManagedNode


class ModeButton:
    """Calls a function each time that a button is pressed.

    Args:
        node: to subscribe with.
        button: index into `buttons` of `arm/button`.
        press: called when it goes down.
    """

    def __init__(self, node: ManagedNode, button: int, press: Callable[[], None]) -> None:
        self._button, self._press = button, press
        self._is_held = False
        self._presses = ros.listen(node, Joy, f'{ros.ARM}/button', self._event, qos.EVENTS)

    def _event(self, message: Joy) -> None:
        """Follow the button.

        Raises:
            MessageError: the message has no such button.
        """
        was_held, self._is_held = self._is_held, is_pressed(message, self._button)
        if self._is_held and not was_held:
            self._press()
