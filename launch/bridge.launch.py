"""The device's side alone: the force loop beside an arm's driver. Elsewhere: `sim.launch.py`."""

from launch.substitutions import LaunchConfiguration

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the bridge; it does not enable itself unless asked."""
    names = (
        *('scene', 'seed', 'auto_enable', 'accepted_publishers'),
        *('namespace', 'arm', 'force_topic'),
    )
    arguments = declared(*names, auto_enable='false')
    bridge = nodes(('haptic_bridge',), device=LaunchConfiguration('arm'))
    return LaunchDescription([*arguments, *environment(), *bridge])
