"""Attempts in one process, in simulated time, by an emulated hand on an emulated arm."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.bag_feed import MOTION_FIELDS
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import HandSettings, ScriptSettings
from cutting_trainer.session.in_process import TICK_S, simulate
from cutting_trainer.session.scene_loader import Scene, load_scene

Floats = NDArray[np.float64]
_TICK_NS = 1_000_000


@dataclass(frozen=True)
class Person:
    """A hand at an exercise.

    Attributes:
        script: its motion, in the tissue frame.
        hand: stiffness, damping, tremor.
        seed: of the tremor.
    """

    script: ScriptSettings
    hand: HandSettings
    seed: int = 0


@cache
def scene_of(name: str) -> Scene:
    """Return a scene, read once."""
    return load_scene(name)


def expert_script(scene: str) -> Person:
    """Return the hand that the scene itself describes."""
    arm = scene_of(scene).arm
    return Person(arm.require_script(), arm.hand)


def play(scene: str, person: Person) -> Attempt:
    """Return an attempt at the exercise of a scene.

    Args:
        scene: name or path.
        person: who makes it.

    Raises:
        RuntimeError: the force loop ends in a FAULT.
    """
    said = scene_of(scene)
    world = simulate(scene)
    script = compile_script(person.script, said.device.tissue_from_device)
    arm = EmulatedArm(said.arm, EmulatedHand(person.hand, script, person.seed))
    attempt = Attempt(said.exercise)
    mesh = world.tissue.simulation.mesh
    count = round(script.seconds / TICK_S)
    motion, forces = np.empty((count, 11)), np.empty((count, 2))
    topology = mesh.topology
    arm.script_running = True
    for k in range(count):
        arm.advance(k * _TICK_NS, enabled=True)
        out = world.tick(arm.position.copy(), tuple(arm.orientation.tolist()))
        arm.command((k + 1) * _TICK_NS, out.wrench[:3], k * _TICK_NS)
        time = k * TICK_S
        motion[k, 0] = forces[k, 0] = time
        motion[k, 1:] = [x for place in MOTION_FIELDS for x in out.contact[place]]
        forces[k, 1] = np.linalg.norm(out.wrench[:3])
        if mesh.topology != topology:
            topology = mesh.topology
            attempt.see_tissue(time, mesh)
    attempt.add_motion(motion)
    attempt.add_forces(forces)
    return attempt
