"""The five nodes of a session, with the parameters that the command line gives them."""

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription

NODES = ('emulated_arm', 'haptic_bridge', 'tissue_sim', 'cutting', 'recorder')


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the nodes."""
    arguments = declared(
        *('scene', 'seed', 'seconds', 'auto_enable', 'accepted_publishers', 'bag', 'namespace')
    )
    return LaunchDescription([*arguments, *environment(), *nodes(NODES)])
