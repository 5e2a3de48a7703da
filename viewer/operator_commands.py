"""Operator's commands to the graph, by its public topics and services."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Bool, Empty
from std_srvs.srv import Trigger

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.operating_state import CrtkState, crtk_types
from cutting_trainer.viewer.page_protocol import Guide

BRIDGE = 'haptic_bridge'
ARM_STATE_DELAY_S = 0.1
"""[s] in which the haptic bridge receives the arm's state too."""


class Operation:
    """Commands haptic bridge and arm.

    `stop_at_once` and `guide` may be called by any thread, the rest by one.

    Args:
        node: for publishers, subscriptions and clients.
        warn: called with a sentence for the operator; may be called by any thread.
        tools: namespaces of the further tools: commands are for all, the state is the first's.

    Attributes:
        state: of the haptic bridge; None before it is known.
        e_stopped: whether an E-STOP holds.
    """

    def __init__(
        self, node: ManagedNode, warn: Callable[[str], None], tools: Sequence[str] = ()
    ) -> None:
        self.state: CrtkState | None = None
        self.e_stopped = False
        self._arm_state: CrtkState | None = None
        self._warn = warn
        self._enable_at = math.inf
        self._starting = False
        types = crtk_types()
        self._command = types.command
        prefixes = ('', *(f'{tool}/' for tool in tools))
        self._to_bridge, self._to_arm = (
            [
                node.create_publisher(types.command, f'{prefix}{name}/state_command', qos.EVENTS)
                for prefix in prefixes
            ]
            for name in (BRIDGE, ros.ARM)
        )
        self._stop = node.create_publisher(Empty, f'{BRIDGE}/e_stop', qos.EVENTS)
        self._goal = node.create_publisher(PoseStamped, ros.HAND, qos.EVENTS)
        self._setter = node.create_client(SetParameters, f'{BRIDGE}/set_parameters')
        self._resetters = [
            node.create_client(Trigger, f'{prefix}{BRIDGE}/reset_e_stop') for prefix in prefixes
        ]
        for name, take in ((BRIDGE, self._bridge_says), (ros.ARM, self._arm_says)):
            topic = f'{name}/operating_state'
            ros.listen(node, types.operating_state, topic, take, qos.LATCHED)
        ros.listen(node, Bool, f'{BRIDGE}/e_stopped', self._stop_says, qos.LATCHED)

    @property
    def can_guide(self) -> bool:
        """Return whether the hand follows goals: the emulated one, while the force is on."""
        return self.state is CrtkState.ENABLED and self._goal.get_subscription_count() > 0

    def go_on(self, now: float) -> None:
        """Execute the commands that are due at a time [s], monotonic."""
        if now >= self._enable_at:
            self._enable_bridge()

    def start(self) -> None:
        """Enable the force: first the arm, since the bridge refuses while its device takes none."""
        if self._arm_state in (None, CrtkState.ENABLED):
            self._enable_bridge()
        else:
            self._starting = True
            self._send(self._to_arm, 'resume' if self._arm_state is CrtkState.PAUSED else 'enable')

    def pause(self) -> None:
        """Disable the force; the hand stands still."""
        self._starts_no_more()
        self._send(self._to_bridge, 'pause')
        self._send(self._to_arm, 'pause')

    def stop_at_once(self) -> None:
        """Press E-STOP: zero force with the bridge's next tick; the arm stops independently."""
        self._stop.publish(Empty())
        self._starts_no_more()
        self._send(self._to_arm, 'disable')

    def reset_stop(self) -> None:
        """Clear the E-STOP; force stays off until `start`."""
        if not all(resetter.service_is_ready() for resetter in self._resetters):
            self._warn('The haptic bridge does not answer: the E-STOP holds.')
            return
        for resetter in self._resetters:
            future = resetter.call_async(Trigger.Request())
            future.add_done_callback(lambda done: self._was_reset(done.result()))

    def _was_reset(self, response: Any) -> None:
        if response is None or not response.success:
            why = f' {response.message}' if response is not None else ''
            self._warn(f'The E-STOP holds.{why}')

    def guide(self, goal: Guide) -> None:
        """Send the emulated hand a goal in the tissue frame."""
        message = PoseStamped()
        message.header.frame_id = ros.FRAME
        message.header.stamp = ros.stamp(time.time_ns())
        place, turn = message.pose.position, message.pose.orientation
        place.x, place.y, place.z = goal.position
        turn.w, turn.x, turn.y, turn.z = goal.wxyz
        self._goal.publish(message)

    def scale(self, value: float, done: Callable[[bool], None]) -> None:
        """Set the ratio of the hand's force to the tissue's.

        Args:
            value: to set.
            done: called by any thread with whether the new scale holds.
        """
        if not self._setter.service_is_ready():
            self._warn('The haptic bridge does not answer: the force scale stays.')
            done(False)
            return
        parameter = Parameter('force_scale', Parameter.Type.DOUBLE, value)
        request = SetParameters.Request(parameters=[parameter.to_parameter_msg()])
        future = self._setter.call_async(request)
        future.add_done_callback(lambda answer: self._was_scaled(value, answer.result(), done))

    def _was_scaled(self, value: float, response: Any, done: Callable[[bool], None]) -> None:
        result = response.results[0]
        if not result.successful:
            self._warn(f'force scale {value:g} refused: {result.reason}')
        done(result.successful)

    def _enable_bridge(self) -> None:
        self._starts_no_more()
        self._send(self._to_bridge, 'resume' if self.state is CrtkState.PAUSED else 'enable')

    def _starts_no_more(self) -> None:
        self._starting, self._enable_at = False, math.inf

    def _send(self, publishers: Sequence[Any], word: str) -> None:
        message = self._command(string=word)
        message.header.stamp = ros.stamp(time.time_ns())
        for publisher in publishers:
            publisher.publish(message)

    def _bridge_says(self, message: Any) -> None:
        self.state = known_state(message.state)

    def _arm_says(self, message: Any) -> None:
        self._arm_state = known_state(message.state)
        if self._starting and self._arm_state is CrtkState.ENABLED:
            self._enable_at = time.monotonic() + ARM_STATE_DELAY_S

    def _stop_says(self, message: Any) -> None:
        self.e_stopped = bool(message.data)


def known_state(name: str) -> CrtkState | None:
    """Return one of CRTK's states; None where a foreign device sends another."""
    return next((state for state in CrtkState if state == name), None)
