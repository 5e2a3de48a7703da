"""What the launch files share: the nodes of a graph, with the parameters of the command line.

Needs launch and launch_ros, which a ROS from Ubuntu packages has and the wheels have not.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from session.graph import ARM_NODE, BRIDGE_NODE, RECORDER_NODE, VIEWER_NODE, discovery

PACKAGE = 'cutting_trainer'
ARGUMENTS: dict[str, tuple[Any, str]] = {
    'scene': (None, 'scene file, absolute path'),
    'left_scene': (None, 'scene file of the left side, absolute path'),
    'right_scene': (None, 'scene file of the right side, absolute path'),
    'seed': ('0', 'seed of everything random'),
    'seconds': ('20.0', "duration that the arm's script is stretched to [s]"),
    'auto_enable': ('true', 'whether the bridge enables itself and the arm'),
    'bag': ('session', 'new folder for the bag'),
    'namespace': ('', 'of all nodes and topics, for more than one trainer in a graph'),
    'host': ('127.0.0.1', 'address that the page is served on; 0.0.0.0: open to other machines'),
    'port': ('8080', 'port of the page'),
    'arm': ('arm', 'namespace of the device, as in /MTML for /MTML/measured_cp'),
}
TYPES = {
    **{'scene': str, 'seed': int, 'seconds': float, 'auto_enable': bool, 'bag': str},
    **{'host': str, 'port': int},
}
USUAL = ('scene', 'seed')
PARAMETERS = {
    ARM_NODE: (*USUAL, 'seconds'),
    BRIDGE_NODE: (*USUAL, 'auto_enable'),
    RECORDER_NODE: (*USUAL, 'bag'),
    VIEWER_NODE: ('scene', 'host', 'port'),
}
"""Of the nodes that have others than `USUAL`."""
OF_DEVICE = ('measured_cp', 'servo_cf', 'button', 'operating_state', 'state_command')
"""Topics by which bridge, viewer and device know each other."""


def declared(*names: str, **defaults: str) -> list[Any]:
    """Arguments of a launch file, by their names in `ARGUMENTS`, some with other defaults."""
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
) -> list[Any]:
    """Nodes of a session.

    Args:
        names: of them, which are those of their executables too.
        namespace: theirs; None: that of the argument `namespace`.
        arguments: names of launch arguments that stand for others, as `left_scene` for `scene`.
        device: namespace that they find the device in; None: `arm`, below their own.
    """
    where = LaunchConfiguration('namespace') if namespace is None else namespace
    called = arguments or {}
    remapped = [(f'arm/{topic}', [device, f'/{topic}']) for topic in OF_DEVICE]
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
    """Keeps the nodes to this machine unless the shell says else, as the command line does."""
    return [SetEnvironmentVariable(*item) for item in discovery(os.environ).items()]
