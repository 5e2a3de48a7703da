"""The simulation's side alone: tissue, cutting, recorder; `bridge.launch.py` where the arm is."""

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription

NODES = ('tissue_sim', 'cutting', 'recorder')


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the nodes."""
    arguments = declared('scene', 'seed', 'bag', 'namespace')
    return LaunchDescription([*arguments, *environment(), *nodes(NODES)])
