"""Tissue for a simulator of arms: a PSM's instrument is the tool, its master takes the force."""

from launch.substitutions import LaunchConfiguration

from cutting_trainer.session.launching import declared, environment, nodes
from launch import LaunchDescription

OF_THE_DEVICE = ('haptic_bridge', 'viewer')
OF_THE_TISSUE = ('tissue_sim', 'cutting', 'recorder')


def generate_launch_description() -> LaunchDescription:
    """Declares the arguments and starts all but an arm; the bridge waits for its operator."""
    arguments = declared(
        *('scene', 'seed', 'bag', 'namespace', 'auto_enable', 'accepted_publishers'),
        *('psm', 'pose_topic', 'master', 'force_topic', 'button', 'clutch'),
        *('host', 'port', 'allow_host'),
        auto_enable='false',
        force_topic='body/servo_cf',
    )
    given = LaunchConfiguration
    forces = {
        topic: [given('master'), f'/{topic}'] for topic in ('body/servo_cf', 'spatial/servo_cf')
    }
    topics = {
        'measured_cp': [given('psm'), '/', given('pose_topic')],
        'servo_cf': [given('master'), '/', given('force_topic')],
        **forces,
        'button': [given('button')],
        'clutch': [given('clutch')],
    }
    bridge = nodes(OF_THE_DEVICE, device=given('psm'), topics=topics)
    return LaunchDescription([*arguments, *environment(), *bridge, *nodes(OF_THE_TISSUE)])
