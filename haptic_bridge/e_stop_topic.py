"""E-STOP over ROS: the topic that presses it, a device's button, the launcher's line, the reset.

The latch itself is a flag of `OperatingStateMachine`. The tick of the force loop reads the inputs
that press it from their own subscriptions: no other message delays them.
"""

import os
import select
import stat
import threading
import time
from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool, Empty
from std_srvs.srv import Trigger

from cutting_trainer.node_common import output, qos, ros
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.operating_state import E_STOP, OperatingStateMachine

CONTROL_PREFIX = 'e_stop: '
"""Prefix of a control line on standard output; `pressed` or `released` follows."""
MAX_MESSAGES_PER_TICK = 10
"""Messages of each topic that a tick reads at most: as many as their queues hold."""
POLL_PERIOD_S = 0.05
"""[s] between two looks while the node does not work."""
_STDIN = 0


class EStop:
    """Presses and releases the latch of a machine, and publishes its state.

    Args:
        node: to make topics and the service with.
        machine: owner of the latch.
        button: index into `buttons` of `arm/button` that presses it; negative: none.
        passes_on: press those of the other tools too, by the topic that all share.

    Attributes:
        pressed_ns: stamp of the tick that received the last press [ns]; 0 before the first.

    Limitations: `poll` may run in one thread at a time.
    """

    def __init__(
        self,
        node: ManagedNode,
        machine: OperatingStateMachine,
        button: int,
        *,
        passes_on: bool = False,
    ) -> None:
        self.pressed_ns = 0
        self._node, self._machine, self._button = node, machine, button
        self._topic = ros.polled(node, Empty, ros.E_STOP, qos.EVENTS)
        self._others = node.create_publisher(Empty, ros.E_STOP, qos.EVENTS) if passes_on else None
        self._joy: Any = None
        if button >= 0:
            self._joy = ros.polled(node, Joy, f'{ros.ARM}/button', qos.EVENTS)
        self._is_held = False
        self._counted = 0
        self._said = self._is_asked = False
        self._published: bool | None = None
        self._publisher = node.create_publisher(Bool, 'haptic_bridge/e_stopped', qos.LATCHED)
        self._service = node.create_service(Trigger, 'haptic_bridge/reset_e_stop', self._reset)
        ros.introspect(node, self._service)
        self._publish_change()

    def poll(self, stamp_ns: int) -> None:
        """Press the latch on request, and publish a change of its state; called in every tick.

        Args:
            stamp_ns: of the tick, by the system clock [ns].
        """
        asked = False
        for _ in range(MAX_MESSAGES_PER_TICK):
            if ros.take_raw(self._topic) is None:
                break
            asked = True
        if asked or (self._joy is not None and self._button_is_pressed()):
            self._machine.press()
        if self._machine.presses != self._counted:
            self._counted = self._machine.presses
            self.pressed_ns = stamp_ns
        self._publish_change()

    def confirm(self) -> None:
        """Tell the launcher the state at the next poll: it repeats a request until it hears it."""
        self._is_asked = True

    def _publish_change(self) -> None:
        """Publish a change: first to the launcher, which restarts the node if it dies."""
        asked, self._is_asked = self._is_asked, False
        pressed = self._machine.e_stopped
        if asked or pressed is not self._said:
            word = 'pressed' if pressed else 'released'
            output.announce(f'{CONTROL_PREFIX}{word}')
            self._said = pressed
        if pressed is not self._published:
            if pressed and self._others is not None:
                self._others.publish(Empty())
            self._published = pressed
            self._publisher.publish(Bool(data=pressed))

    def _button_is_pressed(self) -> bool:
        for _ in range(MAX_MESSAGES_PER_TICK):
            data = ros.take_raw(self._joy)
            if data is None:
                break
            try:
                buttons = deserialize_message(data, Joy).buttons
                self._is_held = bool(buttons[self._button])
            except Exception as error:  # a button that cannot be read counts as pressed
                self._is_held = True
                self._node.rejections.add(f'{ros.ARM}/button', error)
            if self._is_held:
                return True
        return False

    def _reset(self, _request: Any, response: Any) -> Any:
        if self._is_held:
            response.success = False
            response.message = "the device's E-STOP button is still pressed: release it first"
            return response
        pressed = self.pressed_ns
        released = self._machine.reset()
        response.success = True
        response.message = (
            f'released: was pressed at {pressed} ns' if released else 'was not pressed'
        )
        return response


class Listener:
    """Reads the launcher's line `e_stop`, and polls the topic while the node does not work.

    Standard input is read only where it is a pipe: a process in the background that reads from its
    terminal is stopped by the system.

    Args:
        node: its `press_e_stop` and `poll_e_stop` are called, from a daemon thread.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._pipe = _is_pipe(_STDIN)
        self._rest = b''
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while self._node.context.ok():
            pipes = [_STDIN] if self._pipe else []
            try:
                if select.select(pipes, [], [], POLL_PERIOD_S)[0]:
                    self._read()
                self._node.poll_e_stop()
            except Exception as error:  # the key must work after any error
                self._node.rejections.add('e_stop', error)
                time.sleep(POLL_PERIOD_S)

    def _read(self) -> None:
        data = os.read(_STDIN, 4096)
        self._pipe = bool(data)
        *lines, self._rest = (self._rest + data).split(b'\n')
        self._rest = self._rest[:64]
        if any(line.strip() == E_STOP.encode() for line in lines):
            self._node.press_e_stop()


def _is_pipe(file: int) -> bool:
    try:
        return stat.S_ISFIFO(os.fstat(file).st_mode)
    except OSError:
        return False
