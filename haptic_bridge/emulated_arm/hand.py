"""The operator's hand: scripted or guided target, tremor, and the spring that pulls the tool."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import (
    HandSettings,
    Phase,
    PoseSettings,
    ScriptSettings,
)
from cutting_trainer.haptic_bridge.scene_schema import SettingsError, Transform
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.node_common.orientation import quaternion

_MAX_SPEED_M_S = 2.0
_TREMOR_BAND_HZ = (8.0, 12.0)
_TREMOR_TONES = 5
_PEAK_OF_MINIMUM_JERK = 1.875
_GUIDED_BANDWIDTH_RAD_S = 25.0
"""[rad/s] bandwidth of a guided hand, critically damped: it follows its goal 0.15 s behind."""
_MAX_GUIDED_SPEED_M_S = 0.5
"""[m/s] of a guided hand: a distant goal must not throw the arm."""


@dataclass(frozen=True)
class HandScript:
    """Poses in the device frame, joined by minimum-jerk motions, with a rest at each.

    Attributes:
        times: [s] when each pose is reached, ascending from 0, shape (n,).
        positions: [m], shape (n, 3).
        orientations: quaternions x y z w, signs continuous, shape (n, 4).
        phase_ends: [s] by phase, ascending.
        phases: name and kind by phase.
        buttons: whether the button is pressed, by phase.
    """

    times: np.ndarray
    positions: np.ndarray
    orientations: np.ndarray
    phase_ends: tuple[float, ...]
    phases: tuple[tuple[str, str], ...]
    buttons: tuple[bool, ...]

    @cached_property
    def seconds(self) -> float:
        """Return the duration [s]."""
        return float(self.times[-1])

    def phase_at(self, time: float) -> tuple[str, str]:
        """Return name and kind of the phase at a time [s]; the last one after the end."""
        return self.phases[self._index_at(time)]

    def button_at(self, time: float) -> bool:
        """Return whether the button is pressed at a time [s]."""
        return self.buttons[self._index_at(time)]

    def _index_at(self, time: float) -> int:
        return min(bisect_right(self.phase_ends, time), len(self.phases) - 1)


def compile_script(
    settings: ScriptSettings, tissue_from_device: Transform, seconds: float = 0.0
) -> HandScript:
    """Convert a script to times and poses in the device frame.

    Args:
        settings: the script, in the tissue frame.
        tissue_from_device: transform from the device frame to the tissue frame.
        seconds: [s] duration instead of the script's own; 0 keeps that.

    Raises:
        SettingsError: the hand would have to move faster than a hand can.
    """
    durations, poses, ends = [0.0], [settings.start], []
    total = sum(phase.share for phase in settings.phases)
    for phase in settings.phases:
        length = (seconds or settings.seconds) * phase.share / total
        route = _route(phase, poses[-1])
        shares = sum(share for share, _ in route)
        durations += [length * share / shares for share, _ in route]
        poses += [pose for _, pose in route]
        ends.append(length)
    positions = tissue_from_device.to_device(np.array([pose.position for pose in poses]))
    _check_speed(np.array(durations[1:]), positions)
    return HandScript(
        times=np.cumsum(durations),
        positions=positions,
        orientations=_orientations(poses, tissue_from_device),
        phase_ends=tuple(np.cumsum(ends).tolist()),
        phases=tuple((phase.name or phase.kind, phase.kind) for phase in settings.phases),
        buttons=tuple(phase.button for phase in settings.phases),
    )


def _route(phase: Phase, here: PoseSettings) -> Sequence[tuple[float, PoseSettings]]:
    if not phase.waypoints:
        return [(1.0, PoseSettings(position=here.position))]
    return [(point.share, point) for point in phase.waypoints] * phase.repeat


def _check_speed(durations: np.ndarray, positions: np.ndarray) -> None:
    speeds = _PEAK_OF_MINIMUM_JERK * np.linalg.norm(np.diff(positions, axis=0), axis=1) / durations
    worst = int(np.argmax(speeds))
    if speeds[worst] > _MAX_SPEED_M_S:
        raise SettingsError(
            f'arm.script: move {worst + 1} peaks at {speeds[worst]:.3g} m/s, but a hand reaches '
            f'{_MAX_SPEED_M_S:g} m/s: give it {speeds[worst] / _MAX_SPEED_M_S:.3g} times its '
            f'{durations[worst]:.3g} s'
        )


def _orientations(poses: list[PoseSettings], tissue_from_device: Transform) -> np.ndarray:
    to_device, current = tissue_from_device.rotation().T, np.eye(3)
    quaternions = np.empty((len(poses), 4))
    for i, pose in enumerate(poses):
        turned = pose.rotation()
        current = current if turned is None else turned
        quaternions[i] = quaternion(to_device @ current)
        if i and quaternions[i] @ quaternions[i - 1] < 0:
            quaternions[i] *= -1
    return quaternions


class EmulatedHand:
    """Target pose of the hand, and the stiffness and damping with which it holds the tool.

    It follows its script until the first goal arrives; from then on it follows its goals.

    Args:
        settings: stiffness, damping, tremor.
        script: the motion of the hand.
        seed: of the tremor.

    Attributes:
        position, velocity: of the target [m], [m/s], shape (3,).
        orientation: of the tool, quaternion x y z w, shape (4,).
    """

    def __init__(self, settings: HandSettings, script: HandScript, seed: int = 0) -> None:
        self.script = script
        self.stiffness = settings.stiffness
        self.damping = settings.damping
        self.position = np.empty(3)
        self.velocity = np.empty(3)
        self.orientation = np.empty(4)
        random = np.random.default_rng(seed)
        shape = (3, _TREMOR_TONES)
        self._tremor = settings.tremor * np.sqrt(2 / _TREMOR_TONES)
        self._tones = 2 * np.pi * random.uniform(*_TREMOR_BAND_HZ, shape)
        self._angles = random.uniform(0, 2 * np.pi, shape)
        self._goal: tuple[np.ndarray, np.ndarray] | None = None
        self._held = np.empty(3), np.zeros(3)
        self.move_to(0.0, 0.0)
        self._tremor_time = 0.0

    @property
    def guided(self) -> bool:
        """Whether the hand has left its script."""
        return self._goal is not None

    def guide(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Set a goal, which the hand approaches smoothly from its present place.

        Args:
            position: [m], shape (3,), in the frame of the script.
            orientation: quaternion x y z w, shape (4,).
        """
        if self._goal is None:
            self._held = self.position.copy(), self.velocity.copy()
        unit = orientation / np.linalg.norm(orientation)
        self._goal = np.array(position, float), unit if unit @ self.orientation >= 0 else -unit

    def move_to(self, time: float, tremor_time: float) -> None:
        """Set the target to that of a time.

        Args:
            time: [s] in the script; 0 is its start, and after its end it stays.
            tremor_time: [s]; tremor goes on while the script waits.
        """
        script, target = self.script, (self.position, self.velocity, self.orientation)
        if self._goal is None:
            _follow(time, (script.times, script.positions, script.orientations), target)
        else:
            _pursue(tremor_time - self._tremor_time, self._goal, self._held, target)
        self._tremor_time = tremor_time
        if self._tremor > 0:
            _tremble(
                tremor_time, self._tremor, self._tones, self._angles, self.position, self.velocity
            )


@kernel
def _follow(time, script, target):
    times, positions, orientations = script
    position, velocity, orientation = target
    if time <= times[0] or time >= times[-1]:
        end = 0 if time <= times[0] else len(times) - 1
        for axis in range(3):
            position[axis], velocity[axis] = positions[end, axis], 0.0
        for k in range(4):
            orientation[k] = orientations[end, k]
        return
    i = np.searchsorted(times, time, side='right') - 1
    length = times[i + 1] - times[i]
    s = (time - times[i]) / length
    part = s * s * s * (10 - 15 * s + 6 * s * s)
    rate = 30 * s * s * (1 - s) * (1 - s) / length
    dot = 0.0
    for axis in range(3):
        path = positions[i + 1, axis] - positions[i, axis]
        position[axis] = positions[i, axis] + part * path
        velocity[axis] = rate * path
    for k in range(4):
        dot += orientations[i, k] * orientations[i + 1, k]
    angle = np.arccos(min(dot, 1.0))
    before, after = 1 - part, part
    if angle > 1e-6:
        before, after = (
            np.sin((1 - part) * angle) / np.sin(angle),
            np.sin(part * angle) / np.sin(angle),
        )
    for k in range(4):
        orientation[k] = before * orientations[i, k] + after * orientations[i + 1, k]


@kernel
def _pursue(step, goal, held, target):
    place, turn = goal
    held_position, held_velocity = held
    position, velocity, orientation = target
    # Implicit in the velocity: stable at any step.
    weight = 1 / (1 + step * (2 * _GUIDED_BANDWIDTH_RAD_S + step * _GUIDED_BANDWIDTH_RAD_S**2))
    speed = 0.0
    for axis in range(3):
        pull = _GUIDED_BANDWIDTH_RAD_S**2 * (place[axis] - held_position[axis])
        held_velocity[axis] = weight * (held_velocity[axis] + step * pull)
        speed += held_velocity[axis] ** 2
    slower = min(1.0, _MAX_GUIDED_SPEED_M_S / max(math.sqrt(speed), 1e-12))
    for axis in range(3):
        held_velocity[axis] *= slower
        held_position[axis] += step * held_velocity[axis]
        position[axis] = held_position[axis]
        velocity[axis] = held_velocity[axis]
    part = 1 - math.exp(-_GUIDED_BANDWIDTH_RAD_S * step)
    norm = 0.0
    for k in range(4):
        orientation[k] += part * (turn[k] - orientation[k])
        norm += orientation[k] ** 2
    norm = math.sqrt(norm)
    for k in range(4):
        orientation[k] /= norm


@kernel
def _tremble(time, amplitude, tones, angles, position, velocity):
    for axis in range(3):
        for tone in range(tones.shape[1]):
            omega = tones[axis, tone]
            angle = omega * time + angles[axis, tone]
            position[axis] += amplitude * np.sin(angle)
            velocity[axis] += amplitude * omega * np.cos(angle)
