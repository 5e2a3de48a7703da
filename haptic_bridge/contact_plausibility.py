"""Plausibility of the simulation's contact state and stiffness, by the bridge's own surface."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.inside_test import MAX_FAN, is_inside
from cutting_trainer.haptic_bridge.proxy.neighbourhood import NEAR, gather
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import Geometry
from cutting_trainer.node_common.kernels import inner

BLADE_POINTS = 13
"""Points of the blade that are checked: every 2 mm of one of 24 mm."""
MAX_BLADE_DISTANCE_RADII = 2.0
"""Largest distance of a blade in the tissue from the surface, in tool radii: elements that it
removes leave a hole around it."""
_REACHES_M = (0.001, 0.002, 0.003, 0.004)
"""[m] Distances of the blade from the surface beyond which the tissue holds it a quarter less each:
the spring between the device's edge and the one in the tissue is stretched by no more."""
TOUCH_MEMORY_NS = 100_000_000
"""[ns] after a touch in which the simulation may report that the blade has entered."""
MAX_STEP_AHEAD = 300
"""Largest number of frames that a step may skip, while frames come in time."""
STIFFNESS_DOUBLING_S = 0.033
"""[s] in which the known stiffness of the tissue may double: the time of a frame."""
INITIAL_STIFFNESS_SHARE = 0.1
"""Share of the coupling's stiffness from which the known stiffness grows."""
WORK = record_type(
    [
        ('edge', 'f8', (2, 3)),  # [m] root and tip of the blade in the tissue
        ('point', 'f8', (3,)),
        ('outward', 'f8', (3,)),
        ('near', NEAR, (1,)),
    ]
)
"""Work space of the kernels here: a record, as that of the proxy, so that what both call is
compiled once."""


@inner
def accepts(
    surface: Geometry,
    motion: float,
    blade: np.ndarray,
    radius: float,
    believed: bool,
    work: np.ndarray,
) -> bool:
    """Return whether the blade can be in the tissue.

    A blade enters the tissue where it is pressed against its surface. Therefore it can be there
    only if the tool has touched the bridge's own surface lately, or a part of the blade is under
    it; and only as long as the blade is near the surface, or under it.

    Args:
        surface: the newest of the tissue.
        motion: largest displacement of its nodes from start to end [m].
        blade: root and tip [m], shape (2, 3).
        radius: of the tool [m].
        believed: the blade was there in the tick before, or has touched lately.
        work: record of WORK, shape (1,).
    """
    # Between two frames the surface is anywhere between its start and its end.
    reach = MAX_BLADE_DISTANCE_RADII * radius
    reach += min(motion, reach)
    if believed and _is_near(surface, blade, reach, work):
        return True
    return _is_under(surface, blade, work)


@inner
def share_within(surface: Geometry, blade: np.ndarray, work: np.ndarray) -> float:
    """Return which share of its resistance the tissue can have against the blade.

    The simulation's last word is some frames old. A blade that is drawn out fast has left the
    surface by then, and must not be held any more. Arguments as of `accepts`.
    """
    # Nearly always the blade meets the surface somewhere, and one look nearby is enough.
    if _is_near(surface, blade, _REACHES_M[0], work) or _is_under(surface, blade, work):
        return 1.0
    for beyond in range(1, len(_REACHES_M)):
        if _is_near(surface, blade, _REACHES_M[beyond], work):
            return 1.0 - beyond / len(_REACHES_M)
    return 0.0


@inner
def _is_near(surface: Geometry, blade: np.ndarray, reach: float, work: np.ndarray) -> bool:
    """Return whether a part of the blade is no farther from the surface than a reach [m]."""
    w = work[0]
    for i in range(BLADE_POINTS):
        _along(blade, i, w.point)
        gather(surface, 1.0, w.point, reach, np.int64(1), w.near)
        if w.near[0].count > 0:
            return True
    return False


@inner
def _is_under(surface: Geometry, blade: np.ndarray, work: np.ndarray) -> bool:
    """Return whether a part of the blade is under the surface."""
    w = work[0]
    for i in range(BLADE_POINTS):
        _along(blade, i, w.point)
        gather(surface, 1.0, w.point, np.inf, np.int64(MAX_FAN), w.near)
        if w.near[0].count > 0 and is_inside(surface, w.point, w.near, w.outward):
            return True
    return False


@inner
def _along(blade: np.ndarray, i: int, point: np.ndarray) -> None:
    """Compute a point of the blade, one of `BLADE_POINTS`, counted from the tip."""
    share = i / (BLADE_POINTS - 1)
    for k in range(3):
        point[k] = blade[1, k] + share * (blade[0, k] - blade[1, k])


def bounded_stiffness(known: float, since_ns: int | None, reported: float, most: float) -> float:
    """Return the stiffness that is believed: down at once, up at a bounded rate.

    Args:
        known: stiffness that is believed so far [N/m]; 0: none.
        since_ns: time since it was known [ns]; None: it never was.
        reported: by the simulation [N/m].
        most: stiffness of the coupling spring, the largest that can be felt [N/m].
    """
    if not known or since_ns is None:
        known, since_ns = INITIAL_STIFFNESS_SHARE * most, 0
    limit = known * 2.0 ** min(since_ns * 1e-9 / STIFFNESS_DOUBLING_S, 3.0)
    return min(reported, limit, most)
