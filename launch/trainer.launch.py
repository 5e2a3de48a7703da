"""The five nodes of a session, with the parameters that the command line gives them."""

import os

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from session.graph import discovery

CONFIG = [FindPackageShare('cutting_trainer'), 'config']
ARGUMENTS = {
    'scene': (
        PathJoinSubstitution([*CONFIG, 'scenes', 'liver.yaml']),
        'Scene file, absolute path',
    ),
    'seed': ('0', 'Seed of everything random'),
    'seconds': ('20.0', "Duration that the arm's script is stretched to [s]"),
    'auto_enable': ('true', 'Whether the bridge enables itself and the arm'),
    'bag': ('session', 'New folder for the bag'),
}
TYPES = {'scene': str, 'seed': int, 'seconds': float, 'auto_enable': bool, 'bag': str}
NODES = {
    'emulated_arm': ('seconds',),
    'haptic_bridge': ('auto_enable',),
    'tissue_sim': (),
    'cutting': (),
    'recorder': ('bag',),
}
"""Executable, which is the node's name too, and the parameters that it has beside the common."""


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts the nodes."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    nodes = [
        Node(
            package='cutting_trainer',
            executable=name,
            name=name,
            output='screen',
            parameters=[
                {
                    key: ParameterValue(LaunchConfiguration(key), value_type=TYPES[key])
                    for key in ('scene', 'seed', *own)
                }
            ],
        )
        for name, own in NODES.items()
    ]
    environment = [SetEnvironmentVariable(*item) for item in discovery(os.environ).items()]
    return LaunchDescription([*arguments, *environment, *nodes])
