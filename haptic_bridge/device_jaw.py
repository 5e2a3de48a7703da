"""Jaws of the device's instrument: their angle chooses the mode of the tool."""

import math
from collections.abc import Callable

from sensor_msgs.msg import JointState

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.rejections import MessageError

TOPIC = f'{ros.ARM}/jaw/measured_js'
OPENING_RAD = 0.1
"""[rad] beyond the angle at which the jaws close, up to which they stay closed."""


class DeviceJaw:
    """Calls a function when the jaws of the device open or close, and once at their first angle.

    Args:
        node: to subscribe with.
        closed: angle [rad] at which the jaws close.
        change: called with whether they are closed now.
    """

    def __init__(self, node: ManagedNode, closed: float, change: Callable[[bool], None]) -> None:
        self._node, self._closed, self._change = node, closed, change
        self._is_closed: bool | None = None
        self._angles = ros.polled(node, JointState, TOPIC, qos.NEWEST_BEST_EFFORT)

    def poll(self) -> None:
        """Follow the newest angle; a message without one is refused."""
        try:
            message = ros.take(self._angles, self._node.max_message)
            if message is None:
                return
            angle = jaw_angle(message)
        except MessageError as error:
            self._node.rejections.add(TOPIC, error)
            return
        is_closed = angle <= self._closed + (OPENING_RAD if self._is_closed else 0.0)
        if is_closed is not self._is_closed:
            self._is_closed = is_closed
            self._change(is_closed)


def jaw_angle(message: JointState) -> float:
    """Return the angle of the jaws [rad].

    Raises:
        MessageError: the message has none, or more than one.
    """
    if len(message.position) != 1 or not math.isfinite(message.position[0]):
        text = f'position of {TOPIC} has to be one angle [rad], not {list(message.position)!r:.60}'
        raise MessageError('no angle of the jaws', text)
    return float(message.position[0])
