"""Figures of the cut behind the blade: severance, place and depth."""

import numpy as np

from bench.cuts.curves import SHAPES, Cut, circle, curved, four_lines, liver, organ_of, slab
from bench.cuts.severance import Severed, cut_mesh
from bench.cuts.severance import measure as measured
from bench.cuts.strokes import good_block
from bench.figures.figure import Figure
from cutting_trainer.cutting.cut_invariants import cut_face_area

_RATIOS = (2, 3, 4, 6)
"""Radii of circles, in edges."""
_CURVES = 6
"""Random strokes of each shape."""
_DEPTHS = (0.5, 1.0, 2.0, 4.0)
_DIRECTIONS = 6


def measure() -> list[Figure]:
    """Return the figures of lines 1 and 2."""
    plate, organ = slab(), liver()
    rngs = [np.random.default_rng(k) for k in (100, 101)]
    plugs = [measured(plate, circle(plate, ratio, rng)) for ratio in _RATIOS for rng in rngs]
    plugs += [measured(organ, circle(organ, ratio, rng)) for ratio in _RATIOS[:3] for rng in rngs]
    squares = [measured(plate, four_lines(plate, ratio, rngs[0])) for ratio in _RATIOS]
    small = slab((9, 9, 4))
    curves = [
        measured(small, curved(small, shape, np.random.default_rng(200 + k), through=k % 2 == 0))
        for shape in SHAPES
        for k in range(_CURVES)
    ]
    return [*_severed(plugs, squares, curves), *_opened()]


def _severed(plugs: list[Severed], squares: list[Severed], curves: list[Severed]) -> list[Figure]:
    runs = [*plugs, *squares, *curves]
    off = np.concatenate([run.distances for run in [*plugs, *curves]])
    count = len(curves)
    unsaid = sum(run.faces > 0 and not run.said for run in curves)
    said = sum(bool(run.said) for run in curves) / count
    errors = sum(bool(run.error) for run in runs)
    folds = sum(run.folds for run in plugs)
    rms = float(np.sqrt((off**2).mean()))
    free = np.mean([run.free for run in plugs])
    square = np.mean([run.free for run in squares])
    return [
        Figure(1, 'plugs of circles free', float(free), 1.0, 'at least', '', len(plugs)),
        Figure(1, 'squares of four lines free', float(square), 1.0, 'at least', '', len(squares)),
        Figure(1, 'false warnings in circles', folds, 0, 'at most', '', len(plugs)),
        Figure(1, 'bridges unsaid, random curves', unsaid, 0, 'at most', '', count),
        Figure(1, 'bridges said, random curves', said, 0.005, 'at most', '', count),
        Figure(1, 'broken invariants', errors, 0, 'at most', '', len(runs)),
        Figure(2, 'distance from the swept surface, rms', rms, 0.02, 'at most', 'h', len(off)),
        Figure(2, 'the same, largest', float(off.max()), 0.15, 'at most', 'h', len(off)),
    ]


def _opened() -> list[Figure]:
    block = organ_of('block', *good_block((8, 8, 6), 0.005, seed=0))
    found = []
    for depth in _DEPTHS:
        opened = swept = 0.0
        for angle in np.linspace(0.1, 3.0, _DIRECTIONS):
            along = np.array([np.cos(angle), np.sin(angle), 0.0])
            way = np.linspace(-0.035, 0.035, 60)[:, None] * along + block.middle
            path = np.stack([way, way], axis=1)
            high = block.nodes[:, 2].max()
            path[:, 0, 2], path[:, 1, 2] = high + 0.003, high - depth * block.h
            opened += cut_face_area(cut_mesh(block, Cut((path,)))[0])
            swept += depth * block.h * 0.04 / np.abs(along).max()
        name = f'opened over swept area, off 1, {depth:g} h deep, mean of directions'
        found.append(Figure(2, name, abs(opened / swept - 1), 0.05, 'at most', '', _DIRECTIONS))
    return found
