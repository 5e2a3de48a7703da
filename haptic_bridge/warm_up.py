"""Warm-up of the force loop: calls each compiled function once, before the loop starts."""

import numpy as np

from cutting_trainer.haptic_bridge.force_kernels import INSIDE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction


def warm_up(
    tool: ToolSettings,
    device: DeviceSettings,
    haptics: HapticsSettings,
    profile: DeviceProfile,
    friction: Friction = NO_FRICTION,
) -> ForcePath:
    """Compile, or load from the cache, every kernel of a tick, by touching a triangle.

    Returns:
        The touch of the proxy.
    """
    frame = device.tissue_from_device
    place = frame.to_tissue(np.zeros(3))
    corners = place + np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    triangle = np.array([[0, 1, 2]], np.int32)
    surface = Surface(corners, triangle, revision=0, topology=0)
    path = ForcePath(tool, device, haptics, profile, friction=friction)
    # The jump check is off before ENABLED.
    states = (CrtkState.DISABLED, *(CrtkState.ENABLED,) * 4)
    for i, (state, height) in enumerate(zip(states, (1.01, 1.01, 0.99, 0.99, 0.99), strict=True)):
        tip = frame.to_device(place + np.array([0.0, 0.0, height * tool.radius]))
        stamp = (i + 1) * 1_000_000
        pose = StampedMessage(stamp, '', (*tip.tolist(), 0.0, 0.0, 0.0, 1.0))
        # One says that the blade is in the tissue, which is to be checked.
        said = INSIDE if i == 1 else TOUCHING
        values = (i, i, 0, i, 0, stamp, said, *(1e-3,) * 18, 0, *(1e-3,) * 6)
        sample = StampedMessage(stamp, '', values)
        path.tick(stamp, state=state, pose=pose, sample=sample, surface=surface)
        surface = Surface(corners, triangle, revision=i + 1, topology=0, previous=surface)
        corners = corners + 1e-5
    return path
