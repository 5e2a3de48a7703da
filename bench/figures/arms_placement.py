"""Guided set-up of devices that are turned at random: found as they are, or refused with a reason.

A device has encoder steps; its hand trembles, and sets the tip down beside each point by a little.
What follows the poses is what the command runs.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from bench.figures.figure import Figure
from cutting_trainer.haptic_bridge.devices.placement import (
    LIFT_M,
    Placement,
    PlacementError,
    check_lift,
    find_touch,
    place,
)
from cutting_trainer.haptic_bridge.devices.probe_pose import check_rotation

DEVICES = 100
ENCODER_M, TREMOR_M, PLACING_M = 2e-5, 1e-4, 1e-4
"""[m], at the hand: step of a position, amplitude of the tremor, and standard deviation of the tip
beside a point, along each axis."""
POINTS = np.array([[-0.05, -0.04, 0.0], [0.05, -0.04, 0.0], [0.05, 0.04, 0.0], [-0.05, 0.04, 0.0]])
"""[m] in the tissue: the corners of a liver's underside, about."""
_RATE_HZ, _MOVE_S, _HOLD_S = 1000.0, 0.5, 1.7
_SPOILT = ('in line', 'exchanged', 'mirrored', 'unsteady', 'too few', 'off the point')


class PlacedDevice:
    """A device somewhere, and a hand that does what is asked.

    Args:
        seed: of where it is, and of all noise.
        spoilt: one of `_SPOILT`, what the hand or the frame gets wrong; '': nothing.
    """

    def __init__(self, seed: int, spoilt: str = '') -> None:
        self._random = np.random.default_rng(seed)
        self.rotation = Rotation.random(random_state=seed).as_matrix()
        self.scale = float(self._random.uniform(0.5, 2.0))
        self.translation = self._random.uniform(-0.1, 0.1, 3)
        self._spoilt = spoilt
        self._at = np.zeros(3)

    def touch(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return times [s] and positions [m] of a hand that goes to a point and holds the tip."""
        where = (point - self.translation) @ self.rotation / self.scale
        where = where + PLACING_M * self._random.standard_normal(3)
        times = np.arange(0.0, _MOVE_S + _HOLD_S, 1.0 / _RATE_HZ)
        part = np.clip(times / _MOVE_S, 0.0, 1.0)[:, None]
        phase = self._random.uniform(0, 2 * np.pi, 3)
        size = TREMOR_M * (30.0 if self._spoilt == 'unsteady' else 1.0)
        tremor = size * np.sin(2 * np.pi * 8.0 * times[:, None] + phase)
        way = self._at + part**2 * (3 - 2 * part) * (where - self._at) + tremor
        self._at = where
        if self._spoilt == 'mirrored':
            way = way * [1.0, 1.0, -1.0]
        return times, ENCODER_M * np.round(way / ENCODER_M)

    def points(self) -> np.ndarray:
        """Return where the hand goes for the points that it was asked for [m], shape (n, 3)."""
        if self._spoilt == 'in line':
            return POINTS[0] + np.outer([0.0, 0.3, 0.6, 1.0], POINTS[1] - POINTS[0])
        if self._spoilt == 'exchanged':
            return POINTS[[1, 0, 2, 3]]
        if self._spoilt == 'off the point':
            return POINTS + np.outer([0.0, 0.0, 0.012, 0.0], [1.0, 0.0, 0.0])
        return POINTS[:2] if self._spoilt == 'too few' else POINTS

    def turns(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the quaternions before and after a quarter turn to the left, shape (4,)."""
        mirror = np.diag([1.0, 1.0, -1.0 if self._spoilt == 'mirrored' else 1.0])
        turn = Rotation.from_rotvec([0.0, 0.0, math.pi / 2]).as_matrix()
        held = Rotation.random(random_state=self._random.integers(1 << 31)).as_matrix()
        to_base = self.rotation.T
        before, after = (
            Rotation.from_matrix(mirror @ to_base @ tool @ mirror).as_quat()
            for tool in (held, turn @ held)
        )
        return before, after


def set_up(device: PlacedDevice) -> Placement:
    """Return the placement by what a hand does.

    Raises:
        PlacementError: it does not say.
    """
    touched = []
    for point in device.points():
        found = find_touch(*device.touch(point), metres=1.0)
        if found is None:
            raise PlacementError('the tip was not held still')
        touched.append(found)
    placed = place(np.array(touched), POINTS[: len(touched)])
    above = find_touch(*device.touch(device.points()[-1] + [0.0, 0.0, LIFT_M]), metres=1.0)
    if above is None:
        raise PlacementError('the tip was not held still')
    check_lift(placed, above - touched[-1])
    turned = check_rotation(*device.turns(), placed.rotation[2], 'cp')
    if turned.verdict != 'ok':
        raise PlacementError(turned.sentence)
    return placed


def measure(devices: int = DEVICES) -> list[Figure]:
    """Return the figures of a number of devices."""
    worst = {'rotation': 0.0, 'scale': 0.0, 'translation': 0.0}
    bounds = {'rotation': (1.0, 'deg'), 'scale': (0.01, ''), 'translation': (1.0, 'mm')}
    found = 0
    for seed in range(devices):
        device = PlacedDevice(seed)
        try:
            placed = set_up(device)
        except PlacementError:
            continue
        off = Rotation.from_matrix(placed.rotation @ device.rotation.T).magnitude()
        errors = {
            'rotation': math.degrees(off),
            'scale': abs(placed.scale / device.scale - 1.0),
            'translation': 1e3 * float(np.linalg.norm(placed.translation - device.translation)),
        }
        worst = {name: max(worst[name], errors[name]) for name in worst}
        found += all(errors[name] <= bound for name, (bound, _) in bounds.items())
    rest = [
        Figure(4, f'worst error of the {name}', worst[name], bound, 'at most', unit, devices)
        for name, (bound, unit) in bounds.items()
    ]
    name = 'devices at random found within 1 degree, 1 % and 1 mm'
    return [
        Figure(4, name, found, devices, 'at least', '', devices),
        *rest,
        _refused(devices // 10),
    ]


def _refused(each: int) -> Figure:
    """Return the number of set-ups that are wrong and not refused."""
    taken = 0
    for number, spoilt in enumerate(_SPOILT):
        for seed in range(each):
            try:
                set_up(PlacedDevice(1000 + each * number + seed, spoilt))
            except PlacementError:
                continue
            taken += 1
    total = each * len(_SPOILT)
    return Figure(4, 'wrong set-ups that were taken', taken, 0.0, 'at most', '', total)
