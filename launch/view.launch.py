"""The page, and the markers for RViz, of nodes that run: `http://127.0.0.1:8080`."""

from launch.substitutions import LaunchConfiguration

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the viewer."""
    arguments = declared('scene', 'host', 'port', 'allow_host', 'namespace', 'arm', 'force_topic')
    viewer = nodes(('viewer',), device=LaunchConfiguration('arm'))
    return LaunchDescription([*arguments, *environment(), *viewer])
