"""The frames that do not move: how the device stands to the tissue."""

import time

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from haptic_bridge.orientation import quaternion
from haptic_bridge.settings import DeviceSettings
from tissue_sim.ros import ARM, FRAME, LATCHED, STATIC_FRAMES, stamp

try:
    from tf2_msgs.msg import TFMessage
except ModuleNotFoundError:  # it is not among the wheels
    TFMessage = None


DEVICE_FRAME = f'{ARM}_base'
"""Of the arm's topics, unless its driver has another."""


def device_frame(device: DeviceSettings, name: str = DEVICE_FRAME) -> TransformStamped:
    """From the tissue's frame to the device's; a scale of motion is none that a transform has.

    Args:
        device: the scene's section `device`.
        name: of the device's frame.
    """
    frame = device.tissue_from_device
    message = TransformStamped(child_frame_id=name)
    message.header.frame_id = FRAME
    to, turn = message.transform.translation, message.transform.rotation
    to.x, to.y, to.z = map(float, frame.translation)
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion(frame.rotation()))
    return message


def publishing_command(frame: TransformStamped) -> str:
    """What publishes a static frame, to be run where ROS is installed from packages."""
    to, turn = frame.transform.translation, frame.transform.rotation
    numbers = {'x': to.x, 'y': to.y, 'z': to.z, 'qx': turn.x, 'qy': turn.y, 'qz': turn.z}
    given = ' '.join(f'--{name} {value:.9g}' for name, value in {**numbers, 'qw': turn.w}.items())
    names = f'--frame-id {frame.header.frame_id} --child-frame-id {frame.child_frame_id}'
    return f'ros2 run tf2_ros static_transform_publisher {given} {names}'


class StaticFrames:
    """Publishes /tf_static, where its type is installed; else it says what would do so.

    Args:
        node: that speaks.
        device: the scene's section `device`.
    """

    def __init__(self, node: Node, device: DeviceSettings) -> None:
        self._node, self._device = node, device
        self._names = {DEVICE_FRAME}
        self._publisher = None
        if TFMessage is None:
            command = publishing_command(device_frame(device))
            node.get_logger().info(f'/tf_static needs tf2_msgs; instead: {command}')
        else:
            self._publisher = node.create_publisher(TFMessage, STATIC_FRAMES, LATCHED)
        self._publish()

    def place(self, device: DeviceSettings) -> None:
        """Takes another scene's device."""
        self._device = device
        self._publish()

    def learn(self, name: str) -> None:
        """Takes the frame that a driver gives its poses: it is the device's own too."""
        if name and name != FRAME and name not in self._names:
            self._names = {DEVICE_FRAME, name}
            self._publish()

    def _publish(self) -> None:
        if self._publisher is None:
            return
        frames = [device_frame(self._device, name) for name in sorted(self._names)]
        for frame in frames:
            frame.header.stamp = stamp(time.time_ns())
        self._publisher.publish(TFMessage(transforms=frames))
