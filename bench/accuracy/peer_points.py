"""Figures of other packages for the chart, from the last kept run of `bench.accuracy.peers`.

Its beam is the cantilever of the chart, with the same load and reference.
"""

import json
from pathlib import Path
from typing import Any

from bench.accuracy.measure import Point

_RESULTS = Path(__file__).parents[1] / 'results'


def peer_points(problem: str, folder: Path = _RESULTS) -> dict[str, list[Point]]:
    """Return one curve for each other package: of its solver that is cheapest on the finest mesh on
    which one of its solvers has come to rest.

    Args:
        problem: name of the panel; there are curves for the cantilevers that the peers bend.
        folder: of kept runs.
    """
    runs = sorted(folder.glob('*-peers.json'))
    if not runs:
        return {}
    rows = json.loads(runs[-1].read_text(encoding='utf-8'))['rows']
    found: dict[str, dict[str, list[Point]]] = {}
    for row in rows:
        own = f'cantilever_{row["poissons_ratio"]:g}' == problem
        if own and row['package'] != 'the trainer' and row['sunk'] is not None:
            solvers = found.setdefault(row['package'], {})
            solvers.setdefault(row['solver'], []).append(_point(problem, row))
    return {
        f'{package}, {name}': line
        for package, solvers in found.items()
        for name, line in [min(solvers.items(), key=lambda item: _rank(item[1]))]
    }


def _point(problem: str, row: dict[str, Any]) -> Point:
    result = row['result']
    error = abs(row['sunk'] - 1.0)
    return Point(
        problem,
        row['package'],
        row['solver'],
        result['tetrahedra'],
        result['tetrahedra'],
        1e3 * result['dt'],
        round(1 / 30 / result['dt']),
        result['real_time'],
        error,
        abs(1 / row['sunk'] - 1.0),
    )


def _rank(line: list[Point]) -> tuple[int, float]:
    """Finest mesh first, then the least cost there."""
    finest = max(line, key=lambda p: p.tetrahedra)
    return -finest.tetrahedra, finest.cpu_per_second
