"""Force of a blade that slices and withdraws at random: `python -m bench.haptics.random_cuts`.

Each stroke goes through the force path over a tissue at 30 Hz, and over one at 1 kHz.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from bench.haptics.accuracy import APPROACH_TIME_S, Bench
from cutting_trainer.session.in_process import TICK_S
from cutting_trainer.session.scene_loader import load_scene

Floats = NDArray[np.float64]

SCENE = 'liver'
FIRST_SEED = 4000
LASTS = 4
"""Ticks in a row that count: more than 3 ms."""
_ENTRY = round(0.15 / TICK_S)
"""Ticks around the entry."""
_ASKEW = 0.5
"""Largest angle between the stroke and the edge, which faces along x [rad]."""
_FELT = 0.02
"""Share of the peak below which nothing is felt."""
_BREAKS_IN = 0.5
"""Share of the entry force to which the force falls as the blade goes in."""


@dataclass(frozen=True)
class Errors:
    """Errors of a stroke, as shares of the peak at 1 kHz.

    Attributes:
        seed: of the stroke.
        peak: force at 1 kHz [N].
        p95: 95th percentile.
        worst: largest that lasts more than 3 ms.
        hole: largest deficit that lasts more than 3 ms, within 0.15 s of the entry.
        tail: way of the tip after the last force at 1 kHz while force is felt [m].
    """

    seed: int
    peak: float
    p95: float
    worst: float
    hole: float
    tail: float


def stroke_path(bench: Bench, seed: int) -> Floats:
    """Return tips of a random stroke by tick [m], shape (k, 3)."""
    random = np.random.default_rng(seed)
    place = random.uniform((-0.022, -0.010), (0.010, 0.012))
    depth, reach = random.uniform(0.010, 0.016), random.uniform(0.008, 0.020)
    angle = random.uniform(-_ASKEW, _ASKEW)
    ends = np.cumsum([0.0, *random.uniform((0.4, 0.3, 0.3), (0.8, 0.6, 0.6))])
    t = np.arange(round((APPROACH_TIME_S + ends[-1]) / TICK_S)) * TICK_S - APPROACH_TIME_S
    times = [-APPROACH_TIME_S, *ends]
    height = np.interp(t, times, [0.004, 0.0, -depth, -depth, 0.015])
    along = np.interp(t, ends[1:3], [0.0, reach])
    top = bench.touch_height(place)
    way = np.array([np.cos(angle), np.sin(angle)])
    return np.column_stack([place + along[:, None] * way, top + height])


def lasting(errors: Floats) -> float:
    """Return the largest error that lasts more than 3 ms; errors by tick, shape (k,)."""
    windows = np.lib.stride_tricks.sliding_window_view(errors, LASTS)
    return float(windows.min(axis=1).max(initial=0.0))


def errors_of(seed: int) -> Errors:
    """Return the errors of a random stroke."""
    bench = Bench(load_scene(SCENE))
    path = stroke_path(bench, seed)
    true, felt = bench.reference(path, cuts=True), bench.rendered(path, cuts=True)
    sizes, own = np.linalg.norm(true, axis=1), np.linalg.norm(felt, axis=1)
    peak = float(sizes.max())
    skip = round(APPROACH_TIME_S / TICK_S)
    off = np.linalg.norm(felt - true, axis=1)[skip:] / peak
    falls = np.flatnonzero(sizes[1:] < _BREAKS_IN * sizes[:-1])
    entry = int(falls[0]) if len(falls) else 0
    missing = (sizes - own)[max(entry - _ENTRY, 0) : entry + _ENTRY] / peak
    last = int(np.flatnonzero(sizes > _FELT * peak)[-1])
    still = last + np.flatnonzero(own[last:] > _FELT * peak)
    tail = float(np.linalg.norm(path[still] - path[last], axis=1).max(initial=0.0))
    return Errors(seed, peak, float(np.percentile(off, 95)), lasting(off), lasting(missing), tail)


def main() -> None:
    """Print the errors of each stroke, and how many are within the bounds."""
    parser = argparse.ArgumentParser(prog='bench.haptics.random_cuts', description=__doc__)
    parser.add_argument('-n', type=int, default=64, help='strokes (default: 64)')
    parser.add_argument('--processes', type=int, default=2)
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.n)
    found = []
    with ProcessPoolExecutor(options.processes, get_context('spawn')) as pool:
        for errors in pool.map(errors_of, seeds):
            found.append(errors)
            print(json.dumps(asdict(errors)), flush=True)
    for name, bound in (('p95', 0.08), ('worst', 0.2), ('hole', 0.2), ('tail', 0.005)):
        values = np.array([getattr(errors, name) for errors in found])
        print(
            f'{name}: median {np.median(values):.3g}, largest {values.max():.3g}, '
            f'{(values <= bound).sum()} of {len(values)} within {bound}'
        )


if __name__ == '__main__':
    main()
