"""Calls everything compiled of the force loop once, so that nothing is compiled or loaded in it."""

import numpy as np

from haptic_bridge.chain import TOUCHING
from haptic_bridge.force_path import ForcePath
from haptic_bridge.operating_state import State
from haptic_bridge.settings import DeviceProfile, DeviceSettings, HapticsSettings, ToolSettings
from haptic_bridge.surface import Surface
from haptic_bridge.wire import Sample


def warm_up(
    tool: ToolSettings, device: DeviceSettings, haptics: HapticsSettings, profile: DeviceProfile
) -> ForcePath:
    """Compiles, or loads from the cache, everything that a tick calls, by touching a triangle.

    Returns:
        What has touched it.
    """
    frame = device.tissue_from_device
    place = frame.to_tissue(np.zeros(3))
    corners = place + np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    triangle = np.array([[0, 1, 2]], np.int32)
    surface = Surface(corners, triangle, revision=0, topology=0)
    path = ForcePath(tool, device, haptics, profile)
    # What is not yet ENABLED cannot jump.
    states = (State.DISABLED, *(State.ENABLED,) * 4)
    for i, (state, height) in enumerate(zip(states, (1.01, 1.01, 0.99, 0.99, 0.99), strict=True)):
        tip = frame.to_device(place + np.array([0.0, 0.0, height * tool.radius]))
        stamp = (i + 1) * 1_000_000
        pose = Sample(stamp, '', (*tip.tolist(), 0.0, 0.0, 0.0, 1.0))
        sample = Sample(stamp, '', (i, i, 0, i, 0, stamp, TOUCHING) + (1e-3,) * 18)
        path.tick(stamp, state=state, pose=pose, sample=sample, surface=surface)
        surface = Surface(corners, triangle, revision=i + 1, topology=0, previous=surface)
        corners = corners + 1e-5
    return path
