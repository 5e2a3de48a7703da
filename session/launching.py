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

from session.graph import ARM_NODE, BRIDGE_NODE, RECORDER_NODE, discovery

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
    'arm': ('arm', 'namespace of the device, as in /MTML for /MTML/measured_cp'),
}
TYPES = {'scene': str, 'seed': int, 'seconds': float, 'auto_enable': bool, 'bag': str}
OWN = {
    ARM_NODE: ('seconds',),
    BRIDGE_NODE: ('auto_enable',),
    RECORDER_NODE: ('bag',),
}
"""Parameters of a node beside scene and seed."""
OF_DEVICE = ('measured_cp', 'measured_cv', 'servo_cf', 'button')
"""Topics by which a bridge and a device know each other."""


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
        device: namespace that the bridge finds its device in; None: `arm`, below its own.
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
            remappings=remapped if device is not None and name == BRIDGE_NODE else [],
            parameters=[
                {
                    key: ParameterValue(
                        LaunchConfiguration(called.get(key, key)), value_type=TYPES[key]
                    )
                    for key in ('scene', 'seed', *OWN.get(name, ()))
                }
            ],
        )
        for name in names
    ]


def environment() -> list[Any]:
    """Keeps the nodes to this machine unless the shell says else, as the command line does."""
    return [SetEnvironmentVariable(*item) for item in discovery(os.environ).items()]
