"""The device's side alone: the force loop beside an arm's driver. Elsewhere: `sim.launch.py`."""

from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from session.launching import declared, environment, nodes


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the bridge; it does not enable itself unless asked."""
    arguments = declared('scene', 'seed', 'auto_enable', 'namespace', 'arm', auto_enable='false')
    bridge = nodes(('haptic_bridge',), device=LaunchConfiguration('arm'))
    return LaunchDescription([*arguments, *environment(), *bridge])
