"""Jerk, tremor and rest of a motion; path and economy are in `metrics.py`."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

Floats = NDArray[np.float64]

RATE_HZ = 100.0
"""[Hz] to which motions are resampled."""
_CUTOFF_HZ = 10.0
"""[Hz] of the low-pass before differences: voluntary motion lies below."""
TREMOR_BAND_HZ = (8.0, 12.0)
IDLE_SPEED_M_S = 0.001
"""[m/s] below which a hand rests."""
_MIN_SAMPLES = 32
"""Samples below which there is no motion to measure."""


def resampled(times: Floats, positions: Floats) -> Floats:
    """Return positions at the rate of this module, by linear interpolation [m], shape (k, 3).

    Args:
        times: ascending [s], shape (n,).
        positions: [m], shape (n, 3).
    """
    if not len(times):
        return np.zeros((0, 3))
    at = times[0] + np.arange(int((times[-1] - times[0]) * RATE_HZ + 1e-6) + 1) / RATE_HZ
    return np.column_stack([np.interp(at, times, positions[:, axis]) for axis in range(3)])


def smoothed(path: Floats) -> Floats:
    """Return a path after a Butterworth low-pass of second order, forward and back [m]."""
    if len(path) < _MIN_SAMPLES:
        return path
    low = signal.butter(2, _CUTOFF_HZ, fs=RATE_HZ, output='sos')
    return np.asarray(signal.sosfiltfilt(low, path, axis=0))


def log_dimensionless_jerk(path: Floats) -> float:
    """Return -ln(T^3 / v^2 * integral of squared jerk), v the peak speed; NaN without motion.

    Of the magnitude of jerk, as Balasubramanian et al., On the analysis of movement smoothness, J.
    NeuroEng. Rehabil. 12:112 (2015), table 3, propose for positions. It is -ln(204.8) = -5.32 for a
    motion of minimum jerk, and lower if less smooth.

    Args:
        path: at the rate of this module [m], shape (k, 3).
    """
    if len(path) < _MIN_SAMPLES:
        return float('nan')
    velocity = np.gradient(path, 1 / RATE_HZ, axis=0)
    jerk = np.gradient(np.gradient(velocity, 1 / RATE_HZ, axis=0), 1 / RATE_HZ, axis=0)
    peak = np.sqrt((velocity**2).sum(axis=1).max())
    integral = (jerk**2).sum() / RATE_HZ
    duration = (len(path) - 1) / RATE_HZ
    if peak < 1e-6 or integral <= 0:
        return float('nan')
    return float(-np.log(duration**3 / peak**2 * integral))


def tremor(path: Floats) -> float:
    """Return the root mean square of the displacement at 8 to 12 Hz [m]; 0 without motion.

    It is the root of the power in that band of Welch's spectrum of the velocity, divided by the
    square of the angular frequency, over the three axes.

    Args:
        path: at the rate of this module [m], shape (k, 3).
    """
    if len(path) <= int(RATE_HZ):
        return 0.0
    velocity = np.diff(path, axis=0) * RATE_HZ
    frequency, power = signal.welch(velocity, RATE_HZ, nperseg=int(RATE_HZ), axis=0)
    band = (frequency >= TREMOR_BAND_HZ[0]) & (frequency <= TREMOR_BAND_HZ[1])
    # A difference over one period has the gain 2 sin(w / 2 f) f, not w.
    gain = 2 * RATE_HZ * np.sin(np.pi * frequency[band] / RATE_HZ)
    width = frequency[1] - frequency[0]
    return float(np.sqrt((power[band] / gain[:, None] ** 2).sum() * width))


def idle_share(path: Floats) -> float:
    """Return the share of time in which the hand rests.

    Args:
        path: at the rate of this module [m], shape (k, 3).
    """
    speeds = np.linalg.norm(np.diff(path, axis=0), axis=1) * RATE_HZ
    return float((speeds < IDLE_SPEED_M_S).mean()) if len(speeds) else 0.0


def holds(
    times: Floats, positions: Floats, pressed: NDArray[np.bool_], seconds: float, radius: float
) -> Floats:
    """Return the places where the tip pressed and held still [m], shape (h, 3).

    Args:
        times: [s], shape (n,), at an even rate.
        positions: of the tip [m], shape (n, 3).
        pressed: whether it presses hard enough, shape (n,).
        seconds: duration of a hold [s].
        radius: half of the largest extent along each axis during a hold [m].
    """
    if len(times) < 2:
        return np.zeros((0, 3))
    count = max(int(np.ceil(seconds * (len(times) - 1) / (times[-1] - times[0]))), 2)
    if len(times) < count:
        return np.zeros((0, 3))
    windows = np.lib.stride_tricks.sliding_window_view(positions, count, axis=0)
    high, low, least = (
        of(values, count, axis=0, origin=-(count // 2))[: len(windows)]
        for of, values in (
            (ndimage.maximum_filter1d, positions),
            (ndimage.minimum_filter1d, positions),
            (ndimage.minimum_filter1d, pressed.astype(np.uint8)),
        )
    )
    still, firm = (high - low <= 2 * radius).all(axis=1), least > 0
    # A hold goes on until the tip is released: it is one mark, at its first place.
    found = np.flatnonzero(still & firm)
    if not len(found):
        return np.zeros((0, 3))
    release = np.cumsum(~pressed)
    _, first = np.unique(release[found], return_index=True)
    return np.asarray(windows[found[first]].mean(axis=2))
