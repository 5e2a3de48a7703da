"""The frames that do not move: how the device stands to the tissue."""

from geometry_msgs.msg import TransformStamped
from scipy.spatial.transform import Rotation

from haptic_bridge.settings import DeviceSettings
from tissue_sim.ros import ARM, FRAME


def device_frame(device: DeviceSettings) -> TransformStamped:
    """From the tissue's frame to the device's; a scale of motion is none that a transform has.

    Args:
        device: the scene's section `device`.
    """
    frame = device.tissue_from_device
    message = TransformStamped(child_frame_id=f'{ARM}_base')
    message.header.frame_id = FRAME
    to, turn = message.transform.translation, message.transform.rotation
    to.x, to.y, to.z = map(float, frame.translation)
    quaternion = Rotation.from_matrix(frame.rotation()).as_quat()
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
    return message
