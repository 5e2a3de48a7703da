"""Kernels of the force of a blade between two samples: it goes in, is pulled, or jaws hold."""

import numpy as np

from cutting_trainer.haptic_bridge import extrapolation, safety
from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import norm
from cutting_trainer.tissue_sim.contact.tool import ToolMode

_SCALPEL = ToolMode.SCALPEL.value
_STEPS = 8
"""Steps in which the way of the tool since a new sample is followed."""
_MAX_DEEPER = 2.0
"""Factor by which the blade may be longer in the tissue than at the newest sample."""
_MIN_SHARE = 0.05
"""Share of the whole stiffness below which a force does not fall as the edge goes on."""
_MIN_HELD = 0.01
"""Share of a slip that is left of it where the tissue springs back, before `_way_out` bounds it."""
_MIN_SINE = 0.1
"""Sine of the angle between force and edge below which it says nothing of the cutting force."""


@inner
def enter(setup: np.ndarray, state: np.ndarray, time: int, out: np.ndarray) -> None:
    """Let the force fall in the tick in which it lets the blade in: a sample that says so comes a
    frame later.

    Friction is left, on the length of the blade below the undented surface: the tissue springs back
    to there.
    """
    c, s = setup[0], state[0]
    if s.mode != _SCALPEL:
        return
    if s.entered == 0 and norm(out) >= max(c.entry_force, s.borne):
        s.entered = time
    if s.entered != 0:
        safety.clamp(c.blade_friction * norm(s.proxy - s.tip), out)


@inner
def hold(setup: np.ndarray, state: np.ndarray, history: np.ndarray, out: np.ndarray) -> None:
    """Compute the force of tissue between jaws. They hold a point: a turn changes nothing."""
    s, h = state[0], history[0]
    if h.count == 0:
        return
    scale = extrapolation.rendered_share(h.stiffness, setup[0].max_stiffness)
    for k in range(3):
        pull = 0.0
        for j in range(3):
            pull += h.stiffness[k, j] * (s.tip[j] - h.position[1, j])
        out[k] = h.force[1, k] - scale * pull
    safety.clamp(min(s.resistance, s.held), out)


@inner
def pull_blade(
    setup: np.ndarray, state: np.ndarray, history: np.ndarray, out: np.ndarray, torque: np.ndarray
) -> None:
    """Compute force and torque of a blade by the stiffness at its newest sample.

    The edge goes on in the tissue, along the force, where the force exceeds the resistance:
    pulled along itself, it meets friction alone. A part that has left the tissue feels nothing: the
    force is in proportion to the length that is still in it. Where two samples show that the blade
    slips out, that length follows from the way of the tool. A sample says where the edge was at its
    time; from there, the way of the tool is followed again.
    """
    c, s = setup[0], state[0]
    length = c.length * extrapolation.share_inside(history[0].immersed)
    steps = _STEPS if s.renewed else 1
    s.renewed = False
    for step in range(1, steps + 1):
        _force_after(setup, state, history, step / steps, out, torque)
        if _go_on(setup, state, history, length, out):
            _force_after(setup, state, history, step / steps, out, torque)
    if history[0].leaving > 0.0:
        _slip_out(setup, state, history, length)
    left = min(1.0 - s.out, 1.0)
    for k in range(3):
        # The coupling is as stiff as its scene says where half of the blade is in the tissue.
        s.stretch[k] = out[k] * 0.5 * c.length / (c.coupling * length) if length > 0.0 else 0.0
        out[k] *= left
        torque[k] *= left
    safety.clamp(c.length, s.stretch)


@inner
def _force_after(
    setup: np.ndarray,
    state: np.ndarray,
    history: np.ndarray,
    share: float,
    out: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Compute force and torque on all that was in the tissue, after a share of the tool's way."""
    s, h, at = state[0], history[0], np.empty(3)
    for k in range(3):
        at[k] = h.position[1, k] + share * (s.tip[k] - h.position[1, k]) - s.advanced[k]
    extrapolation.local_blade(at, s.arms, history, setup[0].max_stiffness, out, torque)


@inner
def _go_on(
    setup: np.ndarray, state: np.ndarray, history: np.ndarray, length: float, force: np.ndarray
) -> bool:
    """Let the edge go on where its force exceeds the resistance; return whether it did.

    Where a crack runs in steps, a sample has those up to its own time; since then, they are here: a
    step lowers the force by k a (`tissue_sim/contact/crack.py`), and by no more than its part above
    friction.

    Args:
        setup, state, history: see `force_kernels`; `advanced` and `out` are changed.
        length: in the tissue at the newest sample [m].
        force: of that length [N], shape (3,).
    """
    c, s, h = setup[0], state[0], history[0]
    size, limit = norm(force), _largest_force(setup, state, history, length, force)
    if size <= limit or length == 0.0:
        return False
    scale, stiffness = extrapolation.rendered_share(h.stiffness, c.max_stiffness), 0.0
    for k in range(3):
        for j in range(3):
            stiffness += scale * force[k] * h.stiffness[k, j] * force[j] / size**2
    if stiffness <= _MIN_SHARE * scale * extrapolation.size_of(h.stiffness):
        return False
    drop, step = size - limit, min(stiffness * c.crack_length, limit - c.blade_friction * length)
    if step > 0.0:
        drop = np.ceil(drop / step) * step
    along = 0.0
    for k in range(3):
        s.advanced[k] -= drop / stiffness * force[k] / size
        along += s.advanced[k] * (s.arms[0, k] - s.arms[1, k]) / c.length
    if along > 0.0:
        # What is still in the tissue bears less: the tissue springs back, and more of it slips out.
        soft = max(scale / stiffness - 0.5 * c.length / (c.coupling * length), 0.0)
        cosine = max(_cosine(force, s.arms[1] - s.arms[0]), 0.0)
        held = max(1.0 - soft * limit * cosine / length, _MIN_HELD)
        along = max(along, min(along / held, _way_out(setup, state, history)))
    left = max(along - _protruding(setup, history, length), min(along, 0.0)) / length
    # Until the next sample, no part comes back that has left: the force would jump.
    s.out = min(max(left, s.out if s.out > 0.0 else 1.0 - _MAX_DEEPER), 1.0)
    return True


@inner
def _way_out(setup: np.ndarray, state: np.ndarray, history: np.ndarray) -> float:
    """Return how far the tool has been drawn out along its blade since the newest sample [m]."""
    s, way = state[0], 0.0
    for k in range(3):
        axis = (s.arms[0, k] - s.arms[1, k]) / setup[0].length
        way += (s.tip[k] - history[0].position[1, k]) * axis
    return max(way, 0.0)


@inner
def _protruding(setup: np.ndarray, history: np.ndarray, length: float) -> float:
    """Return by how much the blade's tip is out beyond the tissue, as below a sheet [m].

    As the blade is drawn out, this part goes first, and takes nothing from the length in the
    tissue.
    """
    return max(history[0].immersed[0] * setup[0].length - length / 2, 0.0)


@inner
def _slip_out(setup: np.ndarray, state: np.ndarray, history: np.ndarray, length: float) -> None:
    """Let a blade that slips out leave by the way of the tool.

    By way, `leaving` leaves at the sample, and then in inverse proportion to the rest: the shorter
    the edge, the farther its load moves the tissue, which springs back.
    """
    way = _way_out(setup, state, history) - _protruding(setup, history, length)
    if way <= 0.0 or length == 0.0:
        return
    rest = np.sqrt(max(1.0 - 2.0 * history[0].leaving * way / length, 0.0))
    state[0].out = max(state[0].out, 1.0 - rest)


@inner
def _largest_force(
    setup: np.ndarray, state: np.ndarray, history: np.ndarray, length: float, force: np.ndarray
) -> float:
    """Return the force at which the edge goes on [N]; arguments as of `_go_on`.

    It is J l sin(edge, force) + friction, and that of the tip to going deeper, as in
    `tissue_sim/contact/blade_law.py`. A sample shows how much of the edge has uncut tissue ahead,
    by the largest force that the edge transmits, or its own force where the blade slips out. Where
    a sample has a larger force, spine or flat bear it. Against the spine nothing is cut.
    """
    c, s, h = setup[0], state[0], history[0]
    most, shown, towards = s.resistance, norm(h.force[1]), 0.0
    for k in range(3):
        towards -= force[k] * s.facing[k]
    if h.leaving > 0.0:
        most = min(most, shown)
    if towards >= 0.0 and np.isfinite(c.toughness):
        rubbing = c.blade_friction * length
        cosine = _cosine(h.force[1], h.arms[0] - h.arms[1])
        cutting = max(most - rubbing, 0.0)
        if c.crack_length == 0.0:
            cutting /= max(np.sqrt(1.0 - cosine**2), _MIN_SINE)
            cutting = min(cutting, max(c.toughness * length, shown))
        cosine = _cosine(force, s.arms[0] - s.arms[1])
        most = cutting * np.sqrt(1.0 - cosine**2) + rubbing
        most += c.tip_resistance * max(cosine, 0.0)
    return most * max(1.0 - s.out, 1.0)


@inner
def _cosine(force: np.ndarray, axis: np.ndarray) -> float:
    """Return the cosine of the angle between a force and the edge; 0 where there is none."""
    along, size = 0.0, norm(force) * norm(axis)
    for k in range(3):
        along += force[k] * axis[k]
    return min(max(along / size, -1.0), 1.0) if size > 0.0 else 0.0
