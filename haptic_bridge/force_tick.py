"""One tick of the force path from a checked pose on, compiled: contact, force and report."""

import math

import numpy as np

from cutting_trainer.haptic_bridge import contact_plausibility, safety
from cutting_trainer.haptic_bridge.contact_values import pack
from cutting_trainer.haptic_bridge.force_kernels import (
    ENERGY_CREDIT_J,
    GRASPERS,
    INSIDE,
    MAX_SLEW_PERIOD_S,
    NONE,
    TOUCHING,
    command,
)
from cutting_trainer.haptic_bridge.proxy import step
from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import norm

MIN_PERIOD_S = 1e-4
"""[s] Shortest period of a tick for velocities and the slew limit."""
_SECOND = 1e-9


@kernel(nogil=True)
def tick(
    setup: np.ndarray,
    state: np.ndarray,
    history: np.ndarray,
    depths: np.ndarray,
    arms: np.ndarray,
    report: np.ndarray,
    proxy: np.ndarray,
    work: np.ndarray,
    newest: Geometry,
    newest_motion: float,
    ground: Geometry,
    ground_motion: float,
    known: Geometry,
    known_motion: float,
    relation: int,
    before: float,
    blend: float,
    now: int,
    time: int,
    enabled: bool,
    faulty: bool,
    revision: int,
    topology: int,
    current: bool,
) -> tuple[int, bool]:
    """Compute contact, command and report of a tick: one call from Python.

    Args:
        setup, state, history: of a session, dtypes SETUP, STATE and HISTORY, shape (1,).
        depths: from the tip to the proxy [m], by sequence, shape (c, 3).
        arms: from the tip to root and tip of the blade [m], by sequence, shape (c, 2, 3).
        report: dtype `contact_values.CONTACT`, shape (1,); written.
        proxy: dtype `proxy.kernels.STATE`, shape (1,).
        work: dtype `contact_plausibility.WORK`, shape (1,).
        newest, newest_motion: surface of the tissue, and its largest motion [m].
        ground, ground_motion, known, known_motion, relation, before, blend: of the surface on which
            the proxy moves, as the first arguments of `proxy.step.move`.
        now: monotonic clock [ns].
        time: stamp of the device pose [ns].
        enabled: whether force is wanted.
        faulty: whether the force goes to zero at once.
        revision, topology: of the newest surface; revision -1 where there is none.
        current: whether it is as new as the newest sample.

    Returns:
        Contact state, and False where the result was not finite: force and torque are then zero.
    """
    c, s = setup[0], state[0]
    elapsed = min(max((now - s.now_ns) * _SECOND, MIN_PERIOD_S), MAX_SLEW_PERIOD_S)
    s.now_ns = now
    gain = _gain(setup, state, now, enabled)
    s.sequence += 1
    slot = s.sequence % len(arms)
    for end in range(2):
        for k in range(3):
            arms[slot, end, k] = s.arms[end, k]
    if current:
        s.current_ns = now
    seen, used = revision >= 0, False
    if not _stay_inside(setup, state, proxy, work, newest, newest_motion, now, enabled and seen):
        used = enabled and seen
        _leave(state, history, proxy, now, enabled)
        if used:
            step.move(
                ground,
                ground_motion,
                known,
                known_motion,
                relation,
                before,
                blend,
                s.tip,
                c.radius,
                proxy,
                s.stick,
            )
            _touch(state, history, proxy, now)
    if s.mode != s.next_mode and (s.contact != INSIDE or s.mode in GRASPERS):
        s.mode = s.next_mode
    if faulty:
        s.force[:] = 0.0
        s.torque[:] = 0.0
    p = proxy[0]
    for k in range(3):
        # With friction, the place of the proxy is less its offset: from the tip, its depth leads
        # there. Without a proxy it is the tip.
        s.proxy[k] = p.position[k] - s.stick[0].offset[k] if used else s.tip[k]
        if used:
            depths[slot, k] = s.proxy[k] - s.tip[k]
            if s.contact == TOUCHING:
                s.normal[k] = p.normal[k]
    finite = command(setup, state, history, s.contact, enabled, time, gain, elapsed)
    if s.contact != NONE:
        s.contact_time += elapsed
    s.max_norm = max(s.max_norm, norm(s.force))
    pack(state, proxy, used, time, max(revision, 0), topology, enabled, report)
    return s.contact, finite


@inner
def _gain(setup: np.ndarray, state: np.ndarray, now: int, enabled: bool) -> float:
    """Return the gain by soft start and age of the simulation's data; note when it goes stale."""
    c, s = setup[0], state[0]
    oldest = min(s.sample_ns, s.current_ns)
    age = (now - oldest) * _SECOND if oldest else math.inf
    stale = enabled and age > c.stale_after
    if stale and not s.stale:
        s.stale_trips += s.sample_ns > 0
    elif s.stale and not stale:
        s.start_ns = now
    s.stale = stale
    since = (now - s.start_ns) * _SECOND
    return safety.soft_start(since, c.soft_start) * safety.freshness(age, c.stale_after, c.fade)


@inner
def _stay_inside(
    setup: np.ndarray,
    state: np.ndarray,
    proxy: np.ndarray,
    work: np.ndarray,
    newest: Geometry,
    motion: float,
    now: int,
    enabled: bool,
) -> bool:
    """Let the blade be in the tissue where the simulation says so and that can be true.

    Returns:
        Whether it is.
    """
    c, s = setup[0], state[0]
    if not (enabled and s.says_inside and is_plausible(setup, state, newest, motion, now, work)):
        return False
    if s.contact != INSIDE:
        # The samples of the cut stay: the change of state has already voided the older ones.
        s.stretch[:] = 0.0
        step.detach(proxy, s.stick)
        s.held = norm(s.force) / c.force_scale + c.slack
        s.contact = INSIDE
    edge = work[0].edge
    for end in range(2):
        for k in range(3):
            edge[end, k] = s.blade[end, k] + s.stretch[k]
    s.reach = contact_plausibility.share_within(newest, edge, work)
    return True


@inner
def is_plausible(
    setup: np.ndarray,
    state: np.ndarray,
    newest: Geometry,
    motion: float,
    now: int,
    work: np.ndarray,
) -> bool:
    """Return whether the blade can be in the tissue; arguments as of `tick`."""
    s = state[0]
    touched = s.touched_ns != 0 and now - s.touched_ns <= contact_plausibility.TOUCH_MEMORY_NS
    believed = s.contact == INSIDE or touched
    return contact_plausibility.accepts(newest, motion, s.blade, setup[0].radius, believed, work)


is_plausible_alone = kernel(is_plausible, nogil=True)
"""The same for Python."""


@inner
def _leave(
    state: np.ndarray, history: np.ndarray, proxy: np.ndarray, now: int, enabled: bool
) -> None:
    """End the contact of a blade that is not in the tissue any more, and any without force."""
    s = state[0]
    if s.contact == INSIDE or (s.contact == TOUCHING and not enabled):
        leave_contact(state, history, proxy)
        s.start_ns = now


@inner
def leave_contact(state: np.ndarray, history: np.ndarray, proxy: np.ndarray) -> None:
    """End the contact; arguments as of `tick`."""
    s = state[0]
    step.detach(proxy, s.stick)
    s.contact, s.left = NONE, s.sequence
    history[0].count = 0


leave_contact_alone = kernel(leave_contact, nogil=True)
"""The same for Python."""


@inner
def _touch(state: np.ndarray, history: np.ndarray, proxy: np.ndarray, now: int) -> None:
    """Take the contact of the proxy."""
    s, before = state[0], state[0].contact
    s.contact = TOUCHING if proxy[0].touching else NONE
    if s.contact != before:
        history[0].count = 0
    if s.contact == NONE:
        if before == TOUCHING:
            s.left = s.sequence
        return
    s.touched_ns = now
    if before != TOUCHING:
        s.began = s.sequence
        # Energy that the last contact dissipated is no credit; energy that it made is a debt.
        s.energy = min(s.energy, ENERGY_CREDIT_J)
