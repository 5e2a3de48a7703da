"""CRTK over ROS: operating state of a node and of the device, and a hold-to-run button."""

import math
import time
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from sensor_msgs.msg import Joy

from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.operating_state import (
    COMMANDS,
    E_STOP,
    CrtkState,
    OperatingStateMachine,
    crtk_types,
    device_cause,
)
from cutting_trainer.node_common.qos import EVENTS, LATCHED
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.node_common.ros import introspect, listen, stamp

MAX_STATE_LENGTH = 64
"""Characters in the name of an operating state."""
FAULT_LOG_PERIOD_S = 0.1
"""Between two log lines about a FAULT."""
REPLY_PERIOD_S = 0.01
"""Between two replies to commands without effect; commands that come sooner share one reply."""


class StateInterface:
    """Serves `<name>/operating_state` (topic and query) and `<name>/state_command`.

    The state is published when it changes and after each command, even one without effect. CRTK's
    clients subscribe volatile and wait for the message after their command. The state is repeated a
    moment later, because a client drops messages while it is still sending: without the repetition
    one `home` in ten was never answered.

    Args:
        node: the node that the machine belongs to.
        name: namespace, 'arm' or 'haptic_bridge'.
        machine: shared with the loop of the node, which calls `publish_changes`.
    """

    def __init__(self, node: ManagedNode, name: str, machine: OperatingStateMachine) -> None:
        types = crtk_types()
        self._node = node
        self._machine = machine
        self._message = types.operating_state
        self._published = -1
        self._owed = 0
        self._answered = -math.inf
        self._publisher = node.create_publisher(self._message, f'{name}/operating_state', LATCHED)
        self._topic = f'{name}/state_command'
        self._commands = listen(node, types.command, self._topic, self._command, EVENTS)
        self._query = node.create_service(types.query, f'{name}/operating_state', self._answer)
        introspect(node, self._query)
        self.publish_changes()

    def publish_changes(self) -> None:
        """Publish a changed state or a pending reply; cheap enough for every tick of a loop."""
        changed = self._published != self._machine.changes
        if not changed and not (self._owed and time.monotonic() - self._answered >= REPLY_PERIOD_S):
            return
        self._published = self._machine.changes
        self._owed, self._answered = max(self._owed - 1, 0), time.monotonic()
        self._publisher.publish(self._current())
        if changed:
            self._say()

    def _say(self) -> None:
        if self._machine.reason:
            self._node.get_logger().error(
                f'FAULT: {self._machine.reason}', throttle_duration_sec=FAULT_LOG_PERIOD_S
            )
        else:
            self._node.get_logger().info(f'{self._machine.state}', throttle_duration_sec=1.0)

    def _command(self, message: Any) -> None:
        refused = self._machine.command(message.string)
        self._owed = 2
        self.publish_changes()
        if refused:
            known = message.string in (*COMMANDS, E_STOP)
            raise MessageError('not valid now' if known else 'no such command', refused)

    def _answer(self, _request: Any, response: Any) -> Any:
        response.operating_state = self._current()
        return response

    def _current(self) -> Any:
        message = self._message(
            state=str(self._machine.state),
            is_homed=self._machine.is_homed,
            is_busy=self._machine.is_busy,
        )
        message.header.stamp = stamp(time.time_ns())
        return message


class DeviceState:
    """Reads `<name>/operating_state` of the device; the bridge is in FAULT unless it is ENABLED.

    A device without this topic is allowed. A device that does not latch the topic is read from its
    next change on.

    Args:
        node: to subscribe with.
        name: namespace of the device.
        machine: of the bridge.

    Attributes:
        state: last state from the device; empty before the first.
        cause: why the device gives no force, as a sentence; '' if it does or its state is unknown.
    """

    def __init__(self, node: ManagedNode, name: str, machine: OperatingStateMachine) -> None:
        self.state = self.cause = ''
        self._machine = machine
        # A device that does not latch must not cause a warning of the middleware.
        quiet = SubscriptionEventCallbacks(
            incompatible_qos=lambda _: None, use_default_callbacks=False
        )
        kind, topic = crtk_types().operating_state, f'{name}/operating_state'
        self._subscriptions = [
            listen(node, kind, topic, self._hear, qos, event_callbacks=quiet)
            for qos in (LATCHED, EVENTS)
        ]

    def _hear(self, message: Any) -> None:
        if len(message.state) > MAX_STATE_LENGTH or not message.state.isprintable():
            raise MessageError(
                'no such state', f'a state has {MAX_STATE_LENGTH} characters at most'
            )
        self.state = message.state
        self.cause = device_cause(message.state, is_homed=message.is_homed)
        if self.cause and self._machine.state is CrtkState.ENABLED:
            self._machine.fault(self.cause)


def is_pressed(message: Joy, button: int) -> bool:
    """Return whether a button is pressed.

    Args:
        message: of the device.
        button: index into its `buttons`.

    Raises:
        MessageError: the message has no such button.
    """
    if not (button < len(message.buttons) and message.buttons[button] in (0, 1)):
        raise MessageError('no such button', f'buttons[{button}] has to be 0 or 1')
    return bool(message.buttons[button])


class HoldButton:
    """A dead man's switch: PAUSED while `<name>/button` (sensor_msgs/Joy) is not pressed.

    Pressing only undoes the pause by release: a `pause` by command stays.

    Args:
        node: to subscribe with.
        name: namespace of the device.
        machine: of the bridge.
    """

    def __init__(self, node: ManagedNode, name: str, machine: OperatingStateMachine) -> None:
        self._machine = machine
        self._pressed = self._paused = False
        self._presses = listen(node, Joy, f'{name}/button', self._event, EVENTS)

    def _event(self, message: Joy) -> None:
        self._pressed = False  # also of a message without the button
        try:
            self._pressed = is_pressed(message, 0)
        finally:
            self.enforce()

    def enforce(self) -> None:
        """Pause or resume as the button requires; call often."""
        if self._machine.state is not CrtkState.PAUSED:
            self._paused = False
        if not self._pressed and self._machine.state is CrtkState.ENABLED:
            self._machine.command('pause')
            self._paused = True
        elif self._pressed and self._paused:
            self._machine.command('resume')
            self._paused = False
