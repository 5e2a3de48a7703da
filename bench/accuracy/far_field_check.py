"""Compare the planner's error of a far field with that of sessions in which all nodes move.

Run `python -m bench.accuracy.far_field_check`. The blocks are irregular, of seeds and sizes that
nothing was chosen by. Predicted: a static trial of a smooth load. Measured: the tool goes 4 mm
deep and rests there, with the footprint's load; the largest difference of any node, over the
largest displacement, against the same session with all nodes moving.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.footprint import BLOCK, MATERIAL, block
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.planner.far_field_errors import FarFieldTrial
from cutting_trainer.tissue_sim.planner.indentation import Indenter
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

Floats = NDArray[np.float64]

HELD_OUT = (((20, 20, 9), 101), ((28, 28, 11), 102))
"""Bricks of the blocks, and seeds."""
NODES = (100, 200, 400, 800)
PLACES = np.array([(0.052, 0.049, BLOCK[2]), (0.031, 0.067, BLOCK[2])])
_DEPTH, _RADIUS = 0.004, 0.008
_GOES, _RESTS = 15, 25
"""Frames."""


def rest(mesh: TetMesh, place: Floats, active: ActiveSettings) -> Floats:
    """Return the displacement under a tool that has come to rest [m], shape (n, 3)."""
    simulation = TissueSimulation(
        mesh,
        replace(MATERIAL, alpha=15.0, beta=1e-4),
        Resistance(1e9, 1e9, 1.0),
        model='linear_smoothed',
        stepping=TimeStepping('symplectic_euler', max_substeps=1000),
        active=active,
    )
    for frame in range(_GOES + _RESTS):
        depth = _DEPTH * min(1.0, frame / _GOES)
        simulation.frame(indenter_contact(mesh, place, np.array([0.0, 0.0, -1.0]), depth))
    return np.array(simulation.displacement)


def main() -> None:
    """Print predicted and measured errors."""
    for cells, seed in HELD_OUT:
        mesh = block(cells, seed)
        for place in PLACES:
            press = Indenter(place, _RADIUS, np.array([0.0, 0.0, -1.0]))
            trial = FarFieldTrial(mesh, MATERIAL, press, smoothed=True)
            whole = rest(mesh, place, ActiveSettings())
            largest = np.linalg.norm(whole, axis=1).max()
            for nodes in NODES:
                part = rest(mesh, place, ActiveSettings('budget', nodes))
                measured = float(np.linalg.norm(part - whole, axis=1).max() / largest)
                print(
                    f'{len(mesh.tetrahedra)} tetrahedra, x {1e3 * place[0]:g} mm, {nodes} nodes: '
                    f'predicted {100 * trial.error(nodes):.2f} %, '
                    f'measured {100 * measured:.2f} %'
                )


if __name__ == '__main__':
    main()
