"""Plausibility of the simulation's contact state and stiffness, by the bridge's own surface."""

import numpy as np

from cutting_trainer.haptic_bridge.proxy.inside_test import MAX_FAN, is_inside
from cutting_trainer.haptic_bridge.proxy.neighbourhood import NEAR, gather
from cutting_trainer.haptic_bridge.proxy.record_type import record_type
from cutting_trainer.haptic_bridge.proxy.surface import Geometry, Surface
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.node_common.kernels import inner, kernel

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
WORK = record_type([('point', 'f8', (3,)), ('outward', 'f8', (3,)), ('near', NEAR, (1,))])
"""Work space of the kernels here: a record, as that of the proxy, so that what both call is
compiled once."""


@kernel(nogil=True, error_model='numpy')
def is_near(
    surface: Geometry, blend: float, blade: np.ndarray, reach: float, work: np.ndarray
) -> bool:
    """Return whether a part of the blade is no farther from the surface than a reach.

    Args:
        surface: of the tissue.
        blend: 0 at the surface's start, 1 at its end.
        blade: root and tip [m], shape (2, 3).
        reach: [m].
        work: record of WORK, shape (1,).
    """
    w = work[0]
    for i in range(BLADE_POINTS):
        _along(blade, i, w.point)
        gather(surface, blend, w.point, reach, np.int64(1), w.near)
        if w.near[0].count > 0:
            return True
    return False


@kernel(nogil=True, error_model='numpy')
def is_under(surface: Geometry, blend: float, blade: np.ndarray, work: np.ndarray) -> bool:
    """Return whether a part of the blade is under the surface; arguments as of `is_near`."""
    w = work[0]
    for i in range(BLADE_POINTS):
        _along(blade, i, w.point)
        gather(surface, blend, w.point, np.inf, np.int64(MAX_FAN), w.near)
        if w.near[0].count > 0 and is_inside(surface, w.point, w.near, w.outward):
            return True
    return False


@inner
def _along(blade: np.ndarray, i: int, point: np.ndarray) -> None:
    """Compute a point of the blade, one of `BLADE_POINTS`, counted from the tip."""
    share = i / (BLADE_POINTS - 1)
    for k in range(3):
        point[k] = blade[1, k] + share * (blade[0, k] - blade[1, k])


class ContactPlausibility:
    """Checks whether the blade can be in the tissue, and bounds the stiffness of the tissue.

    A blade enters the tissue where it is pressed against its surface. The bridge therefore accepts
    a blade in the tissue only if the tool has touched the bridge's own surface lately, or a part of
    the blade is under it; and only as long as the blade is near the surface, or under it.

    Args:
        tool: section of the scene.
        coupling: stiffness of the coupling spring, the largest that can be felt [N/m].
    """

    def __init__(self, tool: ToolSettings, coupling: float) -> None:
        self._reach = MAX_BLADE_DISTANCE_RADII * tool.radius
        self._coupling = coupling
        self._work = np.zeros(1, WORK)
        self._touched_ns: int | None = None
        self._stiffness_ns: int | None = None

    def note_touch(self, now_ns: int) -> None:
        """Record that the tool touches the bridge's own surface at a time [ns]."""
        self._touched_ns = now_ns

    def accepts(
        self, now_ns: int, surface: Surface | None, blade: np.ndarray, *, already: bool
    ) -> bool:
        """Return whether the blade can be in the tissue.

        Args:
            now_ns: monotonic clock [ns].
            surface: the newest of the tissue.
            blade: root and tip [m], shape (2, 3).
            already: it was there in the tick before.
        """
        if surface is None:
            return False
        geometry = surface.geometry
        # Between two frames the surface is anywhere between its start and its end.
        reach = self._reach + min(surface.motion, self._reach)
        touched = self._touched_ns is not None and now_ns - self._touched_ns <= TOUCH_MEMORY_NS
        if (already or touched) and is_near(geometry, 1.0, blade, reach, self._work):
            return True
        return bool(is_under(geometry, 1.0, blade, self._work))

    def reach(self, surface: Surface, blade: np.ndarray) -> float:
        """Return which share of its resistance the tissue can have against the blade.

        The simulation's last word is some frames old. A blade that is drawn out fast has left the
        surface by then, and must not be held any more.

        Args:
            surface: the newest of the tissue.
            blade: root and tip [m], shape (2, 3).
        """
        geometry = surface.geometry
        if is_under(geometry, 1.0, blade, self._work):
            return 1.0
        for beyond, distance in enumerate(_REACHES_M):
            if is_near(geometry, 1.0, blade, distance, self._work):
                return 1.0 - beyond / len(_REACHES_M)
        return 0.0

    def update_stiffness(self, state: np.ndarray, now_ns: int, reported: float) -> None:
        """Follow the reported stiffness of the tissue: down at once, up at a bounded rate.

        Args:
            state: dtype chain.STATE, shape (1,); `known` [N/m] is changed.
            now_ns: monotonic clock [ns].
            reported: stiffness reported by the simulation [N/m].
        """
        known = float(state['known'][0])
        if not known or self._stiffness_ns is None:
            known = INITIAL_STIFFNESS_SHARE * self._coupling
            self._stiffness_ns = now_ns
        elapsed = (now_ns - self._stiffness_ns) * 1e-9
        limit = known * 2.0 ** min(elapsed / STIFFNESS_DOUBLING_S, 3.0)
        state['known'] = min(reported, limit, self._coupling)
        self._stiffness_ns = now_ns
