"""Cost of one and the same stroke in meshes of 2,000 to 200,000 tetrahedra.

The block grows away from the corner that is cut; where blocks overlap they are the same: the stroke
meets the same elements.
"""

import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.common.clock import Figure, figure
from bench.cuts.strokes import good_block
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Resistance, Sweep
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

CELL_M = 0.005
BLOCKS = {'2,000': (7, 6, 4), '20,000': (12, 12, 12), '200,000': (26, 26, 25)}
_MATERIAL = Material(3500.0, 0.45, 1060.0)


@dataclass(frozen=True)
class Costs:
    """Cost of the steps of a stroke.

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
    """Draw the blade through the corner of a block; each step is the fastest of some runs."""
    nodes, tetrahedra = good_block(cells, CELL_M, seed=-1)
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


def block_of(size: int) -> tuple[int, int, int]:
    """Return cells of a block of about so many tetrahedra, large enough for the stroke."""
    edge = max(round((size / 12) ** (1 / 3)), 4)
    return max(edge, 7), max(edge, 6), max(edge, 4)


def cut(sizes: list[int], repeats: int = 5) -> list[Figure]:
    """Return a batch, from the blade's sweep to tissue that can move again."""
    figures: list[Figure] = []
    for size in sizes:
        costs = stroke_costs(block_of(size), repeats)
        label = f'{len(good_block(block_of(size), CELL_M, seed=-1)[1])} tetrahedra'
        changed = costs.cut > 0
        batch = figure(f'batch, {label}', 'ms', costs.batch)
        if figures:
            smallest = figures[0]
            ratio = batch.median / smallest.median
            batch = figure(batch.name, 'ms', costs.batch, ratio, smallest.name)
        figures += [
            batch,
            figure(f'  advance, {label}', 'ms', costs.advance[changed]),
            figure(f'  apply, {label}', 'ms', costs.apply[changed]),
            figure(f'  first contact, {label}', 'ms', costs.advance[:1]),
        ]
    return figures
