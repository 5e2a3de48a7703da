"""Shared parts of the launch files: nodes of a graph, with parameters of the command line.

This module needs launch and launch_ros. ROS from Ubuntu packages has them, the wheels do not.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from cutting_trainer.session.node_commands import (
    ARM_NODE,
    BRIDGE_NODE,
    DEVICE_TOPICS,
    RECORDER_NODE,
    VIEWER_NODE,
    discovery,
)

PACKAGE = 'cutting_trainer'
ARGUMENTS: dict[str, tuple[Any, str]] = {
    'scene': (None, 'scene file, absolute path'),
    'left_scene': (None, 'scene file of the left side, absolute path'),
    'right_scene': (None, 'scene file of the right side, absolute path'),
    'seed': ('0', 'seed of everything random'),
    'seconds': ('20.0', "duration that the arm's script is stretched to [s]"),
    'auto_enable': ('true', 'whether the bridge enables itself and the arm'),
    'accepted_publishers': (
        '',
        'comma-separated nodes, as /name, that alone may publish poses, forces and meshes',
    ),
    'bag': ('session', 'new folder for the bag'),
    'namespace': ('', 'of all nodes and topics, for more than one trainer in a graph'),
    'host': ('127.0.0.1', 'address that the page is served on; 0.0.0.0: open to other machines'),
    'port': ('8080', 'port of the page'),
    'allow_host': ('', 'comma-separated host names under which the page is served'),
    'arm': ('arm', 'namespace of the device, as in /MTML for /MTML/measured_cp'),
    'force_topic': (
        'servo_cf',
        'topic below it on which the device takes the force, unless the scene sets it: servo_cf, '
        'body/servo_cf or spatial/servo_cf',
    ),
    'psm': ('/PSM1', 'namespace of the simulated arm whose instrument is the tool'),
    'pose_topic': (
        'measured_cp',
        'topic of its pose below it: measured_cp, or local/measured_cp for the frame of its base',
    ),
    'master': ('/MTMR', 'namespace of the arm in the hand, which takes the force'),
    'button': ('/console/operator_present', 'topic of device.hold_button, and of other buttons'),
    'clutch': ('/console/clutch', 'topic that takes the hand off the tool while it is pressed'),
}
TYPES = {
    **{'scene': str, 'seed': int, 'seconds': float, 'auto_enable': bool, 'bag': str},
    **{'host': str, 'port': int, 'allow_host': str, 'accepted_publishers': str},
}
USUAL = ('scene', 'seed')
PARAMETERS = {
    ARM_NODE: (*USUAL, 'seconds'),
    BRIDGE_NODE: (*USUAL, 'auto_enable', 'accepted_publishers'),
    RECORDER_NODE: (*USUAL, 'bag'),
    VIEWER_NODE: ('scene', 'host', 'port', 'allow_host'),
}
"""Parameters of the nodes that need others than `USUAL`."""


def declared(*names: str, **defaults: str) -> list[Any]:
    """Return arguments of a launch file, named as in `ARGUMENTS`, some with other defaults."""
    liver = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'scenes', 'liver.yaml'])
    return [
        DeclareLaunchArgument(
            name,
            default_value=defaults.get(name, liver if default is None else default),
            description=description,
        )
        for name in names
        for default, description in (ARGUMENTS[name],)
    ]


def nodes(
    names: Sequence[str],
    *,
    namespace: Any = None,
    arguments: Mapping[str, str] | None = None,
    device: Any = None,
    topics: Mapping[str, Sequence[Any]] | None = None,
) -> list[Any]:
    """Return nodes of a session.

    Args:
        names: names of the nodes and of their executables.
        namespace: namespace of the nodes; None: the argument `namespace`.
        arguments: launch arguments that replace others, as `left_scene` replaces `scene`.
        device: namespace of the device; None: `arm`, below that of the nodes.
        topics: names of those topics that are not below it, by their name in `DEVICE_TOPICS`.
    """
    where = LaunchConfiguration('namespace') if namespace is None else namespace
    called = arguments or {}
    chosen = {'servo_cf': [device, '/', LaunchConfiguration('force_topic')], **(topics or {})}
    remapped = [(f'arm/{t}', chosen.get(t, [device, f'/{t}'])) for t in DEVICE_TOPICS]
    return [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=where,
            output='screen',
            remappings=remapped if device is not None else [],
            parameters=[
                {
                    key: ParameterValue(
                        LaunchConfiguration(called.get(key, key)), value_type=TYPES[key]
                    )
                    for key in PARAMETERS.get(name, USUAL)
                }
            ],
        )
        for name in names
    ]


def environment() -> list[Any]:
    """Restrict the nodes to this machine unless the shell sets another range."""
    return [SetEnvironmentVariable(*item) for item in discovery(os.environ).items()]
