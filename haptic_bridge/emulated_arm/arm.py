"""Dynamics of an emulated haptic arm: a mass with friction between motors and a hand."""

import math
from typing import Any

import numpy as np

from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.rejections import MessageError, RejectionStatistics

_NANOSECONDS = 1_000_000_000
_MAX_SUBSTEP_S = 0.25e-3
COMMAND = 'arm/servo_cf'
_INVALID = MessageError('marked invalid', 'its stamp is 0')
_NOT_FINITE = MessageError('not finite')
_OUTDATED = MessageError('not newer than the one before')
_CONSTANTS = record_type(
    [
        ('mass', 'f8'),  # [kg]
        ('viscous_friction', 'f8'),  # [N s/m]
        ('coulomb_friction', 'f8'),  # [N]
        ('hand_stiffness', 'f8'),  # [N/m]
        ('hand_damping', 'f8'),  # [N s/m]
        ('max_force', 'f8'),  # [N]
        ('force_resolution', 'f8'),  # [N]
        ('encoder_resolution', 'f8'),  # [m]
        ('body_force', 'b1'),
        ('step', 'f8'),  # [s]
        ('substeps', 'i8'),
        ('smoothing', 'f8'),
    ]
)
_STATE = record_type(
    [
        ('true_position', 'f8', (3,)),
        ('true_velocity', 'f8', (3,)),
        ('pose', 'f8', (7,)),
        ('twist', 'f8', (6,)),
        ('command', 'f8', (3,)),
        ('force', 'f8', (3,)),
    ]
)


class EmulatedArm:
    """A mass with friction, held by a hand and pushed by motors.

    m x'' = f_motors + k_hand (target - x) + c_hand (target' - x') - b x' - f_Coulomb x' / |x'|,
    integrated by semi-implicit Euler with damping and dry friction implicit: friction stops the
    mass and never reverses it. The motors take the commanded force through saturation, resolution
    and delay, and a watchdog of the arm's own zeroes them when commands stop.

    Limitations: the orientation is the hand's; torques are ignored; saturation bounds the norm of
    the force, not each motor.

    Args:
        settings: the scene's section `arm`.
        hand: the hand that holds the arm.
        body_force: whether commands are in the axes of the tool instead of the base.
        refusals: rejection statistics to count in; None: its own.

    Attributes:
        true_position, true_velocity: of the mass [m], [m/s], shape (3,).
        pose: position and orientation, shape (7,).
        position: as the encoders have it [m], shape (3,).
        orientation: quaternion x y z w, shape (4,).
        twist: velocity and angular velocity, shape (6,).
        velocity: from the encoders, filtered [m/s], shape (3,).
        angular_velocity: [rad/s], base axes, shape (3,).
        force: of the motors on the hand, base axes [N], shape (3,).
        watchdog_trips: how often commands stopped, whatever the last force was.
        refusals: statistics of rejected commands: NaN, an invalid stamp, or one not newer.
        script_time: [s] that the script has run.
    """

    def __init__(
        self,
        settings: ArmSettings,
        hand: EmulatedHand,
        *,
        body_force: bool = False,
        rejections: RejectionStatistics | None = None,
    ) -> None:
        self._hand = hand
        self._step = 1 / settings.rate
        self._constants = c = np.zeros(1, _CONSTANTS)
        c['mass'], c['max_force'] = settings.mass, settings.max_force
        c['viscous_friction'] = settings.viscous_friction
        c['coulomb_friction'] = settings.coulomb_friction
        c['force_resolution'] = settings.force_resolution
        c['encoder_resolution'] = settings.encoder_resolution
        c['hand_stiffness'], c['hand_damping'] = hand.stiffness, hand.damping
        c['body_force'], c['step'] = body_force, self._step
        c['substeps'] = math.ceil(self._step / _MAX_SUBSTEP_S)
        c['smoothing'] = 1 - math.exp(-2 * math.pi * settings.velocity_cutoff * self._step)
        # Two periods early: a command waits up to one to be seen, and so does its absence.
        self._patience_ns = round((settings.watchdog - 2 * self._step) * _NANOSECONDS)
        self._delay_line = np.zeros((1 + round(settings.delay * settings.rate), 3))
        self._state = np.zeros(1, _STATE)
        s: Any = self._state[0]
        self.true_position, self.true_velocity = s['true_position'], s['true_velocity']
        self.pose, self.twist = s['pose'], s['twist']
        self._command, self.force = s['command'], s['force']
        self._command_ns: int | None = None
        self._command_stamp = 0
        self._age = 0
        self.true_position[:] = hand.position
        self.position, self.orientation = self.pose[:3], self.pose[3:]
        self.velocity, self.angular_velocity = self.twist[:3], self.twist[3:]
        _quantise(self.true_position, settings.encoder_resolution, self.position)
        self.orientation[:] = hand.orientation
        self.watchdog_trips = 0
        self.rejections = rejections or RejectionStatistics()
        self.script_time = 0.0
        self.script_running = False

    @property
    def script_over(self) -> bool:
        """Whether the hand has reached the end of its script."""
        return self.script_time >= self._hand.script.seconds

    @property
    def commanded(self) -> bool:
        """Whether commands arrive, within the watchdog's timeout."""
        return self._command_ns is not None

    def guide(self, position: np.ndarray, orientation: np.ndarray) -> None:
        """Send the hand off its script to a pose in the device frame (`EmulatedHand.guide`)."""
        self._hand.guide(position, orientation)

    def command(self, stamp_ns: int, force: tuple[float, ...], now_ns: int) -> None:
        """Process a servo_cf command.

        Args:
            stamp_ns: its stamp [ns]: it must be newer than the one before; 0 means invalid.
            force: of the device on the hand [N], shape (3,).
            now_ns: arrival on the arm's own monotonic clock [ns].
        """
        if stamp_ns == 0:
            self.reject(_INVALID)
        elif not all(map(math.isfinite, force)):
            self.reject(_NOT_FINITE)
        elif stamp_ns <= self._command_stamp:
            self.rejections.add(COMMAND, _OUTDATED)
        else:
            self._command_stamp = stamp_ns
            self._command_ns = now_ns
            self._command[:] = force

    def reject(self, why: MessageError) -> None:
        """Reject an invalid command: the motors go to zero."""
        self.rejections.add(COMMAND, why)
        self._command[:] = 0
        self._delay_line[:] = 0

    def advance(self, now_ns: int, *, enabled: bool, steps: int = 1) -> None:
        """Simulate one or more periods.

        Args:
            now_ns: the arm's own monotonic clock [ns].
            enabled: whether the operating state is ENABLED; otherwise the motors are at zero.
            steps: how many; more than one after deadlines were missed.
        """
        self._watch(now_ns)
        if not enabled:
            self._command[:] = 0
            self._delay_line[:] = 0
        for _ in range(steps):
            self._move()

    def _watch(self, now_ns: int) -> None:
        if self._command_ns is None or now_ns - self._command_ns <= self._patience_ns:
            return
        self.watchdog_trips += 1
        self._command_ns = None
        # The next commander may have restarted, or its clock may have been set back.
        self._command_stamp = 0
        self._command[:] = 0
        self._delay_line[:] = 0

    def _move(self) -> None:
        hand, step = self._hand, self._step
        self._age += 1
        if self.script_running and not hand.guided:
            self.script_time = min(self.script_time + step, hand.script.seconds)
        hand.move_to(self.script_time, self._age * step)
        _advance(
            self._constants,
            self._state,
            self._delay_line,
            self._age,
            hand.position,
            hand.velocity,
            hand.orientation,
        )


@kernel
def _advance(constants, state, line, age, target, target_velocity, orientation):
    c, s = constants[0], state[0]
    _render(c, s.command, s.pose[3:], line[(age - 1) % len(line)])
    for axis in range(3):
        s.force[axis] = line[age % len(line), axis]
    _integrate(c, s.force, target, target_velocity, s.true_position, s.true_velocity)
    _measure(c, s.true_position, orientation, s.pose, s.twist)


@inner
def _integrate(c, force, target, target_velocity, position, velocity):
    step = c.step / c.substeps
    kept = 1 / (1 + step * (c.hand_damping + c.viscous_friction) / c.mass)
    stopped_by = kept * step * c.coulomb_friction / c.mass
    for _ in range(c.substeps):
        speed = 0.0
        for axis in range(3):
            pull = force[axis] + c.hand_stiffness * (target[axis] - position[axis])
            pull += c.hand_damping * target_velocity[axis]
            velocity[axis] = kept * (velocity[axis] + step * pull / c.mass)
            speed += velocity[axis] ** 2
        speed = math.sqrt(speed)
        slowed = 1 - stopped_by / speed if speed > stopped_by else 0.0
        for axis in range(3):
            velocity[axis] *= slowed
            position[axis] += step * velocity[axis]


@inner
def _quantise(exact, resolution, out):
    for axis in range(3):
        out[axis] = exact[axis]
        if resolution > 0:
            out[axis] = resolution * np.rint(exact[axis] / resolution)


@inner
def _measure(c, true_position, q, pose, twist):
    position, p, velocity, angular_velocity = pose[:3], pose[3:], twist[:3], twist[3:]
    before = (position[0], position[1], position[2])
    _quantise(true_position, c.encoder_resolution, position)
    for axis in range(3):
        change = (position[axis] - before[axis]) / c.step
        velocity[axis] += c.smoothing * (change - velocity[axis])
    # Vector part of q * conj(p), twice: the rotation vector of a small rotation.
    a = 2 / c.step
    angular_velocity[0] = a * (q[0] * p[3] - q[3] * p[0] - q[1] * p[2] + q[2] * p[1])
    angular_velocity[1] = a * (q[1] * p[3] - q[3] * p[1] - q[2] * p[0] + q[0] * p[2])
    angular_velocity[2] = a * (q[2] * p[3] - q[3] * p[2] - q[0] * p[1] + q[1] * p[0])
    for k in range(4):
        p[k] = q[k]


@inner
def _render(c, command, q, out):
    x, y, z = command[0], command[1], command[2]
    if c.body_force:
        tx = 2 * (q[1] * z - q[2] * y)
        ty = 2 * (q[2] * x - q[0] * z)
        tz = 2 * (q[0] * y - q[1] * x)
        x, y, z = (
            x + q[3] * tx + q[1] * tz - q[2] * ty,
            y + q[3] * ty + q[2] * tx - q[0] * tz,
            z + q[3] * tz + q[0] * ty - q[1] * tx,
        )
    norm = math.sqrt(x * x + y * y + z * z)
    scale = c.max_force / norm if norm > c.max_force else 1.0
    out[0], out[1], out[2] = x * scale, y * scale, z * scale
    if c.force_resolution > 0:
        # Towards zero, so that no step of the converter exceeds the saturation.
        for axis in range(3):
            out[axis] = c.force_resolution * np.trunc(out[axis] / c.force_resolution)
