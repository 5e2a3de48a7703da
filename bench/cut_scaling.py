"""Cost of one and the same stroke in meshes of 2,000 to 200,000 tetrahedra.

Run `python -m bench.cut_scaling`; times are processor times. The block grows away from the corner
that is cut; where blocks overlap they are the same: the stroke meets the same elements.
"""

import argparse
import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from rich.console import Console
from rich.table import Table

from cutting.methods import make_method
from cutting.settings import CuttingSettings
from session.compare_cuts import good_block, rk4_milliseconds
from tissue_sim.blade import Resistance, Sweep
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.simulation import TissueSimulation

CELL = 0.005
BLOCKS = {'2,000': (7, 6, 4), '20,000': (12, 12, 12), '200,000': (26, 26, 25)}
_MATERIAL = Material(3500.0, 0.45, 1060.0)


@dataclass(frozen=True)
class Costs:
    """What the steps of a stroke took.

    Attributes:
        advance: of the cutting method, by step [ms], shape (k,).
        apply: of mesh, tensors, masses and frequency bound, by step; 0 without a batch [ms], (k,).
        cut: tetrahedra taken out or replaced, by step, shape (k,).
    """

    advance: np.ndarray
    apply: np.ndarray
    cut: np.ndarray

    @property
    def batch(self) -> np.ndarray:
        """Cost of the steps that changed the mesh [ms], after the first contact."""
        return (self.advance + self.apply)[1:][self.cut[1:] > 0]


def stroke_costs(cells: tuple[int, int, int], repeats: int = 5) -> Costs:
    """Draws the blade through the corner of a block; each step is the fastest of some runs."""
    nodes, tetrahedra = good_block(cells, CELL, seed=-1)
    runs = [_run(nodes, tetrahedra) for _ in range(repeats)]
    advance, apply = (np.min([run[i] for run in runs], axis=0) for i in (0, 1))
    return Costs(advance, apply, runs[0][2])


def _run(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    fixed = nodes[:, 2] > nodes[:, 2].max() - 1e-9
    mesh = TetMesh(nodes, tetrahedra, fixed)
    simulation = TissueSimulation(mesh, _MATERIAL, Resistance(0.5, 100.0, 10.0))
    method = make_method(CuttingSettings())
    way = np.linspace(-0.003, 0.021, 17)
    x = 0.0112 + 0.2 * way
    path = np.stack([[x, way, 0 * x - 0.004], [x + 0.002, way, 0 * x + 0.011]]).transpose(2, 0, 1)
    steps = []
    for sweep in [*(Sweep(*a, *b) for a, b in pairwise(path)), None]:
        positions = simulation.positions
        start = time.thread_time()
        if sweep is None:
            result = method.finish(mesh, positions)
        else:
            result = method.advance(mesh, positions, sweep)
        middle = time.thread_time()
        if not result.delta.empty:
            simulation.apply_cut(result.delta)
        end = time.thread_time()
        count = len(result.delta.removed_tetrahedra)
        steps.append((1e3 * (middle - start), 1e3 * (end - middle) * (count > 0), count))
    return np.array(steps).T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--repeats', type=int, default=9, help='runs of each, the fastest counts')
    repeats = parser.parse_args().repeats
    table = Table('tetrahedra', 'first contact', 'advance', 'apply', 'batch', 'largest', 'ratio')
    first = 0.0
    for name, cells in BLOCKS.items():
        costs = stroke_costs(cells, repeats)
        median = float(np.median(costs.batch))
        first = first or median
        changed = costs.cut > 0
        cells_ms = (
            costs.advance[0],
            np.median(costs.advance[changed]),
            np.median(costs.apply[changed]),
            median,
            costs.batch.max(),
        )
        table.add_row(name, *(f'{ms:.2f} ms' for ms in cells_ms), f'{median / first:.2f}')
    console = Console()
    rk4 = rk4_milliseconds()
    console.print(table)
    console.print(
        f'{costs.cut.sum():.0f} tetrahedra in {(costs.cut > 0).sum()} batches; '
        f'one RK4 step of 10,000 tetrahedra takes {rk4:.2f} ms, a batch {median / rk4:.0f} of them'
    )


if __name__ == '__main__':
    main()
