"""Buttons and jaws of the device, and their actions: mode of the tool, clutch, reset.

E-STOP is in `e_stop_topic.py`, `hold_button` in `node_common/crtk.py`.
"""

from functools import partial

from rclpy.parameter import Parameter

from cutting_trainer.haptic_bridge.device_button import DeviceButton
from cutting_trainer.haptic_bridge.device_jaw import DeviceJaw
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.tissue_sim.contact.tool import ToolMode
from cutting_trainer.tissue_sim.streaming.reset_client import ResetClient

BUTTON, CLUTCH = 'button', 'clutch'
"""Topics of buttons below `arm`."""


class DeviceInputs:
    """Follows the device's buttons and jaws; E-STOP and `hold_button` have classes of their own.

    Args:
        node: to subscribe with, with the parameter `tool_mode`.
        device: buttons and angle with their actions.
        path: of the force.

    Attributes:
        clutch: button that takes the hand off the tool.
    """

    def __init__(self, node: ManagedNode, device: DeviceSettings, path: ForcePath) -> None:
        self._node, self._path = node, path
        clutch = (CLUTCH, 0) if device.clutch_button is None else (BUTTON, device.clutch_button)
        self.clutch = DeviceButton(node, *clutch, self._change_clutch)
        self._jaw: DeviceJaw | None = None
        self._buttons = []
        if device.mode_button is not None:
            self._buttons.append(DeviceButton(node, BUTTON, device.mode_button, self.change_mode))
        if device.reset_button is not None:
            client = ResetClient(node, node.get_logger().warning)
            reset = partial(_reset_tissue, client)
            self._buttons.append(DeviceButton(node, BUTTON, device.reset_button, reset))
        if device.jaw_closed is not None:
            self._jaw = DeviceJaw(node, device.jaw_closed, self._change_jaw)

    def poll(self) -> None:
        """Follow the jaws."""
        if self._jaw is not None:
            self._jaw.poll()

    def change_mode(self, pressed: bool) -> None:
        """Make a palpator of the scalpel, or close the jaws of a grasper, and back."""
        if pressed:
            self._set_mode(self._path.next_mode.other)

    def _change_jaw(self, closed: bool) -> None:
        """Make of the tool what it is with its jaws closed, or open."""
        self._set_mode(self._path.next_mode.with_jaws(closed=closed))

    def _set_mode(self, mode: ToolMode) -> None:
        self._node.set_parameters([Parameter('tool_mode', value=mode.name.lower())])

    def _change_clutch(self, pressed: bool) -> None:
        """Take the hand off the tool while the button is pressed."""
        self._path.coupling.change(clutched=pressed)


def _reset_tissue(client: ResetClient, pressed: bool) -> None:
    """Ask for the whole tissue; force and E-STOP stay as they are."""
    if pressed:
        client.ask()
