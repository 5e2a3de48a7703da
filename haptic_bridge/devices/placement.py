"""Where a device stands, from touches of points whose place in the tissue's frame is known.

Limitations: the touches are as exact as the hand that makes them. Points in one plane do not tell a
mirrored frame: the lift and the turn do.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cutting_trainer.haptic_bridge.devices.probe_stream import extent

MIN_POINTS = 3
MAX_RESIDUAL_SHARE = 0.015
"""Largest distance of a touch from its point, as a share of the extent of all points."""
MAX_TREMOR_M = 0.002
"""[m] Extent of the tip's path, at the hand, while it is held still on a point."""
MIN_SPREAD = 0.15
"""Smallest ratio of breadth to length of the points, as standard deviations."""
HOLD_S = 1.5
"""[s] for which the tip is held still on a point."""
MIN_MOVE_M = 0.005
"""[m] Shortest way, at the hand, from one point to the next."""
LIFT_M = 0.05
"""[m] by which the tip is lifted."""
_MIN_LIFT_M = 0.015
_MAX_LIFT_OFF_DEG = 40.0
_MAX_SCALE, _MIN_SCALE = 100.0, 0.01


class PlacementError(ValueError):
    """The touches do not say where the device is; the message is a sentence."""


class Placement(NamedTuple):
    """A device in the tissue's frame: tissue = translation + rotation (scale * device).

    Attributes:
        translation: [m], shape (3,).
        rotation: shape (3, 3).
        scale: tissue motion over device motion.
        residuals: distances of the touches from their points, in the tissue's frame [m], shape
            (n,).
    """

    translation: np.ndarray
    rotation: np.ndarray
    scale: float
    residuals: np.ndarray

    @property
    def rpy_deg(self) -> tuple[float, float, float]:
        """Return roll, pitch and yaw about the fixed axes x, y, z [deg]."""
        r = self.rotation
        pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
        if math.hypot(r[0, 0], r[1, 0]) > 1e-9:
            roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
        else:  # roll and yaw turn about one axis: all is yaw
            roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
        return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def find_touch(times: np.ndarray, positions: np.ndarray, metres: float) -> np.ndarray | None:
    """Return where the tip rests after a move.

    Args:
        times: [s], shape (n,).
        positions: as sent, shape (n, 3).
        metres: one unit of the positions [m].

    Returns:
        The mean of its positions there, in the unit sent, shape (3,); None as long as it does not.
    """
    if len(times) < 3 or times[-1] - times[0] < HOLD_S:
        return None
    last = positions[times >= times[-1] - HOLD_S]
    if metres * extent(last) > MAX_TREMOR_M:
        return None
    found = np.asarray(last.mean(axis=0))
    moved = metres * float(np.linalg.norm(found - positions[0]))
    return found if moved >= MIN_MOVE_M else None


def why_no_touch(positions: np.ndarray, metres: float, name: str) -> PlacementError:
    """Return why a touch was not seen in the positions since it was asked for."""
    if len(positions) and metres * extent(positions) > MIN_MOVE_M:
        return PlacementError(
            f'the tip was not held still on {name}: rest the hand, and hold it within '
            f'{1e3 * MAX_TREMOR_M:g} mm for {HOLD_S:g} s'
        )
    return PlacementError(f'the tip was not moved to {name}')


def place(touched: np.ndarray, points: np.ndarray, names: Sequence[str] = ()) -> Placement:
    """Fit the placement of a device to touches of known points, in the sense of least squares.

    Args:
        touched: positions of the device [m], shape (n, 3).
        points: the same places in the tissue's frame [m], shape (n, 3).
        names: of the points, for the messages.

    Raises:
        PlacementError: there are too few points, they are in line, or no placement fits them.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", IEEE PAMI 13 (1991), eq. 40 to 42.
    """
    touched, points = np.asarray(touched, float), np.asarray(points, float)
    if len(touched) < MIN_POINTS or len(touched) != len(points):
        raise PlacementError(
            f'{len(touched)} points were touched: it takes {MIN_POINTS} at least, not in line'
        )
    for where, of in (('points', points), ('touches', touched)):
        _require_spread(where, of)
    ours, theirs = points - points.mean(axis=0), touched - touched.mean(axis=0)
    u, sizes, v = np.linalg.svd(ours.T @ theirs)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))])
    if sign[2] < 0 and sizes[2] > 0.02 * sizes[0]:
        raise PlacementError(
            'the touches are a mirror image of the points: the frame of the device is '
            'left-handed (device.mirrored_axis), or two points were touched in the other order'
        )
    rotation = (u * sign) @ v
    scale = float(sizes @ sign / np.sum(theirs**2))
    translation = points.mean(axis=0) - scale * (rotation @ touched.mean(axis=0))
    found = translation + scale * touched @ rotation.T
    residuals = np.linalg.norm(found - points, axis=1)
    if not _MIN_SCALE <= scale <= _MAX_SCALE:
        raise PlacementError(
            f'the tool would move {scale:.3g} times as far as the hand: is device.length_unit '
            'that of the driver?'
        )
    if residuals.max() > MAX_RESIDUAL_SHARE * extent(points):
        worst = int(np.argmax(residuals))
        name = names[worst] if names else f'point {worst + 1}'
        raise PlacementError(
            f'{name} is {1e3 * residuals[worst]:.1f} mm off where the other touches put it: touch '
            'the points in the order asked for, on the spot'
        )
    return Placement(translation, rotation, scale, residuals)


def _require_spread(where: str, points: np.ndarray) -> None:
    lengths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if lengths[1] <= MIN_SPREAD * lengths[0]:
        raise PlacementError(
            f'the {where} are in line, or at one place: how the device is turned about that line '
            'is unknown; take points that span a triangle'
        )


def check_lift(placement: Placement, lift: np.ndarray) -> None:
    """Check that the device's way up is the tissue's.

    Args:
        placement: as fitted.
        lift: displacement of the device while the tip was lifted [m], shape (3,).

    Raises:
        PlacementError: it is another direction.
    """
    moved = placement.rotation @ lift
    size = float(np.linalg.norm(moved))
    if size < _MIN_LIFT_M:
        raise PlacementError(
            f'the tip was lifted by {1e3 * size:.0f} mm: lift it by about {1e3 * LIFT_M:g} mm'
        )
    off = math.degrees(math.acos(np.clip(moved[2] / size, -1.0, 1.0)))
    if off > 180.0 - _MAX_LIFT_OFF_DEG:
        raise PlacementError(
            'the tip was lifted, and the tool would go down: the frame of the device is '
            'left-handed (device.mirrored_axis), or two points were touched in the other order'
        )
    if off > _MAX_LIFT_OFF_DEG:
        raise PlacementError(
            f'the tip went {off:.0f} degrees off the vertical: lift it straight up'
        )
