"""Checks of the force of a connected arm by small pushes: sign, axes, gain, and release.

A force f deflects a hand that holds the arm by C f, C symmetric and positive: it is a passive
spring, softer in one direction than in another. Where the device rotates the force by U, the tip
moves by C U f, and U is the orthogonal factor of the polar decomposition of C U, for any C.

Limitations: the deflection of a hand measures no newtons, so the gain rests on the device's own
`measured_cf`; one that only repeats the commanded force there hides a wrong gain.
"""

import math

import numpy as np

from cutting_trainer.haptic_bridge.devices.probe_stream import PUSH_FORCE_N, ProbeCheck

MIN_DEFLECTION_M = 2e-4
"""[m] Deflection of a hand that holds the arm loosely under `PUSH_FORCE_N`."""
MAX_ROTATION_DEG = 12.0
"""[deg] Rotation up to which a force counts as right; one of 15 is beyond it, with its noise."""
MAX_UNCERTAINTY_DEG = 5.0
"""[deg] Uncertainty above which the direction is not judged."""
GAIN_RANGE = (0.8, 1.25)
"""Range of the right ratio of measured to commanded force."""
RELEASE_TIMEOUT_S = 0.2
"""[s] after the last command in which a driver must release, and the hand come back."""
RELEASED_SHARE = 0.5
"""Share of the deflection below which a tip counts as released."""
_AVERAGING_S = 0.2
"""[s] over which the position of a tip is averaged."""
_OFF = 1e-3


def check_push(
    forces: np.ndarray, yields: np.ndarray, topic: str, tool: np.ndarray | None = None
) -> list[ProbeCheck]:
    """Check sign and direction of the force.

    Args:
        forces: sent [N], axes of the device base, shape (n, 3).
        yields: deflections of the tip under each [m], shape (n, 3).
        topic: that they were sent on.
        tool: orientation of the tool meanwhile, shape (3, 3).
    """
    response = np.linalg.lstsq(forces, yields, rcond=None)[0].T
    largest = float(np.linalg.norm(yields, axis=1).max())
    along = np.array([f @ y / np.linalg.norm(f) for f, y in zip(forces, yields, strict=True)])
    measured = f'{1e3 * float(np.mean(along)):+.2f} mm along {PUSH_FORCE_N:g} N'
    if largest < MIN_DEFLECTION_M:
        why = (
            f'nothing moved under {PUSH_FORCE_N:g} N on {topic}: is the device enabled, the topic '
            'right, the arm held loosely?'
        )
        return [ProbeCheck('force', 'unknown', measured, why)]
    left, _, right = np.linalg.svd(response)
    rotation = left @ right
    doubt = direction_uncertainty(forces, yields)
    if doubt > MAX_UNCERTAINTY_DEG:
        why = (
            f'the hand moved by itself: the direction of the force on {topic} is known to '
            f'{doubt:.0f} degrees only; hold the arm loosely and still, and push again'
        )
        return [ProbeCheck('force', 'unknown', measured, why)]
    angle = _degrees(rotation if np.linalg.det(rotation) > 0 else -rotation)
    sentence = _wrong(rotation, angle, tool, topic)
    turned = f'turned by {angle:.0f} deg (+-{doubt:.0f})'
    verdict = ProbeCheck('force', 'wrong' if sentence else 'ok', f'{measured}; {turned}', sentence)
    return [verdict]


def direction_uncertainty(forces: np.ndarray, yields: np.ndarray) -> float:
    """Return three standard deviations of the direction [deg], from the residuals of the fit.

    The fit is that of `check_push`.

    Args:
        forces: sent [N], shape (n, 3).
        yields: deflections of the tip under each [m], shape (n, 3).
    """
    response = np.linalg.lstsq(forces, yields, rcond=None)[0].T
    softest = float(np.linalg.svd(response, compute_uv=False)[-1])
    left_over = yields - forces @ response.T
    freedom = max(left_over.size - response.size, 1)
    deviation = math.sqrt(float(np.sum(left_over**2)) / freedom)
    along_axis = math.sqrt(float(np.sum(forces**2)) / 3)
    return min(math.degrees(3 * deviation / max(along_axis * softest, 1e-12)), 180.0)


def _degrees(rotation: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))


def _wrong(rotation: np.ndarray, angle: float, tool: np.ndarray | None, topic: str) -> str:
    """Return the fault of a force rotated by `rotation`, shape (3, 3); '' where there is none."""
    other_way = f'the force on {topic} acts the other way round, towards the tissue'
    mirrored = np.linalg.det(rotation) < 0
    signs = np.sign(np.diag(rotation))
    along_axes = (np.abs(np.diag(rotation)) > math.cos(math.radians(MAX_ROTATION_DEG))).all()
    if along_axes and (signs > 0).all():
        return ''
    if along_axes and (signs < 0).all():
        return f'{other_way}: set device.force_sign: -1'
    if along_axes:
        axes = ', '.join(axis for axis, sign in zip('xyz', signs, strict=True) if sign < 0)
        return f'{other_way}: only along {axes}, as in a frame that is mirrored for the force alone'
    for sense, text in ((tool, 'in the axes of the tool'), (_inverse(tool), 'turned back by it')):
        if sense is not None and not mirrored and _degrees(rotation @ sense.T) < MAX_ROTATION_DEG:
            return (
                f'the force on {topic} rotates with the tool ({text}), by {angle:.0f} degrees as '
                'it stands: set device.force_frame: body, or have the driver take base axes'
            )
    column = int(np.argmax(angle_of_axes := 1 - np.abs(np.diag(rotation))))
    moved = int(np.argmax(np.abs(rotation[:, column])))
    if moved != column and angle_of_axes[column] > _OFF:
        axes = f'a push along {"xyz"[column]} moved the tip along {"xyz"[moved]}'
    else:
        axes = 'a push and its answer are not in line'
    kind = 'mirrored and rotated' if mirrored else 'rotated'
    return (
        f'the force on {topic} is {kind} by {angle:.0f} degrees against the poses ({axes}): force '
        'and pose are in different frames (a base frame set for one of them? device.force_frame?)'
    )


def _inverse(rotation: np.ndarray | None) -> np.ndarray | None:
    return None if rotation is None else rotation.T


def check_gain(forces: np.ndarray, felt: np.ndarray, topic: str) -> list[ProbeCheck]:
    """Check the gain of the force, by the device's own measurement.

    Args:
        forces: sent [N], shape (n, 3).
        felt: `measured_cf` under each less that before it [N], shape (n, 3); NaN: not published.
        topic: of `measured_cf`.
    """
    if not np.isfinite(felt).all():
        why = (
            f'{topic} is not published, and the deflection of a hand measures no newtons: push '
            f'against a kitchen scale, {PUSH_FORCE_N:g} N are {1e3 * PUSH_FORCE_N / 9.81:.0f} g'
        )
        return [ProbeCheck('gain', 'unknown', '', why)]
    norms = np.linalg.norm(felt, axis=1) / np.linalg.norm(forces, axis=1)
    gain = float(np.median(norms))
    measured = f'{gain:.2f}, by {topic}'
    if gain < 0.02:
        why = f'{topic} stays at zero under {PUSH_FORCE_N:g} N: the device does not measure'
        return [ProbeCheck('gain', 'unknown', measured, why)]
    if GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
        return [ProbeCheck('gain', 'ok', measured)]
    return [
        ProbeCheck(
            'gain',
            'wrong',
            measured,
            f'{PUSH_FORCE_N:g} N commanded were {PUSH_FORCE_N * gain:.2g} N by {topic}: the driver '
            f'scales the force by {gain:.2g}, and every limit of the profile with it; take its '
            'scale out (or it measures wrongly: look at a kitchen scale)',
        )
    ]


def check_release(
    times: np.ndarray, along: np.ndarray, deflection: float, felt: np.ndarray, topic: str
) -> list[ProbeCheck]:
    """Check that the driver releases the force when commands stop.

    Args:
        times: since the last command [s], shape (n,).
        along: remaining deflection along the push [m], shape (n,).
        deflection: of the tip under the push [m].
        felt: share of the push that `measured_cf` still has at the end; NaN: not known.
        topic: of the force.
    """
    holds = f'commands on {topic} stopped, and the last force stayed on'
    remedy = (
        'put an adapter between that sends zero 30 ms after the last command; without it a bridge '
        'that dies leaves its force on the hand'
    )
    share = float(np.median(felt)) if len(felt) else math.nan
    if math.isfinite(share) and abs(share) > RELEASED_SHARE:
        measured = f'{100 * share:.0f} % of the force still on, by measured_cf'
        return [ProbeCheck('release', 'wrong', measured, f'{holds}: {remedy}')]
    if deflection < MIN_DEFLECTION_M or not len(times):
        why = f'the tip gave way by {1e3 * deflection:.2f} mm only, too little to see it come back'
        return [ProbeCheck('release', 'unknown', '', f'{why}: hold the arm loosely')]
    # By means: the tremor of a hand passes any threshold for a moment.
    if float(along[times > times[-1] - _AVERAGING_S].mean()) > RELEASED_SHARE * deflection:
        measured = f'not within {times[-1]:.1f} s, by the tip'
        return [
            ProbeCheck('release', 'wrong', measured, f'{holds} for {times[-1]:.1f} s: {remedy}')
        ]
    away = [
        along[(times > t - _AVERAGING_S / 2) & (times <= t)].mean() > RELEASED_SHARE * deflection
        for t in times
    ]
    back = float(times[np.argmin(away)])
    measured = f'back after {1e3 * back:.0f} ms, by the tip'
    if back <= RELEASE_TIMEOUT_S:
        return [ProbeCheck('release', 'ok', measured)]
    return [ProbeCheck('release', 'wrong', measured, f'{holds} for {back:.2f} s: {remedy}')]
