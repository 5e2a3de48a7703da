"""The five nodes of a session, with the parameters that the command line gives them."""

from launch import LaunchDescription
from session.launching import declared, environment, nodes

NODES = ('emulated_arm', 'haptic_bridge', 'tissue_sim', 'cutting', 'recorder')


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the nodes."""
    arguments = declared('scene', 'seed', 'seconds', 'auto_enable', 'bag', 'namespace')
    return LaunchDescription([*arguments, *environment(), *nodes(NODES)])
