"""The compiled part of one tick: pose to tissue frame, force law, safety chain, force to device."""

import math

import numpy as np

from cutting_trainer.haptic_bridge import blade_force, extrapolation, safety
from cutting_trainer.haptic_bridge.devices.motion_gate import judge
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.haptic_bridge.proxy import friction
from cutting_trainer.haptic_bridge.proxy.coupling_spring import spring_force, surface_stiffness
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import norm
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE, BladeConstants
from cutting_trainer.tissue_sim.contact.tool import ToolMode

NONE, TOUCHING, INSIDE = range(3)
"""Contact states, as in `Contact`."""
GRASPERS = (ToolMode.OPEN_GRASPER.value, ToolMode.CLOSED_GRASPER.value)
"""Modes of a tool whose jaws hold the tissue."""

_VELOCITY_FILTER_S = 0.005
"""[s] time constant of the low-pass on the damped velocity: encoder steps are coarse at 1 kHz."""

_PASSIVITY_RECOVERY_S = 0.02
"""[s] in which the passivity controller removes generated energy; faster feels like a kick."""

_UNKNOWN_TISSUE_SHARE = 0.1
"""Largest share of the device's force for a tissue of unknown stiffness."""

MAX_SLEW_PERIOD_S = 0.005
"""[s] Longest period that the slew limit allows for: a late tick catches up no further."""

ENERGY_CREDIT_J = 2e-4
"""[J] Energy that the force loop may have generated before the passivity controller acts: a fifth
of the energy of a 5 mm indentation of liver. Encoder steps and extrapolation errors lie below."""

SETUP = record_type(
    [
        ('rotation', 'f8', (3, 3)),  # device frame to tissue frame
        ('translation', 'f8', (3,)),  # [m]
        ('scale', 'f8'),
        ('alignment', 'f8', (4,)),  # x y z w, from the tool to the device's tip
        ('clutched', 'b1'),  # the tool stays where translation and alignment put it
        ('force_scale', 'f8'),
        ('blade', 'f8', (2, 3)),  # root and tip [m], tool frame
        ('facing', 'f8', (3,)),  # of its edge, tool frame; zero: all round
        ('radius', 'f8'),  # [m] of the tool
        ('coupling', 'f8'),  # [N/m]
        ('law', 'i8'),
        ('one_force', 'b1'),
        ('max_stiffness', 'f8'),  # [N/m], of the tissue
        ('unknown_force', 'f8'),  # [N], of a tissue of unknown stiffness
        ('slack', 'f8'),  # [N] by which a force may exceed the expected one
        ('max_damping', 'f8'),  # [N s/m]
        ('max_force', 'f8'),  # [N]
        ('max_slew', 'f8'),  # [N/s]
        ('stale_after', 'f8'),  # [s]
        ('fade', 'f8'),  # [s]
        ('soft_start', 'f8'),  # [s]
        ('length', 'f8'),  # [m] of the blade, in the tissue
        ('crack_length', 'f8'),  # [m] of a step of the crack; 0: it runs steadily
        ('blade_friction', 'f8'),  # [N/m]
        ('toughness', 'f8'),  # [J/m^2]; inf: unknown
        ('tip_resistance', 'f8'),  # [N]
        ('entry_force', 'f8'),  # [N] that lets the blade in; inf: another rule does
        ('hand_length', 'f8'),  # [m] the same at the hand; 0: the device renders no torque
        ('max_torque', 'f8'),  # [N m]
        ('body_frame', 'i8'),
    ]
)
STATE = record_type(
    [
        ('device', 'f8', (3,)),  # [m], device frame
        ('orientation', 'f8', (4,)),  # x y z w, device frame
        ('tip', 'f8', (3,)),  # [m], tissue frame
        ('blade', 'f8', (2, 3)),  # root and tip [m], tissue frame
        ('facing', 'f8', (3,)),  # of its edge, tissue frame
        ('arms', 'f8', (2, 3)),  # [m] from the tip to root and tip of the blade, tissue frame
        ('moved', 'f8', (3,)),  # [m] since the last tick, device frame
        ('turned', 'f8', (3,)),  # [rad] since the last tick, rotation vector, device frame
        ('velocity', 'f8', (6,)),  # [m/s], angular velocity times `hand_length`, device frame
        ('proxy', 'f8', (3,)),  # [m] on the undented surface
        ('normal', 'f8', (3,)),
        ('external', 'f8', (3,)),  # [N] on the tissue
        ('resistance', 'f8'),  # [N]
        ('torque_resistance', 'f8'),  # [N m]
        ('known', 'f8'),  # [N/m] stiffness of the tissue; 0: unknown
        ('held', 'f8'),  # [N] largest force that can hold the blade
        ('reach', 'f8'),  # share of the resistance that a blade so far from the surface may feel
        ('edge', 'f8', (2, 3)),  # [m] the blade of the last tick
        ('entered', 'i8'),  # [ns] pose by which it has, before the tissue says so; 0: it has not
        ('borne', 'f8'),  # [N] that this contact bore although the blade was to go in
        ('out', 'f8'),  # share of the length in the tissue that has left it since the newest sample
        ('advanced', 'f8', (3,)),  # [m] the edge in the tissue since the newest sample
        ('renewed', 'b1'),  # whether that sample has come since the last tick
        ('stretch', 'f8', (3,)),  # [m] from the device's edge to the one in the tissue
        ('stick', friction.STICK, (1,)),
        ('energy', 'f8'),  # [J] of the passivity observer
        ('damping', 'f8'),  # [N s/m] of the passivity controller
        ('force', 'f8', (3,)),  # [N] commanded, device base frame
        ('torque', 'f8', (3,)),  # [N m] commanded, about the tip, device base frame
        ('wrench', 'f8', (6,)),  # [N, N m] the same in the frame that the device expects
        ('max_norm', 'f8'),  # [N] largest norm commanded
        ('contact', 'i8'),  # NONE, TOUCHING or INSIDE
        ('contact_time', 'f8'),  # [s] in all
        ('sequence', 'i8'),  # number of the tick
        ('began', 'i8'),  # sequence of the tick in which the contact began
        ('left', 'i8'),  # sequence of the tick in which the last one ended
        ('touched_ns', 'i8'),  # [ns] time of the last touch; 0: none
        ('now_ns', 'i8'),  # [ns] time of the last tick
        ('start_ns', 'i8'),  # [ns] time since which force rises
        ('sample_ns', 'i8'),  # [ns] arrival of the newest sample; 0: none
        ('current_ns', 'i8'),  # [ns] last tick whose surface was as new as the sample; 0: none
        ('says_inside', 'b1'),  # whether that sample says that the blade is in the tissue
        ('stale', 'b1'),  # whether samples or surface are too old, while force is wanted
        ('stale_trips', 'i8'),  # how often they became so
        ('mode', 'i8'),  # of the tool, one of `ToolMode`
        ('next_mode', 'i8'),  # that it takes once no blade is in the tissue
    ]
)


def make_setup(
    tool: ToolSettings,
    device: DeviceSettings,
    haptics: HapticsSettings,
    profile: DeviceProfile,
    constants: BladeConstants = UNKNOWN_BLADE,
    indexing: Indexing | None = None,
) -> np.ndarray:
    """Return the constants of a session for the kernels: dtype SETUP, shape (1,).

    Args:
        tool, device, haptics: sections of the scene.
        profile: limits of the device.
        constants: of the blade in this tissue.
        indexing: how the hand moves the tool, with the scale of `device`; None: as the scene says.
    """
    frame = device.tissue_from_device
    setup = np.zeros(1, SETUP)
    setup['rotation'] = frame.rotation()
    (indexing or Indexing.of(frame)).write(setup)
    setup['force_scale'] = haptics.force_scale
    setup['blade'] = (tool.blade_root, tool.blade_tip)
    setup['facing'] = tool.facing()
    setup['radius'], setup['coupling'] = tool.radius, tool.coupling_stiffness
    setup['law'] = extrapolation.LAWS[haptics.extrapolation]
    setup['one_force'] = haptics.forces == 'one'
    # The tissue is felt through the coupling spring: no steeper slope is real.
    rendered = profile.max_stiffness / (frame.scale * haptics.force_scale)
    setup['max_stiffness'] = min(rendered, tool.coupling_stiffness)
    setup['unknown_force'] = _UNKNOWN_TISSUE_SHARE * profile.max_force / haptics.force_scale
    allowed = profile.max_slew * MAX_SLEW_PERIOD_S / haptics.force_scale
    setup['slack'] = min(setup['unknown_force'][0], allowed)
    setup['max_damping'] = haptics.max_damping
    setup['max_force'] = profile.max_force
    setup['max_slew'] = profile.max_slew
    setup[['stale_after', 'fade', 'soft_start']] = (
        haptics.stale_after,
        haptics.fade,
        haptics.soft_start,
    )
    length = math.dist(tool.blade_root, tool.blade_tip)
    setup['length'], setup['max_torque'] = length, profile.max_torque
    setup['hand_length'] = length / frame.scale if profile.max_torque > 0.0 else 0.0
    names = ['crack_length', 'blade_friction', 'entry_force', 'toughness', 'tip_resistance']
    setup[names] = constants
    setup['body_frame'] = device.force_frame == 'body'
    return setup


@inner
def _rotate(q: np.ndarray, v: np.ndarray, sign: float, out: np.ndarray) -> None:
    """Rotate v by the quaternion q (x y z w), or back with sign -1. Shapes (4,), (3,), (3,)."""
    x, y, z, w = sign * q[0], sign * q[1], sign * q[2], q[3]
    a = 2.0 * (y * v[2] - z * v[1])
    b = 2.0 * (z * v[0] - x * v[2])
    c = 2.0 * (x * v[1] - y * v[0])
    out[0], out[1], out[2] = (
        v[0] + w * a + y * c - z * b,
        v[1] + w * b + z * a - x * c,
        v[2] + w * c + x * b - y * a,
    )


@inner
def _multiply(p: np.ndarray, q: np.ndarray, out: np.ndarray) -> None:
    """Multiply two quaternions (x y z w), shape (4,): q turns first."""
    out[0] = p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1]
    out[1] = p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0]
    out[2] = p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3]
    out[3] = p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2]


@inner
def _add_turn(before: np.ndarray, after: np.ndarray, turned: np.ndarray) -> None:
    """Add the rotation vector [rad] between two quaternions (x y z w), in their base frame."""
    a, b = after, before
    cosine = b[3] * a[3] + b[0] * a[0] + b[1] * a[1] + b[2] * a[2]
    axis = np.empty(3)
    axis[0] = b[3] * a[0] - a[3] * b[0] + b[1] * a[2] - b[2] * a[1]
    axis[1] = b[3] * a[1] - a[3] * b[1] + b[2] * a[0] - b[0] * a[2]
    axis[2] = b[3] * a[2] - a[3] * b[2] + b[0] * a[1] - b[1] * a[0]
    sine = norm(axis)
    if sine == 0.0:
        return
    angle = 2.0 * np.arctan2(sine, abs(cosine))
    for k in range(3):
        turned[k] += angle / sine * (axis[k] if cosine >= 0.0 else -axis[k])


@kernel(nogil=True)
def to_tissue(setup: np.ndarray, state: np.ndarray, values: np.ndarray) -> None:
    """Write a checked device pose, transformed to the tissue frame, to the state.

    Position [m] and quaternion, shape (7,).
    """
    c, s = setup[0], state[0]
    for k in range(3):
        s.moved[k] += values[k] - s.device[k]
        s.device[k] = values[k]
    _add_turn(s.orientation, values[3:], s.turned)
    for k in range(4):
        s.orientation[k] = values[3 + k]
    arm, turn = np.empty(3), np.empty(4)
    for k in range(3):
        s.tip[k] = c.translation[k]
        if not c.clutched:
            for j in range(3):
                s.tip[k] += c.scale * c.rotation[k, j] * values[j]
    if c.clutched:
        turn[:] = c.alignment
    else:
        _multiply(s.orientation, c.alignment, turn)
    for end in range(2):
        _rotate(turn, c.blade[end], 1.0, arm)
        for k in range(3):
            s.blade[end, k] = s.tip[k]
            s.arms[end, k] = 0.0
            for j in range(3):
                s.blade[end, k] += c.rotation[k, j] * arm[j]
                s.arms[end, k] += c.rotation[k, j] * arm[j]
    _rotate(turn, c.facing, 1.0, arm)
    size = 0.0
    for k in range(3):
        s.facing[k] = 0.0
        for j in range(3):
            s.facing[k] += c.rotation[k, j] * arm[j]
        size += s.facing[k] ** 2
    if size > 0.0:  # a device may round its quaternion
        for k in range(3):
            s.facing[k] /= np.sqrt(size)


@kernel(nogil=True)
def take_pose(
    setup: np.ndarray,
    state: np.ndarray,
    gate: np.ndarray,
    values: np.ndarray,
    stamp_ns: int,
    known: bool,
) -> int:
    """Check a device pose and write it to the state; one that fails changes nothing.

    Arguments after the state, and what is returned, are those of `motion_gate.judge`.
    """
    code = judge(gate, values, stamp_ns, known)
    if code == safety.OK:
        to_tissue(setup, state, values)
        if not known:
            state[0].moved[:] = 0.0
            state[0].turned[:] = 0.0
    return code


@inner
def _tissue_force(
    setup: np.ndarray,
    state: np.ndarray,
    history: np.ndarray,
    contact: int,
    time: int,
    out: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Compute force and torque of the tissue on the tool now, tissue frame.

    Force [N] and torque about the tool's tip [N m], shape (3,).
    """
    c, s, h = setup[0], state[0], history[0]
    out[:], torque[:] = 0.0, 0.0
    if contact != TOUCHING:
        s.entered, s.borne = 0, 0.0
    if contact == NONE:
        return
    if contact == INSIDE and s.mode in GRASPERS:
        blade_force.hold(setup, state, history, out)
        return
    if h.count > 0 and not (c.one_force and contact == TOUCHING):
        depth = s.proxy - s.tip
        touching = contact == TOUCHING
        if c.law == extrapolation.LOCAL_STIFFNESS and not touching:
            blade_force.pull_blade(setup, state, history, out, torque)
        else:
            extrapolation.estimate(
                c.law, history, time, s.tip, depth, touching, s.arms, c.max_stiffness, out, torque
            )
    elif contact == TOUCHING:
        for k in range(3):
            out[k] = -s.external[k]  # until the tissue has answered
        if h.count == 0 and not np.any(h.stiffness):
            safety.clamp(c.unknown_force, out)
    if contact == TOUCHING:
        outward = out[0] * s.normal[0] + out[1] * s.normal[1] + out[2] * s.normal[2]
        if outward < 0.0:
            out[:] = 0.0
        # Bounded by the force that this depth of the coupling spring and the known stiffness allow.
        safety.clamp(s.known * norm(s.proxy - s.tip) + c.slack, out)
        if s.stick[0].sliding_friction > 0.0:
            _add_friction(setup, state, history, out)
        blade_force.enter(setup, state, time, out)
    else:
        # The blade transmits at most the cutting resistance: zero while no part is in tissue.
        # It may exceed the last bound only by the stretch of its spring since then.
        share = s.reach * (1.0 - s.out)
        safety.clamp(min(share * s.resistance, s.held), out)
        safety.clamp(min(share * s.torque_resistance, s.held * c.length), torque)
        torque[0] += s.arms[1, 1] * out[2] - s.arms[1, 2] * out[1]
        torque[1] += s.arms[1, 2] * out[0] - s.arms[1, 0] * out[2]
        torque[2] += s.arms[1, 0] * out[1] - s.arms[1, 1] * out[0]


@inner
def _add_friction(
    setup: np.ndarray, state: np.ndarray, history: np.ndarray, out: np.ndarray
) -> None:
    """Replace what of the force is along the surface by friction, here and in the contact."""
    c, s, h = setup[0], state[0], history[0]
    stick, n = s.stick[0], s.normal
    pushed = max(out[0] * n[0] + out[1] * n[1] + out[2] * n[2], 0.0)
    stiffness = stick.stiffness
    if stiffness == 0.0:
        stiffness = surface_stiffness(h.stiffness, c.coupling)
    friction.drag(s.stick, s.tip, n, pushed, min(stiffness, c.max_stiffness))
    # The contact's force is that of the spring, whose normal part may differ from the one felt.
    share = norm(s.external) / pushed if pushed > 0.0 else 0.0
    for k in range(3):
        out[k] = pushed * n[k] + stick.force[k]
        s.external[k] -= share * stick.force[k]


@inner
def _follow_edge(setup: np.ndarray, state: np.ndarray) -> None:
    """Raise the bound of the blade's force by the stretch of its spring since the last tick."""
    s = state[0]
    stretch = max(norm(s.blade[0] - s.edge[0]), norm(s.blade[1] - s.edge[1]))
    s.held += setup[0].coupling * stretch
    for end in range(2):
        for k in range(3):
            s.edge[end, k] = s.blade[end, k]


@inner
def command(
    setup: np.ndarray,
    state: np.ndarray,
    history: np.ndarray,
    contact: int,
    enabled: bool,
    time: int,
    gain: float,
    elapsed: float,
) -> bool:
    """Compute the commanded force and torque from a checked input, through the safety chain.

    Returns:
        False where the result was not finite; force and torque are then zero.
    """
    c, s = setup[0], state[0]
    s.energy = safety.observe(s.energy, s.force, s.moved)
    s.energy = safety.observe(s.energy, s.torque, s.turned)
    weight = elapsed / (elapsed + _VELOCITY_FILTER_S)
    for k in range(3):
        s.velocity[k] += weight * (s.moved[k] / elapsed - s.velocity[k])
        spin = c.hand_length * s.turned[k] / elapsed
        s.velocity[3 + k] += weight * (spin - s.velocity[3 + k])
        s.moved[k] = s.turned[k] = 0.0
    spring_force(history[0].stiffness, c.coupling, s.tip, s.proxy, s.external)
    _follow_edge(setup, state)
    felt, torque = np.zeros(3), np.zeros(3)
    wanted = np.zeros(6)  # the torque over the length of the blade at the hand: a force
    _tissue_force(setup, state, history, contact, time, felt, torque)
    # A turn is not scaled as a way is: the hand's torque does the work that its force does.
    lever = c.force_scale / (c.scale * c.hand_length) if c.hand_length > 0.0 else 0.0
    for k in range(3):
        for j in range(3):
            wanted[k] += c.force_scale * c.rotation[j, k] * felt[j]
            wanted[3 + k] += lever * c.rotation[j, k] * torque[j]
    felt_by_hand = enabled and not c.clutched
    safety.state_gate(felt_by_hand, wanted)
    s.damping = 0.0
    if felt_by_hand and contact != NONE:
        s.damping = safety.control(
            s.energy, s.velocity, _PASSIVITY_RECOVERY_S, c.max_damping, wanted
        )
    force, turning = wanted[:3], wanted[3:] * c.hand_length
    safety.settle(s.force, c.max_slew * elapsed, c.max_force, gain, force)
    # The torque goes from zero to its largest in the time in which the force does.
    step = c.max_slew * elapsed * c.max_torque / c.max_force
    safety.settle(s.torque, step, c.max_torque, gain, turning)
    finite = np.isfinite(norm(force) + norm(turning))
    for k in range(3):
        s.force[k] = force[k] if finite else 0.0
        s.torque[k] = turning[k] if finite else 0.0
    if c.body_frame:
        _rotate(s.orientation, s.force, -1.0, s.wrench[:3])
        _rotate(s.orientation, s.torque, -1.0, s.wrench[3:])
    else:
        for k in range(3):
            s.wrench[k], s.wrench[3 + k] = s.force[k], s.torque[k]
    return finite
