"""An emulated arm for tests, exact unless they say else, and scripts for its hand."""

import numpy as np

from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import Transform

MS = 1_000_000
LIMP = {'stiffness': 0.0, 'damping': 0.0}
STAY = {'start': {'position': (0.0, 0.0, 0.0)}, 'phases': ({'kind': 'rest'},)}


def move(*waypoints, kind='approach', **phase):
    points = tuple({'position': point} for point in waypoints)
    return {'kind': kind, 'waypoints': points, **phase}


def script(*phases, seconds=1.0, **start):
    return {
        'start': {'position': (0.0, 0.0, 0.0), **start},
        'seconds': seconds,
        'phases': phases,
    }


def make_arm(*, seed=0, body_force=False, transform=None, **changes) -> EmulatedArm:
    """An exact arm without friction, unless `changes` say else."""
    exact = {
        'encoder_resolution': 0.0,
        'force_resolution': 0.0,
        'viscous_friction': 0.0,
        'coulomb_friction': 0.0,
        'script': STAY,
    }
    arm = ArmSettings.model_validate(exact | changes)
    hand = EmulatedHand(arm.hand, compile_script(arm.script, transform or Transform()), seed)
    return EmulatedArm(arm, hand, body_force=body_force)


def run(arm, ticks, force=None, enabled=True, start=0):
    """Lets milliseconds pass with a command in each; returns true positions and motor forces."""
    positions, forces = [], []
    for tick in range(start + 1, start + ticks + 1):
        if force is not None:
            arm.command(tick * MS, force, tick * MS)
        arm.advance(tick * MS, enabled=enabled)
        positions.append(arm.true_position.copy())
        forces.append(arm.force.copy())
    return np.array(positions), np.array(forces)


def kinetic(arm, mass=0.1):
    return 0.5 * mass * arm.true_velocity @ arm.true_velocity
