"""What the samples of a connected arm say about it: rate, jitter, stamps, unit, handedness, sign of
the force.

Limitations: unit and handedness are told from three moves that somebody makes as asked, so they
tell metres from millimetres and left from right, not metres from feet.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from haptic_bridge.settings import DeviceProfile

NOMINAL_RATE, LOWEST_RATE = 1000.0, 500.0
"""[Hz] that the bridge wants, and below which its force lags visibly behind the hand."""
LONGEST_GAP = 0.02
"""[s] after which the bridge takes the device for silent (`haptics.device_timeout`)."""
OLDEST = 0.02
"""[s] that a pose may be old when it arrives; more is another clock, or a queue."""
ASKED_MOVE = 0.05
"""[m] that whoever holds the arm is asked to move it."""
DIRECTIONS = ('to your right', 'away from you', 'up')
"""Of the three moves, an order in which a right-handed frame has a positive determinant."""
PUSH = 0.3
"""[N] with which the sign of the force is tried."""
LEAST_YIELD = 2e-4
"""[m] by which a hand that holds the arm loosely gives way to `PUSH`."""
_UNITS = {'m': 1.0, 'dm': 10.0, 'cm': 100.0, 'mm': 1000.0}
_LEAST_VOLUME = 0.3
_BY_NOISE, _LEAST_MOVE = 15.0, 0.005
_REST, _REST_SHARE = 0.6, 0.1

Verdict = Literal['ok', 'wrong', 'unknown']


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: of it.
        verdict: ok, wrong, or unknown where it could not be measured.
        measured: in a few words.
        sentence: what is wrong and what to do, or why it is unknown; '' if ok.
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
        """As sent, shape (n, 3)."""
        return self.values[:, :3]

    def __len__(self) -> int:
        return len(self.arrivals)


def check_stream(poses: Poses, profile: DeviceProfile, topic: str) -> list[Check]:
    """Rate, jitter, age, stamps and values of an arm at rest. Needs three poses at least."""
    return [
        _rate(poses, topic),
        _jitter(poses, topic),
        _age(poses, topic),
        _stamps(poses, topic),
        _values(poses, topic),
        _range(poses, profile, topic),
    ]


def _rate(poses: Poses, topic: str) -> Check:
    span = poses.arrivals[-1] - poses.arrivals[0]
    rate = (len(poses) - 1) / max(span, 1e-9)
    measured = f'{rate:.0f} Hz'
    if rate >= LOWEST_RATE:
        return Check('rate', 'ok', measured)
    return Check(
        'rate',
        'wrong',
        measured,
        f'{topic} comes {rate:.0f} times a second, but the bridge wants {NOMINAL_RATE:g} Hz and '
        f'needs {LOWEST_RATE:g}: raise the rate of the driver',
    )


def _jitter(poses: Poses, topic: str) -> Check:
    stamps = poses.stamps if (poses.stamps > 0).all() else poses.arrivals
    gaps = np.diff(stamps)
    measured = f'p99 {1e3 * np.percentile(gaps, 99):.2f} ms, longest gap {1e3 * gaps.max():.1f} ms'
    if gaps.max() <= LONGEST_GAP:
        return Check('jitter', 'ok', measured)
    return Check(
        'jitter',
        'wrong',
        measured,
        f'{topic} was silent for {1e3 * gaps.max():.0f} ms, and the bridge enters FAULT after '
        f'{1e3 * LONGEST_GAP:g}: give the driver a real-time priority or a quieter machine',
    )


def _age(poses: Poses, topic: str) -> Check:
    valid = poses.stamps > 0
    if not valid.any():
        return Check('age', 'unknown', '', f'no pose of {topic} has a stamp')
    age = float(np.median((poses.arrivals - poses.stamps)[valid]))
    measured = f'{1e3 * age:.2f} ms'
    if abs(age) <= OLDEST:
        return Check('age', 'ok', measured)
    late = 'are old when they arrive' if age > 0 else 'come from the future'
    return Check(
        'age',
        'wrong',
        f'{age:.3g} s',
        f'the poses of {topic} {late} by {abs(age):.3g} s: set both clocks alike (chrony, ptp4l), '
        'or find the queue that they wait in',
    )


def _stamps(poses: Poses, topic: str) -> Check:
    invalid = int(np.sum(poses.stamps == 0))
    if invalid:
        return Check(
            'stamps',
            'wrong',
            f'{invalid} of {len(poses)} are 0',
            f'{invalid} of {len(poses)} poses of {topic} have stamp 0, which marks them invalid: '
            'power on and home the device',
        )
    back = int(np.sum(np.diff(poses.stamps) <= 0))
    if back:
        return Check(
            'stamps',
            'wrong',
            f'{back} not newer',
            f'{back} poses of {topic} are no newer than the one before: something repeats or '
            'reorders them, or there are two publishers',
        )
    return Check('stamps', 'ok', 'each newer than the last')


def _values(poses: Poses, topic: str) -> Check:
    if not np.isfinite(poses.values).all():
        return Check('values', 'wrong', 'NaN', f'{topic} has poses that are not finite')
    off = float(np.abs(np.linalg.norm(poses.values[:, 3:], axis=1) - 1).max())
    if off > 0.01:
        return Check(
            'values',
            'wrong',
            f'quaternion off by {off:.3g}',
            f'the orientation in {topic} is no unit quaternion (length off by {off:.3g}): order is '
            'x y z w',
        )
    return Check('values', 'ok', 'finite, unit quaternions')


def _range(poses: Poses, profile: DeviceProfile, topic: str) -> Check:
    farthest = float(np.nanmax(np.abs(poses.positions)))
    measured = f'up to {farthest:.3g} from the origin'
    if profile.workspace is None:
        return Check('range', 'unknown', measured, 'the profile does not say how far it reaches')
    # Origins differ from device to device: only far outside is wrong.
    reach = 5 * math.hypot(*profile.workspace)
    if farthest <= reach:
        return Check('range', 'ok', measured)
    return Check(
        'range',
        'wrong',
        measured,
        f'{topic} is {farthest:.3g} away from its origin, but {profile.device or "the device"} '
        f'works in a box of {max(profile.workspace):g} m: it does not send metres '
        '(device.length_unit), or the profile is of another device',
    )


def find_move(times: np.ndarray, positions: np.ndarray, noise: float) -> np.ndarray | None:
    """The first move that ends at rest.

    Args:
        times: [s], shape (n,).
        positions: in whatever unit, shape (n, 3).
        noise: extent of the positions at rest, in that unit.

    Returns:
        The displacement, shape (3,); None as long as there is none.
    """
    if len(times) < 3 or times[-1] - times[0] < _REST:
        return None
    last = positions[times >= times[-1] - _REST]
    displacement = last.mean(axis=0) - positions[0]
    length = float(np.linalg.norm(displacement))
    if length < max(_BY_NOISE * noise, _LEAST_MOVE) or extent(last) > _REST_SHARE * length:
        return None
    return displacement


def extent(positions: np.ndarray) -> float:
    """Diagonal of the box around positions, shape (n, 3), in their unit."""
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def check_moves(moves: Sequence[np.ndarray], topic: str) -> list[Check]:
    """Unit and handedness from the moves right, away and up, each of shape (3,)."""
    if len(moves) < len(DIRECTIONS):
        why = f'{len(moves)} of the {len(DIRECTIONS)} moves were seen in {topic}'
        return [Check('unit', 'unknown', '', why), Check('handedness', 'unknown', '', why)]
    return [_unit(moves, topic), _handedness(moves, topic)]


def _unit(moves: Sequence[np.ndarray], topic: str) -> Check:
    length = float(np.median([np.linalg.norm(move) for move in moves]))
    ratio = length / ASKED_MOVE
    unit = min(_UNITS, key=lambda name: abs(math.log(ratio / _UNITS[name])))
    measured = f'{length:.3g} {unit} a move'
    if unit == 'm':
        return Check('unit', 'ok', measured)
    return Check(
        'unit',
        'wrong',
        measured,
        f'{topic} moved by {length:.3g} where the hand moved by about {ASKED_MOVE:g} m: it sends '
        f'{unit}, so set device.length_unit: {unit}',
    )


def _handedness(moves: Sequence[np.ndarray], topic: str) -> Check:
    directions = np.array([move / np.linalg.norm(move) for move in moves]).T
    volume = float(np.linalg.det(directions))
    measured = f'determinant {volume:+.2f}'
    if abs(volume) < _LEAST_VOLUME:
        return Check(
            'handedness', 'unknown', measured, 'the three moves were not at right angles: repeat'
        )
    if volume > 0:
        turn = Rotation.align_vectors(np.eye(3), directions.T)[0].as_euler('xyz', degrees=True)
        rpy = ', '.join(f'{angle:.0f}' for angle in np.round(turn) + 0.0)
        return Check('handedness', 'ok', f'{measured}; turned by rpy {rpy} deg')
    return Check(
        'handedness',
        'wrong',
        measured,
        f'the frame of {topic} is left-handed, a mirror image: no rotation mends that, so set '
        'device.mirrored_axis to the axis that has the wrong sign',
    )


def check_push(forces: np.ndarray, yields: np.ndarray, topic: str) -> list[Check]:
    """Sign and axes of the force.

    Args:
        forces: sent [N], axes of the device base, shape (n, 3).
        yields: by how much the tip gave way to each [m], shape (n, 3).
        topic: that they were sent on.
    """
    compliance = np.linalg.lstsq(forces, yields, rcond=None)[0].T
    largest = float(np.linalg.norm(yields, axis=1).max())
    along = np.array([f @ y / np.linalg.norm(f) for f, y in zip(forces, yields, strict=True)])
    measured = f'{1e3 * float(np.mean(along)):+.2f} mm along {PUSH:g} N'
    if largest < LEAST_YIELD:
        return [
            Check(
                'force',
                'unknown',
                measured,
                f'nothing moved under {PUSH:g} N on {topic}: is the device enabled, the topic '
                'right, the arm held loosely?',
            )
        ]
    axes = _swapped_axes(compliance)
    if axes:
        return [
            Check(
                'force',
                'wrong',
                measured,
                f'a push along {axes[0]} on {topic} moved the tip along {axes[1]}: force and pose '
                'are in different frames (device.force_frame: body?)',
            )
        ]
    signs = np.sign(np.diag(compliance))
    if (signs > 0).all():
        return [Check('force', 'ok', measured)]
    if (signs < 0).all():
        remedy = 'set device.force_sign: -1'
    else:
        wrong = ', '.join(axis for axis, sign in zip('xyz', signs, strict=True) if sign < 0)
        remedy = f'only along {wrong}, as in a frame that is mirrored for the force alone'
    return [
        Check(
            'force',
            'wrong',
            measured,
            f'the force on {topic} acts the other way round, towards the tissue: {remedy}',
        )
    ]


def _swapped_axes(compliance: np.ndarray) -> tuple[str, str] | None:
    """Which axis of the force moves another one most, if any does."""
    for force_axis, moved_axis in itertools.permutations(range(3), 2):
        column = np.abs(compliance[:, force_axis])
        if column[moved_axis] > 2 * column[force_axis] and column[moved_axis] == column.max():
            return 'xyz'[force_axis], 'xyz'[moved_axis]
    return None
