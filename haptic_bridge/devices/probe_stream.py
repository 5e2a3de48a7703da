"""Checks of the poses of a connected arm: rate, jitter, stamps, unit, handedness.

For scale and orientation see `probe_pose`, for the force `probe_force`.

Limitations: unit and handedness come from three moves that a person makes as asked, so they
distinguish metres from millimetres and left from right, not metres from feet.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.scene_schema import DeviceProfile

NOMINAL_RATE_HZ, MIN_RATE_HZ = 1000.0, 500.0
"""[Hz] Rate that the bridge wants, and the rate below which its force lags visibly."""
MAX_GAP_S = 0.02
"""[s] after which the bridge takes the device for silent (`haptics.device_timeout`)."""
MAX_AGE_S = 0.02
"""[s] Largest age of a pose on arrival; more means another clock, or a queue."""
REQUESTED_MOVE_M = 0.05
"""[m] Length of the requested moves."""
DIRECTIONS = ('to your right', 'away from you', 'up')
"""Directions of the three moves, in an order that gives a right-handed frame determinant > 0."""
PUSH_FORCE_N = 0.3
"""[N] of a push that tests the force."""
_UNITS = {'m': 1.0, 'dm': 10.0, 'cm': 100.0, 'mm': 1000.0}
_MIN_VOLUME = 0.3
_BY_NOISE, _MIN_MOVE = 15.0, 0.005
_REST, _REST_SHARE = 0.6, 0.1

Verdict = Literal['ok', 'wrong', 'unknown']


@dataclass(frozen=True)
class ProbeCheck:
    """Result of one check.

    Attributes:
        name: of it.
        verdict: ok, wrong, or unknown where it could not be measured.
        measured: the result in a few words.
        sentence: the fault and its remedy, or why the result is unknown; '' if ok.
    """

    name: str
    verdict: Verdict
    measured: str
    sentence: str = ''


@dataclass(frozen=True)
class Poses:
    """Received poses, in the order of arrival.

    Attributes:
        arrivals: on the system clock [s], shape (n,).
        stamps: of the header [s]; 0 marks invalid ones. Shape (n,).
        values: position as sent and quaternion x y z w, shape (n, 7).
    """

    arrivals: np.ndarray
    stamps: np.ndarray
    values: np.ndarray

    @property
    def positions(self) -> np.ndarray:
        """Return the positions as sent, shape (n, 3)."""
        return self.values[:, :3]

    def __len__(self) -> int:
        return len(self.arrivals)


def check_stream(poses: Poses, profile: DeviceProfile, topic: str) -> list[ProbeCheck]:
    """Check rate, jitter, age, stamps and values of an arm at rest. Needs at least three poses."""
    return [
        _rate(poses, topic),
        _jitter(poses, topic),
        _age(poses, topic),
        _stamps(poses, topic),
        _values(poses, topic),
        _range(poses, profile, topic),
    ]


def _rate(poses: Poses, topic: str) -> ProbeCheck:
    span = poses.arrivals[-1] - poses.arrivals[0]
    rate = (len(poses) - 1) / max(span, 1e-9)
    measured = f'{rate:.0f} Hz'
    if rate >= MIN_RATE_HZ:
        return ProbeCheck('rate', 'ok', measured)
    return ProbeCheck(
        'rate',
        'wrong',
        measured,
        f'{topic} comes {rate:.0f} times a second, but the bridge wants {NOMINAL_RATE_HZ:g} Hz and '
        f'needs {MIN_RATE_HZ:g}: raise the rate of the driver',
    )


def _jitter(poses: Poses, topic: str) -> ProbeCheck:
    stamps = poses.stamps if (poses.stamps > 0).all() else poses.arrivals
    gaps = np.diff(stamps)
    measured = f'p99 {1e3 * np.percentile(gaps, 99):.2f} ms, longest gap {1e3 * gaps.max():.1f} ms'
    if gaps.max() <= MAX_GAP_S:
        return ProbeCheck('jitter', 'ok', measured)
    return ProbeCheck(
        'jitter',
        'wrong',
        measured,
        f'{topic} was silent for {1e3 * gaps.max():.0f} ms, and the bridge enters FAULT after '
        f'{1e3 * MAX_GAP_S:g}: give the driver real-time priority (chrt -f 20), or a quieter '
        'machine',
    )


def _age(poses: Poses, topic: str) -> ProbeCheck:
    valid = poses.stamps > 0
    if not valid.any():
        return ProbeCheck('age', 'unknown', '', f'no pose of {topic} has a stamp')
    age = float(np.median((poses.arrivals - poses.stamps)[valid]))
    measured = f'{1e3 * age:.2f} ms'
    if abs(age) <= MAX_AGE_S:
        return ProbeCheck('age', 'ok', measured)
    late = 'are old when they arrive' if age > 0 else 'come from the future'
    return ProbeCheck(
        'age',
        'wrong',
        f'{age:.3g} s',
        f'the poses of {topic} {late} by {abs(age):.3g} s: on two machines set both clocks alike '
        '(chrony, ptp4l); on one, find the queue that they wait in, or end what keeps it busy',
    )


def _stamps(poses: Poses, topic: str) -> ProbeCheck:
    invalid = int(np.sum(poses.stamps == 0))
    if invalid:
        return ProbeCheck(
            'stamps',
            'wrong',
            f'{invalid} of {len(poses)} are 0',
            f'{invalid} of {len(poses)} poses of {topic} have stamp 0, which marks them invalid: '
            'power on and home the device',
        )
    back = int(np.sum(np.diff(poses.stamps) <= 0))
    if back:
        return ProbeCheck(
            'stamps',
            'wrong',
            f'{back} not newer',
            f'{back} poses of {topic} are no newer than the one before: something repeats or '
            'reorders them, or there are two publishers',
        )
    return ProbeCheck('stamps', 'ok', 'each newer than the last')


def _values(poses: Poses, topic: str) -> ProbeCheck:
    if not np.isfinite(poses.values).all():
        return ProbeCheck('values', 'wrong', 'NaN', f'{topic} has poses that are not finite')
    off = float(np.abs(np.linalg.norm(poses.values[:, 3:], axis=1) - 1).max())
    if off > 0.01:
        return ProbeCheck(
            'values',
            'wrong',
            f'quaternion off by {off:.3g}',
            f'the orientation in {topic} is no unit quaternion (length off by {off:.3g}): order is '
            'x y z w',
        )
    return ProbeCheck('values', 'ok', 'finite, unit quaternions')


def _range(poses: Poses, profile: DeviceProfile, topic: str) -> ProbeCheck:
    farthest = float(np.nanmax(np.abs(poses.positions)))
    measured = f'up to {farthest:.3g} from the origin'
    if profile.workspace is None:
        return ProbeCheck(
            'range', 'unknown', measured, 'the profile does not say how far it reaches'
        )
    # Origins differ from device to device: only far outside is wrong.
    reach = 5 * math.hypot(*profile.workspace)
    if farthest <= reach:
        return ProbeCheck('range', 'ok', measured)
    return ProbeCheck(
        'range',
        'wrong',
        measured,
        f'{topic} is {farthest:.3g} away from its origin, but {profile.device or "the device"} '
        f'works in a box of {max(profile.workspace):g} m: it does not send metres '
        '(device.length_unit), or the profile is of another device',
    )


def find_move(times: np.ndarray, positions: np.ndarray, noise: float) -> np.ndarray | None:
    """Return the first move that ends at rest.

    Args:
        times: [s], shape (n,).
        positions: in any unit, shape (n, 3).
        noise: extent of the positions at rest, in that unit.

    Returns:
        The displacement, shape (3,); None as long as there is none.
    """
    if len(times) < 3 or times[-1] - times[0] < _REST:
        return None
    last = positions[times >= times[-1] - _REST]
    displacement = last.mean(axis=0) - positions[0]
    length = float(np.linalg.norm(displacement))
    if length < max(_BY_NOISE * noise, _MIN_MOVE) or extent(last) > _REST_SHARE * length:
        return None
    return displacement


def extent(positions: np.ndarray) -> float:
    """Return the diagonal of the box around positions, shape (n, 3), in their unit."""
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def check_moves(moves: Sequence[np.ndarray], topic: str) -> list[ProbeCheck]:
    """Check unit and handedness by the moves right, away and up, each of shape (3,)."""
    if len(moves) < len(DIRECTIONS):
        why = f'{len(moves)} of the {len(DIRECTIONS)} moves were seen in {topic}'
        return [
            ProbeCheck('unit', 'unknown', '', why),
            ProbeCheck('handedness', 'unknown', '', why),
        ]
    return [_unit(moves, topic), _handedness(moves, topic)]


def _unit(moves: Sequence[np.ndarray], topic: str) -> ProbeCheck:
    length = float(np.median([np.linalg.norm(move) for move in moves]))
    ratio = length / REQUESTED_MOVE_M
    unit = min(_UNITS, key=lambda name: abs(math.log(ratio / _UNITS[name])))
    measured = f'{length:.3g} {unit} a move'
    if unit == 'm':
        return ProbeCheck('unit', 'ok', measured)
    return ProbeCheck(
        'unit',
        'wrong',
        measured,
        f'{topic} moved by {length:.3g} where the hand moved by about {REQUESTED_MOVE_M:g} m: it '
        f'sends {unit}, so set device.length_unit: {unit}',
    )


def _handedness(moves: Sequence[np.ndarray], topic: str) -> ProbeCheck:
    directions = np.array([move / np.linalg.norm(move) for move in moves]).T
    volume = float(np.linalg.det(directions))
    measured = f'determinant {volume:+.2f}'
    if abs(volume) < _MIN_VOLUME:
        return ProbeCheck(
            'handedness', 'unknown', measured, 'the three moves were not at right angles: repeat'
        )
    if volume > 0:
        rotation = Rotation.align_vectors(np.eye(3), directions.T)[0].as_euler('xyz', degrees=True)
        rpy = ', '.join(f'{angle:.0f}' for angle in np.round(rotation) + 0.0)
        return ProbeCheck('handedness', 'ok', f'{measured}; turned by rpy {rpy} deg')
    return ProbeCheck(
        'handedness',
        'wrong',
        measured,
        f'the frame of {topic} is left-handed, a mirror image: no rotation mends that, so set '
        'device.mirrored_axis to the axis that has the wrong sign',
    )
