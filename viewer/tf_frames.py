"""Static TF frames: the transform between device and tissue."""

import time

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.orientation import quaternion
from cutting_trainer.node_common.qos import LATCHED
from cutting_trainer.node_common.ros import ARM, FRAME, STATIC_FRAMES, stamp

try:
    from tf2_msgs.msg import TFMessage
except ModuleNotFoundError:  # it has no wheel
    TFMessage = None


DEVICE_FRAME = f'{ARM}_base'
"""Frame of the arm's topics, unless its driver has another."""


def device_frame(device: DeviceSettings, name: str = DEVICE_FRAME) -> TransformStamped:
    """Return the transform between the tissue's frame and the device's; it has no motion scale.

    Our own frame of the device is below the tissue's. That of a driver may be in a tree already,
    and two parents would break it: so the tissue's is below that one.

    Args:
        device: the scene's section `device`.
        name: of the device's frame.
    """
    frame = device.tissue_from_device
    place, rotation = np.array(frame.translation), frame.rotation()
    parent, child = FRAME, name
    if name != DEVICE_FRAME:
        parent, child = name, FRAME
        place, rotation = -rotation.T @ place, rotation.T
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    to, turn = message.transform.translation, message.transform.rotation
    to.x, to.y, to.z = map(float, place)
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion(rotation))
    return message


def publishing_command(frame: TransformStamped) -> str:
    """Return the command that publishes a static frame where ROS is installed from packages."""
    to, turn = frame.transform.translation, frame.transform.rotation
    numbers = {'x': to.x, 'y': to.y, 'z': to.z, 'qx': turn.x, 'qy': turn.y, 'qz': turn.z}
    given = ' '.join(f'--{name} {value:.9g}' for name, value in {**numbers, 'qw': turn.w}.items())
    names = f'--frame-id {frame.header.frame_id} --child-frame-id {frame.child_frame_id}'
    return f'ros2 run tf2_ros static_transform_publisher {given} {names}'


class StaticFrames:
    """Publishes tf_static where its type is installed; else logs the command that would.

    Args:
        node: publisher and logger.
        device: the scene's section `device`.
        publish: whether to publish; false: another node of the graph owns the frames.
    """

    def __init__(self, node: Node, device: DeviceSettings, *, publish: bool = True) -> None:
        self._node, self._device = node, device
        self._names = {DEVICE_FRAME}
        self._publisher = None
        if not publish:
            return
        if TFMessage is None:
            command = publishing_command(device_frame(device))
            node.get_logger().info(f'tf_static needs tf2_msgs; instead: {command}')
        else:
            self._publisher = node.create_publisher(TFMessage, STATIC_FRAMES, LATCHED)
        self._publish()

    def place(self, device: DeviceSettings) -> None:
        """Publish the device of another scene."""
        self._device = device
        self._publish()

    def add_frame(self, name: str) -> None:
        """Add the frame of a driver's poses: it is the device's own too."""
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
