"""Compiled step of the proxy: with the surface, then after the device, with friction."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy import friction
from cutting_trainer.haptic_bridge.proxy.kernels import (
    GATHER_MARGIN,
    distance,
    leave_tissue,
    report,
    seek,
)
from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import assign

ANOTHER, SAME, NEXT = range(3)
"""A surface in relation to that of the last step: one that has nothing to do with it, the same one,
or the one that begins where it ends."""
_MAX_SUBSTEPS = 8


@inner
def move(
    surface: Geometry,
    motion: float,
    known: Geometry,
    known_motion: float,
    relation: int,
    before: float,
    blend: float,
    device: np.ndarray,
    radius: float,
    state: np.ndarray,
    stick: np.ndarray,
) -> None:
    """Move the proxy with the surface, then towards the device, and write its contact.

    With friction it stays over its anchor, and follows the device along the normal.

    Args:
        surface: of the tissue.
        motion: largest displacement of its nodes from start to end [m].
        known, known_motion: the same of the last step.
        relation: SAME, NEXT, or ANOTHER where there is no last step.
        before: blend of the last step.
        blend: 0 at the surface's start, 1 at its end.
        device: tip [m], shape (3,).
        radius: of the proxy [m].
        state: record of `kernels.STATE`, shape (1,), written.
        stick: record of `friction.STICK`, shape (1,), written; `friction.drag` must follow each
            step that touches.
    """
    s, grip = state[0], stick[0]
    if not s.placed:
        relation = ANOTHER
    rubs = grip.sliding_friction > 0.0
    stays = rubs and grip.placed and relation != ANOTHER
    start = before
    if relation == NEXT:
        if stays:
            friction.follow(stick, known, 1.0 - before, s.nodes, s.weights)
        _carry(known, before, 1.0, known_motion, radius, state)
        start = 0.0
    elif relation == ANOTHER:
        start = blend
        s.nodes[:] = -1
        s.clearance = 0.0
    if stays:
        friction.follow(stick, surface, blend - start, s.nodes, s.weights)
        friction.aim(stick, device, s.normal)
    for k in range(3):
        s.over[k] = device[k] + grip.offset[k]
    if start != blend or relation == ANOTHER:
        _carry(surface, start, blend, motion, radius, state)
    _follow_device(surface, blend, s.over, radius, state)
    if not rubs:
        return
    if not s.touching:
        friction.release(stick)
    elif not stays or grip.sliding:
        assign(grip.anchor, s.position)
        grip.placed = True


move_alone = kernel(move, nogil=True)
"""The same for Python."""


@inner
def detach(state: np.ndarray, stick: np.ndarray) -> None:
    """Let the next step start at the device; arguments as of `move`."""
    state[0].placed = state[0].touching = False
    friction.release(stick)


detach_alone = kernel(detach)
"""The same for Python."""


@inner
def _follow_device(
    surface: Geometry, blend: float, device: np.ndarray, radius: float, state: np.ndarray
) -> None:
    """Move the proxy towards the device [m], shape (3,), and write its contact."""
    s = state[0]
    if not s.placed:
        assign(s.position, device)
        assign(s.device, device)
        s.nodes[:] = -1
        s.placed = True
        leave_tissue(surface, blend, radius, state)
    stride = 2.0 * distance(device, s.device)
    assign(s.device, device)
    assign(s.goal, device)
    seek(surface, blend, min(stride, 2.0 * radius), GATHER_MARGIN * radius, radius, state)
    s.depth = distance(device, s.position)
    report(surface, blend, radius, state)


@inner
def _carry(
    surface: Geometry, start: float, end: float, motion: float, radius: float, state: np.ndarray
) -> None:
    """Move the proxy with the surface between two blends, in steps that cannot skip it."""
    s = state[0]
    if not s.placed:
        return
    motion *= abs(end - start)
    wanted = np.ceil(motion / max(0.5 * s.clearance, 1e-9))
    steps = int(min(max(wanted, 1.0), _MAX_SUBSTEPS))
    for i in range(1, steps + 1):
        blend = start + (end - start) * i / steps
        if motion / steps >= s.clearance and leave_tissue(surface, blend, radius, state):
            continue
        if i < steps or wanted > 1:
            assign(s.goal, s.position)
            seek(surface, blend, 0.0, GATHER_MARGIN * radius, radius, state)
