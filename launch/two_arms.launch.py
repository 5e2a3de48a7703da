"""Two trainers beside each other, a left and a right one, each with its arm and tissue; one bag."""

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription

SIDES = ('left', 'right')
NODES = ('emulated_arm', 'haptic_bridge', 'tissue_sim', 'cutting')


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the nodes of both sides, and one recorder for all."""
    arguments = declared(
        *('left_scene', 'right_scene', 'seed', 'seconds', 'auto_enable', 'bag'),
        'accepted_publishers',
    )
    both = [
        node
        for side in SIDES
        for node in nodes(NODES, namespace=side, arguments={'scene': f'{side}_scene'})
    ]
    recorder = nodes(('recorder',), namespace='', arguments={'scene': 'left_scene'})
    return LaunchDescription([*arguments, *environment(), *both, *recorder])
