"""Node `omni_adapter`: adapts an omni_msgs driver to the CRTK interface of an arm."""

import time
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped, Vector3, WrenchStamped
from sensor_msgs.msg import Joy

from cutting_trainer.haptic_bridge.devices.omni import ForceLatch, OmniConvention
from cutting_trainer.node_common.cdr_codec import (
    PoseStampedCodec,
    TwistStampedCodec,
    WireError,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.lifecycle import ManagedNode, Stop, announce_ready, run
from cutting_trainer.node_common.parameters import parameter
from cutting_trainer.node_common.qos import EVENTS, NEWEST_BEST_EFFORT, STREAM
from cutting_trainer.node_common.realtime import prepare, run_real_time
from cutting_trainer.node_common.ros import ARM, polled, stamp, take, take_raw
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.node_common.timing import PeriodicLoop

RATE_HZ = 1000.0
_ZERO = (0.0, 0.0, 0.0)


class OmniAdapter(ManagedNode):
    """Converts state, button and force between omni_msgs and CRTK, at 1 kHz.

    `omni/state` becomes `arm/measured_cp` and `arm/measured_cv`, `omni/button` (the grey one)
    `arm/button`, and `arm/servo_cf` becomes `omni/force_feedback`.

    Parameters:
        unit, force_axes, timeout: see `OmniConvention`.

    Raises:
        ValueError: omni_msgs is not installed, or a parameter is wrong.
    """

    def __init__(self) -> None:
        super().__init__('omni_adapter')

    def configure(self) -> None:
        """Read the parameters and create the topics of both sides."""
        default = OmniConvention()
        convention = OmniConvention(
            str(parameter(self, 'unit', default.unit, 'of length in omni/state: m or mm')),
            str(parameter(self, 'force_axes', default.force_axes, "frame of the driver's force")),
            float(
                parameter(
                    self,
                    'timeout',
                    default.timeout,
                    'age of a force command at which it becomes zero [s]',
                    within=(0.005, 0.3),
                )
            ),
        )
        try:
            from omni_msgs.msg import OmniButtonEvent, OmniFeedback, OmniState
        except ModuleNotFoundError:
            raise ValueError(
                "omni_msgs is not installed: build it with the driver's workspace and source that"
            ) from None
        self._convention, self._latch = convention, ForceLatch(convention)
        self._feedback_type = OmniFeedback
        self._codecs = PoseStampedCodec(f'{ARM}_base'), TwistStampedCodec(f'{ARM}_base')
        self._wrench = WrenchStampedCodec()
        self._measured_cp = self.create_publisher(PoseStamped, f'{ARM}/measured_cp', STREAM)
        self._measured_cv = self.create_publisher(TwistStamped, f'{ARM}/measured_cv', STREAM)
        self._button = self.create_publisher(Joy, f'{ARM}/button', EVENTS)
        self._feedback = self.create_publisher(OmniFeedback, 'omni/force_feedback', EVENTS)
        self._servo_cf = polled(self, WrenchStamped, f'{ARM}/servo_cf', NEWEST_BEST_EFFORT)
        self._state = polled(self, OmniState, 'omni/state', NEWEST_BEST_EFFORT)
        self.create_subscription(OmniButtonEvent, 'omni/button', self._press, EVENTS)
        self._loop = PeriodicLoop(RATE_HZ, phase=0.5)

    @property
    def progress(self) -> int:
        """Return the number of loop iterations."""
        return self._loop.ticks

    def work(self, stop: Stop) -> None:
        """Convert messages in the calling thread."""
        announce_ready(self)
        self.get_logger().info(prepare())
        run_real_time(self._loop, self._tick, stop)

    def rest(self) -> None:
        """Set the force to zero."""
        self._push(_ZERO)

    def _tick(self, _late: int) -> None:
        if (state := take(self._state)) is not None:
            self._pass_on(state)
        now = time.monotonic_ns()
        if (raw := take_raw(self._servo_cf)) is not None:
            try:
                stamp, _, values = self._wrench.decode(raw)
            except WireError as error:
                stamp, values = 0, _ZERO
                self.get_logger().error(str(error), throttle_duration_sec=1.0)
            self._latch.take(stamp, values[:3], now)
        self._push(self._latch.force(now))

    def _pass_on(self, state: Any) -> None:
        valid = nanoseconds(state.header.stamp)
        p, q, v = state.pose.position, state.pose.orientation, state.velocity
        pose = (*self._convention.metres((p.x, p.y, p.z)), q.x, q.y, q.z, q.w)
        twist = (*self._convention.metres((v.x, v.y, v.z)), *_ZERO)
        self._measured_cp.publish(self._codecs[0].encode(valid, pose))
        self._measured_cv.publish(self._codecs[1].encode(valid, twist))

    def _press(self, event: Any) -> None:
        message = Joy(buttons=[int(event.grey_button), int(event.white_button)])
        message.header.stamp = stamp(time.time_ns())
        self._button.publish(message)

    def _push(self, force: tuple[float, ...]) -> None:
        vector = Vector3(x=force[0], y=force[1], z=force[2])
        self._feedback.publish(self._feedback_type(force=vector))


def main() -> None:
    """Run the node."""
    run(OmniAdapter)


if __name__ == '__main__':
    main()
