"""Extrapolation of the tissue force from 30 Hz samples to the time of each tick: thesis 6.3.

A sample i is (t_i, P_i, F_i): at time t_i, at tool position P_i, the tissue pushed the tool with
F_i. Times are those of the device poses that the simulation used, so the delay of the simulation is
extrapolated over too.
"""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.coupling_spring import surface_stiffness
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import cross, dot

CONSTANT, TIME, POSITION, LOCAL_STIFFNESS = range(4)
LAWS = {
    'constant': CONSTANT,
    'time': TIME,
    'position': POSITION,
    'local_stiffness': LOCAL_STIFFNESS,
}

MAX_EXTRAPOLATION = 3.0
"""Length of an extrapolation in sample intervals: one to compute, one to wait, one lost."""
MIN_SAMPLE_DISTANCE_M = 5e-5
"""[m] Samples closer than this differ by encoder noise only: the force is held instead."""
_MIN_WAY_M = 1e-4
"""[m] Way out between two samples from which a blade counts as drawn out."""
_MIN_SHOWN_M = 5e-4
"""[m] Way between two samples of a blade from which they show a stiffness."""
_MIN_LEAVING, _MAX_LEAVING = 0.3, 2.0
"""Length that leaves the tissue by the way out, from which the blade slips, and at most."""
_NONE = np.zeros((2, 3))
_MAX_STIFFNESS_RATIO = 2.0
"""Factor by which the stiffness may change since the newest sample."""

HISTORY = record_type(
    [
        ('count', 'i8'),  # samples that belong together: 0, 1 or 2; index 1 is the newest
        ('time', 'i8', (2,)),  # [ns]
        ('position', 'f8', (2, 3)),  # [m]
        ('force', 'f8', (2, 3)),  # [N]
        ('torque', 'f8', (2, 3)),  # [N m] about the end of the blade at its tip
        ('stiffness', 'f8', (3, 3)),  # [N/m] of the newest, -d(force)/d(position)
        ('arms', 'f8', (2, 3)),  # [m] from the tool's tip to root and tip of the blade, then
        ('immersed', 'f8', (2,)),  # mean and mean square of the places along the blade in tissue
        ('leaving', 'f8'),  # length of the blade that leaves the tissue by its way out; 0: none
        ('depth', 'f8', (3,)),  # [m] from tip to proxy in the contact that the newest answers
        ('topology', 'i8'),
        ('state', 'i8'),
    ]
)


@inner
def constant(force: np.ndarray, out: np.ndarray) -> None:
    """Hold the newest force: F = F_i (eq. 6.3). Forces [N], shape (n,)."""
    for k in range(len(out)):
        out[k] = force[k]


@inner
def time_linear(time: int, times: np.ndarray, forces: np.ndarray, out: np.ndarray) -> None:
    """Extrapolate along time: F = F_i + (t - t_i) / (t_i - t_{i-1}) (F_i - F_{i-1}) (eq. 6.4).

    Args:
        time: t [ns].
        times: t_{i-1}, t_i [ns], shape (2,).
        forces: F_{i-1}, F_i [N], shape (2, n).
        out: F [N], shape (n,).
    """
    interval = times[1] - times[0]
    s = 0.0
    if interval > 0:
        s = min(max((time - times[1]) / interval, 0.0), MAX_EXTRAPOLATION)
    for k in range(len(out)):
        out[k] = forces[1, k] + s * (forces[1, k] - forces[0, k])


@inner
def position_linear(
    position: np.ndarray,
    positions: np.ndarray,
    forces: np.ndarray,
    max_stiffness: float,
    out: np.ndarray,
) -> float:
    """Extrapolate along the last motion: F = F_i + s (F_i - F_{i-1}).

    s = (P - P_i).(P_i - P_{i-1}) / |P_i - P_{i-1}|^2.

    Eq. 6.5 with the sign that the printed norms lose: a tool that turns back gets s < 0. Samples
    closer than `MIN_SAMPLE_DISTANCE_M` give no line; s is bounded by `MAX_EXTRAPOLATION`, the slope
    by the stiffness that the device renders.

    Args:
        position: P [m], shape (3,).
        positions: P_{i-1}, P_i [m], shape (2, 3).
        forces: F_{i-1}, F_i [N], shape (2, 3).
        max_stiffness: largest |F_i - F_{i-1}| / |P_i - P_{i-1}| that is accepted [N/m].
        out: F [N], shape (3,).

    Returns:
        s.
    """
    squared = along = change = 0.0
    for k in range(3):
        d = positions[1, k] - positions[0, k]
        squared += d * d
        along += (position[k] - positions[1, k]) * d
        change += (forces[1, k] - forces[0, k]) ** 2
    s = 0.0
    if squared >= MIN_SAMPLE_DISTANCE_M * MIN_SAMPLE_DISTANCE_M:
        s = min(max(along / squared, -MAX_EXTRAPOLATION), MAX_EXTRAPOLATION)
        steepest = max_stiffness * np.sqrt(squared)
        change = np.sqrt(change)
        if change > steepest:
            s *= steepest / change
    for k in range(3):
        out[k] = forces[1, k] + s * (forces[1, k] - forces[0, k])
    return s


@inner
def rendered_share(stiffness: np.ndarray, max_stiffness: float) -> float:
    """Return the share of a stiffness that the device renders: all up to a Frobenius norm.

    Args:
        stiffness: [N/m], shape (3, 3).
        max_stiffness: that norm [N/m].
    """
    size = size_of(stiffness)
    return max_stiffness / size if size > max_stiffness else 1.0


@inner
def size_of(stiffness: np.ndarray) -> float:
    """Return the Frobenius norm of a stiffness, shape (3, 3)."""
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += stiffness[i, j] * stiffness[i, j]
    return np.sqrt(square)


@inner
def local_blade(
    position: np.ndarray,
    arms: np.ndarray,
    history: np.ndarray,
    max_stiffness: float,
    out: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Extrapolate by a stiffness spread evenly over the part of the blade in the tissue.

    A place s of the blade (0 at its tip, 1 at its root) has moved by d(s) = d_0 + s (d_1 - d_0).
    With the means over the places in the tissue, the force is F = F_i - K mean(d), its first moment
    G = G_i - K mean(s d), and the torque about the tip e x G, where e leads from tip to root. A
    blade that is not turned has moved by P - P_i everywhere.

    K is scaled down by `rendered_share`.

    Args:
        position: P [m], shape (3,).
        arms: from there to root and tip of the blade [m], shape (2, 3).
        history: dtype HISTORY, shape (1,).
        max_stiffness: [N/m].
        out: F [N], shape (3,).
        torque: [N m], shape (3,).
    """
    h = history[0]
    scale = rendered_share(h.stiffness, max_stiffness)
    mean, square = h.immersed[0], h.immersed[1]
    before, now, moment = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        before[k], now[k] = h.arms[0, k] - h.arms[1, k], arms[0, k] - arms[1, k]
    length, moved, first = dot(before, before), np.empty(3), np.empty(3)
    cross(h.torque[1], before, moment)
    for k in range(3):
        moment[k] = moment[k] / length if length > 0.0 else 0.0
        way, turned = position[k] - h.position[1, k], now[k] - before[k]
        there = arms[1, k] - h.arms[1, k]
        moved[k] = way + (there + mean * turned)
        first[k] = mean * (way + there) + square * turned
    for k in range(3):
        pull = spread = 0.0
        for j in range(3):
            pull += h.stiffness[k, j] * moved[j]
            spread += h.stiffness[k, j] * first[j]
        out[k] = h.force[1, k] - scale * pull
        moment[k] -= scale * spread
    cross(now, moment, torque)


@inner
def stiffness_along_path(
    stiffness: np.ndarray,
    depth: np.ndarray,
    force: np.ndarray,
    path: np.ndarray,
    largest: float,
) -> float:
    """Return k of a contact at the new tool position [N/m].

    K = k n n^T - (F / k) n (grad k)^T says how k changes along the surface; it is followed to
    `_MAX_STIFFNESS_RATIO` times and through `_MAX_STIFFNESS_RATIO`.

    Args:
        stiffness: K [N/m], shape (3, 3).
        depth: from the tip to the proxy, along n [m], shape (3,).
        force: [N], shape (3,); F is its part along n.
        path: of the tip since then [m], shape (3,).
        largest: [N/m].
    """
    k = surface_stiffness(stiffness, largest)
    size = np.sqrt(depth[0] ** 2 + depth[1] ** 2 + depth[2] ** 2)
    pressed = drop = 0.0
    for i in range(3):
        n = depth[i] / size if size > 0.0 else 0.0
        pressed += n * force[i]
        for j in range(3):
            drop += n * stiffness[i, j] * path[j]
        drop -= k * n * path[i]
    if k >= largest or pressed <= 0.0:
        return k
    change = min(max(1.0 - drop / pressed, 1.0 / _MAX_STIFFNESS_RATIO), _MAX_STIFFNESS_RATIO)
    return min(k * change, largest)


@inner
def local_surface(
    depth: np.ndarray,
    at: np.ndarray,
    force: np.ndarray,
    stiffness: float,
    here: float,
    out: np.ndarray,
) -> None:
    """Extrapolate on a surface with edges: F = n (F_i . n_i + k |d| - k_i |d_i|).

    d = |d| n leads from the tip to the proxy on the undented surface. On a plane of
    even stiffness this is F_i - k n n^T (P - P_i).

    Args:
        depth: d [m], shape (3,).
        at: d_i [m], shape (3,).
        force: F_i [N], shape (3,).
        stiffness: k_i [N/m].
        here: k [N/m].
        out: F [N], shape (3,).
    """
    deep = before = along = 0.0
    for k in range(3):
        deep += depth[k] * depth[k]
        before += at[k] * at[k]
        along += force[k] * at[k]
    deep, before = np.sqrt(deep), np.sqrt(before)
    out[:] = 0.0
    if deep == 0.0:
        return
    pressed = along / before if before > 0.0 else 0.0
    pressed += here * deep - stiffness * before
    for k in range(3):
        out[k] = max(pressed, 0.0) / deep * depth[k]


@kernel
def estimate(
    law: int,
    history: np.ndarray,
    time: int,
    position: np.ndarray,
    depth: np.ndarray,
    touching: bool,
    arms: np.ndarray,
    max_stiffness: float,
    out: np.ndarray,
    torque: np.ndarray,
) -> None:
    """Compute force and torque at (time, position) by one of `LAWS`.

    A single sample has no line: TIME holds it, POSITION follows the stiffness there.

    Args:
        law: CONSTANT, TIME, POSITION or LOCAL_STIFFNESS.
        history: of at least one sample, dtype HISTORY, shape (1,).
        time: [ns] of the device pose.
        position: of the tool tip [m], shape (3,).
        depth: from there to the proxy [m], shape (3,).
        touching: the tool is on the surface, not in the tissue.
        arms: from the tip to root and tip of the blade [m], shape (2, 3).
        max_stiffness: [N/m].
        out: force [N], shape (3,).
        torque: about the end of the blade at its tip [N m], shape (3,).
    """
    h = history[0]
    local = law == LOCAL_STIFFNESS or (law == POSITION and h.count < 2)
    if local and touching:
        path = position - h.position[1]
        k = surface_stiffness(h.stiffness, max_stiffness)
        here = stiffness_along_path(h.stiffness, h.depth, h.force[1], path, max_stiffness)
        local_surface(depth, h.depth, h.force[1], k, here, out)
    elif local:
        local_blade(position, arms, history, max_stiffness, out, torque)
    elif law == TIME and h.count == 2:
        time_linear(time, h.time, h.force, out)
        time_linear(time, h.time, h.torque, torque)
    elif law == POSITION:
        s = position_linear(position, h.position, h.force, max_stiffness, out)
        for k in range(3):
            torque[k] = h.torque[1, k] + s * (h.torque[1, k] - h.torque[0, k])
    else:
        constant(h.force[1], out)
        constant(h.torque[1], torque)


def clear(history: np.ndarray) -> None:
    """Remove the samples; the stiffness stays, as the last known of this tissue."""
    history['count'] = 0


def push(
    history: np.ndarray,
    time: int,
    position: np.ndarray,
    force: np.ndarray,
    stiffness: np.ndarray,
    depth: np.ndarray,
    *,
    topology: int,
    state: int,
    torque: np.ndarray = _NONE[0],
    arms: np.ndarray = _NONE,
    immersed: np.ndarray = _NONE[0, :2],
) -> None:
    """Add a sample. A change of connectivity or of the contact's state removes older samples.

    Args:
        history: dtype HISTORY, shape (1,), changed in place.
        time: [ns].
        position: [m], shape (3,).
        force: [N], shape (3,).
        stiffness: [N/m], shape (3, 3); all zero where the simulation has none: the last known one
            is kept.
        depth: from tip to proxy in the contact that the sample answers [m], shape (3,).
        topology: connectivity count of the mesh that the sample stems from.
        state: contact state that it stems from.
        torque: [N m], shape (3,).
        arms: from the tool's tip to root and tip of the blade in that contact [m], shape (2, 3).
        immersed: as in `TissueSample`, shape (2,).
    """
    arrays = (position, force, torque, stiffness, depth, arms, immersed)
    _push(history, time, topology, state, *(np.asarray(array, np.float64) for array in arrays))


@inner
def share_inside(immersed: np.ndarray) -> float:
    """Return the share of the blade that is in the tissue.

    Args:
        immersed: mean and mean square of the places in the tissue, shape (2,). Places from s to s +
            b have the variance b^2 / 12.
    """
    return np.sqrt(12.0 * max(immersed[1] - immersed[0] ** 2, 0.0))


@inner
def _leaving(history: np.ndarray, arms: np.ndarray, immersed: np.ndarray) -> float:
    """Return the length of the blade that has left the tissue by its way out since the last sample.

    0 where it is not drawn out, or takes the tissue along; else 0.3 to 2: tissue that is let go
    springs back.

    Args:
        history: with the positions of both samples, but `immersed` of the last, dtype HISTORY,
            shape (1,).
        arms, immersed: of the new sample, as for `push`.
    """
    h = history[0]
    axis = arms[0] - arms[1]
    length, way = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2), 0.0
    for k in range(3):
        way += axis[k] * (h.position[1, k] - h.position[0, k])
    if way <= _MIN_WAY_M * length:
        return 0.0
    left = length * (share_inside(h.immersed) - share_inside(immersed)) / (way / length)
    return min(left, _MAX_LEAVING) if left > _MIN_LEAVING else 0.0


@inner
def _stiffen(history: np.ndarray, arms: np.ndarray, immersed: np.ndarray) -> None:
    """Raise the stiffness along the last way to that which the two samples show.

    The stiffness of a sample is that of small strains, and tissue stiffens. It is never lowered: a
    loop with too small a stiffness is not stable. A short way shows how late the tissue answers.

    Args:
        history: two samples of a blade, but `arms` of the last, dtype HISTORY, shape (1,);
            `stiffness` is changed.
        arms, immersed: of the new sample, as for `push`.
    """
    h = history[0]
    way, square, shown, known = np.empty(3), 0.0, 0.0, 0.0
    for i in range(3):  # of the middle of the part in the tissue
        tip, root = arms[1, i] - h.arms[1, i], arms[0, i] - h.arms[0, i]
        way[i] = h.position[1, i] - h.position[0, i] + tip + immersed[0] * (root - tip)
        square += way[i] * way[i]
        shown -= way[i] * (h.force[1, i] - h.force[0, i])
    for i in range(3):
        for j in range(3):
            known += way[i] * h.stiffness[i, j] * way[j]
    more = min(shown, _MAX_STIFFNESS_RATIO * known) - known
    if square < _MIN_SHOWN_M**2 or more <= 0.0:
        return
    for i in range(3):
        for j in range(3):
            h.stiffness[i, j] += more * way[i] * way[j] / square**2


@kernel(nogil=True)
def _push(
    history, time, topology, state, position, force, torque, stiffness, depth, arms, immersed
):
    h = history[0]
    goes_on = h.count > 0 and h.state == state and immersed[1] > 0.0
    same = h.topology == topology and h.state == state
    h.count = min(h.count + 1, 2) if same else 1
    h.time[0] = h.time[1]
    h.time[1] = time
    for k in range(3):
        h.position[0, k], h.force[0, k], h.torque[0, k] = (
            h.position[1, k],
            h.force[1, k],
            h.torque[1, k],
        )
        h.position[1, k], h.force[1, k], h.torque[1, k] = position[k], force[k], torque[k]
        h.depth[k] = depth[k]
    given = np.any(stiffness)
    if given:
        h.stiffness[:] = 0.5 * (stiffness + stiffness.T) if immersed[1] > 0.0 else stiffness
    h.leaving = _leaving(history, arms, immersed) if goes_on else 0.0
    if goes_on and h.count == 2 and h.leaving == 0.0 and given:
        _stiffen(history, arms, immersed)
    h.arms[:] = arms
    h.immersed[:] = immersed
    h.topology = topology
    h.state = state
