"""Checks of the poses of a connected arm by guided moves: scale, quaternion order, frame.

Limitations: they rest on the person who makes the moves. The scale is as exact as the move along
the ruler; the order of the quaternion comes from one quarter turn about a known axis.
"""

import math
from collections.abc import Collection

import numpy as np

from cutting_trainer.haptic_bridge.devices.probe_stream import ProbeCheck
from cutting_trainer.node_common.orientation import from_quaternion

RULER_LENGTH_M = 0.1
"""[m] Length of the requested move along a ruler."""
SCALE_RANGE = (0.85, 1.15)
"""Range of the right ratio of the length sent to that of the ruler."""
QUARTER_TURN_DEG = 90.0
"""[deg] Requested rotation of the tool, about the direction up, to the left."""
_MIN_ROTATION_DEG, _MAX_OFF_AXIS_DEG = 45.0, 40.0
_REST, _STILL = 0.6, 0.05
_ORDERS = {
    'x y z w': ((0, 1, 2, 3), 1.0),
    'w x y z': ((1, 2, 3, 0), 1.0),
    'x y z w of the inverse': ((0, 1, 2, 3), -1.0),
    'w x y z of the inverse': ((1, 2, 3, 0), -1.0),
}
"""Indices of x, y, z, w in the sent quaternion, and the sign of the vector part."""


def check_ruler(move: np.ndarray | None, metres: float, topic: str) -> list[ProbeCheck]:
    """Check the scale of the positions by a move along a ruler.

    Args:
        move: as sent, shape (3,); None: nobody made it.
        metres: one unit of the positions [m].
        topic: of the poses.
    """
    if move is None:
        return [ProbeCheck('scale', 'unknown', '', f'no move along a ruler was seen in {topic}')]
    length = metres * float(np.linalg.norm(move))
    scale = length / RULER_LENGTH_M
    measured = f'{1e3 * length:.0f} mm for {1e3 * RULER_LENGTH_M:g} mm, by the ruler'
    if SCALE_RANGE[0] <= scale <= SCALE_RANGE[1]:
        return [ProbeCheck('scale', 'ok', measured)]
    return [
        ProbeCheck(
            'scale',
            'wrong',
            measured,
            f'{topic} moved by {1e3 * length:.0f} mm where the ruler says {1e3 * RULER_LENGTH_M:g}:'
            f' the driver scales positions by {scale:.2f}, so a stiffness is felt {scale:.2f} '
            'times; take its scale out and use device.tissue_from_device.scale',
        )
    ]


def check_rotation(
    before: np.ndarray, after: np.ndarray | None, up: np.ndarray, topic: str
) -> ProbeCheck:
    """Check the order of the quaternion by a quarter turn to the left, about the direction up.

    Args:
        before, after: quaternions as sent, shape (4,); `after` is None where nobody turned it.
        up: of the device's frame, right-handed, any length, shape (3,).
        topic: of the poses.
    """
    name = 'orientation'
    if after is None:
        return ProbeCheck(name, 'unknown', '', f'no rotation of the tool was seen in {topic}')
    wanted = up / np.linalg.norm(up)
    found = {}
    for order, (places, sense) in _ORDERS.items():
        turns = [
            from_quaternion((*(sense * q[list(places[:3])]), q[places[3]])) for q in (before, after)
        ]
        angle, axis = _angle_and_axis(turns[1] @ turns[0].T)
        found[order] = angle, math.degrees(math.acos(np.clip(axis @ wanted, -1.0, 1.0)))
    fitting = {
        order: off
        for order, (angle, off) in found.items()
        if _MIN_ROTATION_DEG < angle < 180 - _MIN_ROTATION_DEG and off < _MAX_OFF_AXIS_DEG
    }
    angle, off = found['x y z w']
    measured = f'{angle:.0f} deg, {off:.0f} deg off the axis, by the turn'
    best = min(fitting, key=lambda order: fitting[order], default='')
    if best == 'x y z w':
        return ProbeCheck(name, 'ok', measured)
    if not best:
        why = (
            f'the tool was to be turned by {QUARTER_TURN_DEG:g} degrees to the left about the '
            f'direction up, and no order of the quaternion in {topic} gives that: turn it again, '
            'or look at the frame of the driver'
        )
        return ProbeCheck(name, 'unknown', measured, why)
    return ProbeCheck(
        name,
        'wrong',
        measured,
        f'the quaternion in {topic} is {best}, and ROS has x y z w of the rotation from tool to '
        'base: mend the driver, since the blade would point elsewhere',
    )


def find_rotation(times: np.ndarray, quaternions: np.ndarray) -> np.ndarray | None:
    """Return the orientation after the first rotation that ends at rest, in the order sent.

    Args:
        times: [s], shape (n,).
        quaternions: as sent, shape (n, 4).

    Returns:
        The quaternion, shape (4,); None as long as there was no rotation.
    """
    if len(times) < 3:
        return None
    last = quaternions[times >= times[-1] - _REST]
    same = abs(float(quaternions[0] @ last[-1]))
    if same > math.cos(math.radians(_MIN_ROTATION_DEG) / 2) or np.ptp(last, axis=0).max() > _STILL:
        return None
    return np.asarray(last[-1])


def _angle_and_axis(rotation: np.ndarray) -> tuple[float, np.ndarray]:
    """Return angle [deg] and axis of a rotation, shape (3, 3)."""
    vector = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = float(np.linalg.norm(vector)) / 2
    angle = math.degrees(math.atan2(sine, (float(np.trace(rotation)) - 1) / 2))
    return angle, vector / max(2 * sine, 1e-12)


def check_frame(frames: Collection[str], topic: str) -> ProbeCheck:
    """Check that all poses of the probe were in one frame.

    Args:
        frames: each frame_id that was seen.
        topic: of the poses.
    """
    if len(frames) == 1:
        return ProbeCheck('frame', 'ok', f'always {next(iter(frames))!r}')
    names = ' and '.join(repr(name[:64]) for name in sorted(frames)[:4])
    return ProbeCheck(
        'frame',
        'wrong',
        names,
        f'the frame_id of {topic} changes ({names}): the bridge enters FAULT at that; publish one '
        'frame, and do not switch it (a base frame that is set at run time?)',
    )
