"""Kernels of the force of a blade between two samples: it goes in, is pulled, or jaws hold."""

import numpy as np

from cutting_trainer.haptic_bridge import extrapolation, safety
from cutting_trainer.node_common.kernels import inner


@inner
def enter(setup: np.ndarray, state: np.ndarray, time: int, out: np.ndarray) -> None:
    """Let the force fall in the tick in which it lets the blade in: a sample that says so comes a
    frame later.

    Friction is left, on the length of the blade below the undented surface: the tissue springs back
    to there.
    """
    c, s = setup[0], state[0]
    if not s.enters:
        return
    if s.entered == 0 and safety.norm(out) >= max(c.entry_force, s.borne):
        s.entered = time
    if s.entered != 0:
        safety.clamp(c.blade_friction * safety.norm(s.proxy - s.tip), out)


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
    setup: np.ndarray,
    state: np.ndarray,
    history: np.ndarray,
    time: int,
    out: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Compute force and torque of a blade by the stiffness at its newest sample.

    Along itself the blade slips through the tissue, and a part that has left it feels nothing: the
    force is in proportion to the length that is still in it. Where a crack runs in steps, a sample
    has those up to its own time; since then, the edge goes on here.
    """
    c, s, h = setup[0], state[0], history[0]
    arms, most, none, at = s.arms, c.max_stiffness, np.zeros(3), np.empty(3)
    axis, slip = np.empty(3), 0.0
    for k in range(3):
        axis[k] = (arms[0, k] - arms[1, k]) / c.length
        slip += axis[k] * (s.tip[k] + arms[1, k] - h.position[1, k] - h.arms[1, k])
    before = 2.0 * h.immersed[0] * c.length  # its tip is in the tissue
    s.out = min(slip / before, 1.0) if before > 0.0 else 0.0
    for _ in range(2):
        for k in range(3):
            at[k] = s.tip[k] - slip * axis[k] - s.advanced[k]
        extrapolation.estimate(c.law, history, time, at, none, False, arms, most, out, torque)
        if c.crack_length == 0.0 or not extrapolation.step_ahead(
            out, history, s.resistance, c.crack_length, c.blade_friction, c.length, most, s.advanced
        ):
            break
    left = min(1.0 - s.out, 1.0)
    for k in range(3):
        out[k] *= left
        torque[k] *= left
