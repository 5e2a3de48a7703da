"""Share of the shear stiffness that smoothed models leave to the elements, over random problems.

`./trainer run python -m bench.accuracy.plain_share` loads random blocks of scattered nodes at
random places and compares them with quadratic tetrahedra on meshes of half the edge. No problem is
one of the chart's. A run takes some minutes.
"""

from statistics import median
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.law_problems import Case, unstructured_block
from bench.accuracy.quadratic import QuadraticTissue
from cutting_trainer.tissue_sim.elasticity import models
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.refine import refined
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.indentation import Indenter, settlement

Floats = NDArray[np.float64]

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7)
PROBLEMS, EDGE = 8, 0.009
"""How many, and mean distance of their nodes [m]."""


class Errors(NamedTuple):
    """Of one share in one problem: of the settlement, with its sign, and of the field (L2)."""

    settlement: float
    field: float


def problem(seed: int) -> tuple[TetMesh, Material, Indenter]:
    """Return a block, held at its underside or at one end, its material and a load."""
    rng = np.random.default_rng(seed)
    sides = rng.integers(3, 6, 3)
    size = (float(sides[0] * EDGE), float(sides[1] * EDGE), float(sides[2] * EDGE))
    block = unstructured_block(Case('', size, lambda points, share: 0 * points), EDGE, seed)
    across, size_x = int(rng.integers(0, 2)), size[0]
    held = block.rest[:, 2 if across else 0] < 1e-9
    mesh = TetMesh(block.rest, block.tetrahedra, held)
    place = np.array([rng.uniform(0.4, 0.8) * size_x, rng.uniform(0.3, 0.7) * size[1], size[2]])
    direction = np.array([*rng.uniform(-0.5, 0.5, 2), -1.0])
    load = Indenter(
        place, EDGE * rng.uniform(1.0, 2.0), direction / float(np.linalg.norm(direction))
    )
    return mesh, Material(5400.0, float(rng.choice([0.3, 0.45, 0.47, 0.49])), 1060.0), load


def errors(seed: int) -> list[Errors]:
    """Return the errors of each share in a problem."""
    mesh, material, load = problem(seed)
    right = QuadraticTissue(refined(mesh), material)
    exact, field = right.settlement(load), right.corners(load)[: mesh.node_count]
    found = []
    for share in SHARES:
        with patch.object(models, 'PLAIN_SHARE', share):
            model = models.ElasticModel(mesh, material, 'linear_smoothed')
        value, u = settlement(model, load.load(mesh))
        weight = model.mass[:, None]
        away = np.sqrt((weight * (u - field) ** 2).sum() / (weight * field**2).sum())
        found.append(Errors(value / exact - 1, float(away)))
    return found


def main() -> None:
    """Print medians and worst values of each share."""
    found = []
    for seed in range(PROBLEMS):
        found.append(errors(seed))
        print(f'{seed + 1} of {PROBLEMS}', flush=True)
    print('| share | settlement: median, worst | field: median, worst |\n|---|---|---|')
    for share, own in zip(SHARES, zip(*found, strict=True), strict=True):
        off, field = [abs(e.settlement) for e in own], [e.field for e in own]
        print(
            f'| {share:g} | {100 * median(off):.1f}, {100 * max(off):.1f} % '
            f'| {100 * median(field):.1f}, {100 * max(field):.1f} % |'
        )


if __name__ == '__main__':
    main()
