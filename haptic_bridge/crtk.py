"""CRTK over ROS: the operating state's topic, commands and query, that of the device, and a button
to hold.
"""

import time
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from sensor_msgs.msg import Joy

from haptic_bridge.operating_state import (
    COMMANDS,
    E_STOP,
    OperatingStateMachine,
    State,
    crtk_types,
    device_cause,
)
from tissue_sim.lifecycle import ManagedNode
from tissue_sim.refusals import MessageError
from tissue_sim.ros import EVENTS, LATCHED, introspect, listen, stamp

LONGEST_STATE = 64
"""Characters of an operating state's name."""
FAULTS_SAID = 0.1
"""[s] between two lines of the log about a FAULT."""


class StateInterface:
    """Serves `<name>/operating_state` (topic and query) and `<name>/state_command`.

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
        self._publisher = node.create_publisher(self._message, f'{name}/operating_state', LATCHED)
        self._topic = f'{name}/state_command'
        self._commands = listen(node, types.command, self._topic, self._command, EVENTS)
        self._query = node.create_service(types.query, f'{name}/operating_state', self._answer)
        introspect(node, self._query)
        self.publish_changes()

    def publish_changes(self) -> None:
        """Publishes the state if it has changed since; cheap enough for every tick of a loop."""
        if self._published == self._machine.changes:
            return
        self._published = self._machine.changes
        self._publisher.publish(self._current())
        if self._machine.reason:
            self._node.get_logger().error(
                f'FAULT: {self._machine.reason}', throttle_duration_sec=FAULTS_SAID
            )
        else:
            self._node.get_logger().info(f'{self._machine.state}', throttle_duration_sec=1.0)

    def _command(self, message: Any) -> None:
        refused = self._machine.command(message.string)
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
    """Reads `<name>/operating_state` of the device: FAULT at the bridge in all but ENABLED.

    A device without this topic is allowed. One that does not latch it is heard as well, from its
    next change on.

    Args:
        node: to subscribe with.
        name: namespace of the device.
        machine: of the bridge.

    Attributes:
        state: what the device has said last; empty before that.
        cause: why it gives no force, as a sentence; '' if it does or has not said.
    """

    def __init__(self, node: ManagedNode, name: str, machine: OperatingStateMachine) -> None:
        self.state = self.cause = ''
        self._machine = machine
        # That a device does not latch is no reason for a warning of the middleware.
        quiet = SubscriptionEventCallbacks(
            incompatible_qos=lambda _: None, use_default_callbacks=False
        )
        kind, topic = crtk_types().operating_state, f'{name}/operating_state'
        self._subscriptions = [
            listen(node, kind, topic, self._hear, qos, event_callbacks=quiet)
            for qos in (LATCHED, EVENTS)
        ]

    def _hear(self, message: Any) -> None:
        if len(message.state) > LONGEST_STATE or not message.state.isprintable():
            raise MessageError('no such state', f'a state has {LONGEST_STATE} characters at most')
        self.state = message.state
        self.cause = device_cause(message.state, is_homed=message.is_homed)
        if self.cause and self._machine.state is State.ENABLED:
            self._machine.fault(self.cause)


class HoldButton:
    """A dead man's switch: PAUSED while `<name>/button` (sensor_msgs/Joy) is not pressed.

    Pressing resumes what letting go has paused, and nothing else: a `pause` by command stays.

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
        known = bool(message.buttons) and message.buttons[0] in (0, 1)
        self._pressed = known and message.buttons[0] == 1
        self.enforce()
        if not known:  # and counts as let go
            raise MessageError('no such button', 'buttons[0] has to be 0 or 1')

    def enforce(self) -> None:
        """Makes the state what the button asks for; call often."""
        if self._machine.state is not State.PAUSED:
            self._paused = False
        if not self._pressed and self._machine.state is State.ENABLED:
            self._machine.command('pause')
            self._paused = True
        elif self._pressed and self._paused:
            self._machine.command('resume')
            self._paused = False
