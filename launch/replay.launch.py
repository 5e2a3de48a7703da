"""A recorded session on the graph again; the options are those of `trainer replay`."""

from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

from cutting_trainer.session.launching import PACKAGE, environment
from launch import LaunchDescription

ARGUMENTS = {
    'bag': (None, 'folder of the bag'),
    'rate': ('1.0', 'seconds of the session in one second'),
    'start': ('0.0', 'where to begin [s]'),
    'as_recorded': ('false', 'show mesh and forces as they were, instead of computing them'),
}


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and replays."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    bag, rate, start, as_recorded = map(LaunchConfiguration, ARGUMENTS)
    program = PathJoinSubstitution([FindPackagePrefix(PACKAGE), 'lib', PACKAGE, 'trainer'])
    command = [program, 'replay', bag, '--rate', rate, '--start', start]
    replays = [
        ExecuteProcess(cmd=command, output='screen', condition=UnlessCondition(as_recorded)),
        ExecuteProcess(
            cmd=[*command, '--as-recorded'], output='screen', condition=IfCondition(as_recorded)
        ),
    ]
    return LaunchDescription([*arguments, *environment(), *replays])
