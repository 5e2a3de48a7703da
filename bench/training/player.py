"""Attempts in one process, in simulated time, by an emulated hand on an emulated arm."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.exercises.bag_feed import MOTION_FIELDS
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.scene_schema import TargetSettings
from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import (
    EmulatedHand,
    HandScript,
    compile_script,
)
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import HandSettings, ScriptSettings
from cutting_trainer.session.in_process import TICK_S, InProcess, simulate
from cutting_trainer.session.scene_loader import Scene, load_scene

Floats = NDArray[np.float64]
_TICK_NS = 1_000_000
MAX_LOOKS = 3
"""How often a hand looks for the tissue that still holds the lesion after its script."""


@dataclass(frozen=True)
class Person:
    """A hand at an exercise.

    Attributes:
        script: its motion, in the tissue frame.
        hand: stiffness, damping, tremor.
        seed: of the tremor.
        sever: returns a script through a bridge that it sees, from its place [m] and the direction
            of the target there, each shape (3,), and how many it has seen; None: it does not look.
    """

    script: ScriptSettings
    hand: HandSettings
    seed: int = 0
    sever: Callable[[Floats, Floats, int], ScriptSettings] | None = field(
        default=None, compare=False
    )


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
    mesh = world.tissue.simulation.mesh
    script = person.script
    hand = EmulatedHand(person.hand, _in_device(said, script), person.seed)
    arm = EmulatedArm(said.arm, hand)
    arm.script_running = True
    attempt = Attempt(said.exercise)
    begun = _perform(world, arm, attempt, 0, script.seconds)
    for looks in range(MAX_LOOKS):
        if person.sever is None or attempt.bridge is None:
            break
        edge = list(attempt.bridge)
        seen = world.tissue.simulation.positions[edge].mean(axis=0)
        along = _direction(said.exercise.targets[0], mesh.rest[edge].mean(axis=0))
        here = script.phases[-1].waypoints[-1]
        script = person.sever(seen, along, looks).model_copy(update={'start': here})
        hand.script, arm.script_time = _in_device(said, script), 0.0
        begun = _perform(world, arm, attempt, begun, script.seconds)
    return attempt


def _direction(target: TargetSettings, place: Floats) -> Floats:
    """Return the direction of a target nearest to a place, shape (3,)."""
    corners = target.corners()
    ways = np.diff(corners, axis=0)
    middles = 0.5 * (corners[1:] + corners[:-1])
    return np.asarray(ways[np.linalg.norm(middles - place, axis=1).argmin()])


def _in_device(scene: Scene, script: ScriptSettings) -> HandScript:
    return compile_script(script, scene.device.tissue_from_device)


def _perform(
    world: InProcess, arm: EmulatedArm, attempt: Attempt, begun: int, seconds: float
) -> int:
    """Let the hand follow its script from a tick on; return the tick after its end."""
    mesh = world.tissue.simulation.mesh
    count = round(seconds / TICK_S)
    motion, forces = np.empty((count, 11)), np.empty((count, 2))
    topology = mesh.topology
    for row, k in enumerate(range(begun, begun + count)):
        arm.advance(k * _TICK_NS, enabled=True)
        out = world.tick(arm.position.copy(), tuple(arm.orientation.tolist()))
        arm.command((k + 1) * _TICK_NS, out.wrench[:3], k * _TICK_NS)
        time = k * TICK_S
        motion[row, 0] = forces[row, 0] = time
        motion[row, 1:] = [x for place in MOTION_FIELDS for x in out.contact[place]]
        forces[row, 1] = np.linalg.norm(out.wrench[:3])
        if mesh.topology != topology:
            topology = mesh.topology
            attempt.see_tissue(time, mesh)
    attempt.add_motion(motion)
    attempt.add_forces(forces)
    return begun + count
