"""A small session of every kind of kernel, whose numbers go to standard output as JSON; run as a
process, with the environment that is to be tried.
"""

import json
import sys

import numpy as np
from meshes import box

from bench.speed.strokes import blade_contact
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.in_process import InProcess, Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

CELL = 0.01
CELLS = (4, 2, 2)
UP = np.array([0.0, 0.0, 1.0])
TOP = CELLS[2] * CELL


def tissue(rate: float, threshold: float, model='linear', integrator='rk4', **active) -> Tissue:
    nodes, tetrahedra = box(CELLS, CELL)
    simulation = TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9),
        Material(500.0, 0.4, 1000.0, 5.0, 1e-4),
        Resistance(threshold, 0.25, 0.025),
        model=model,
        stepping=TimeStepping(integrator, rate=rate),
        active=ActiveSettings(**active),
    )
    return Tissue(simulation, make_method(CuttingSettings()))


def cut(tissue: Tissue, frames: int) -> list[float]:
    """A blade that goes in, along x and out.

    Returns:
        Forces [N], elements that were cut, topology, and where the nodes are [m].
    """
    mesh, place, out = tissue.simulation.mesh, np.array([0.4, 0.9, 2.0]) * CELL, []
    ways = [(0.0, z) for z in (0.002, 0.006, 0.012)]
    ways += [(x, 0.012) for x in np.arange(1, frames + 1) * 0.004]
    states = [ContactState.TOUCHING] * len(ways) + [ContactState.NONE]
    for state, (x, z) in zip(states, [*ways, ways[-1]], strict=True):
        tip = place + np.array([x, 0.0, -z])
        out += tissue.frame(blade_contact(mesh, state, place, tip, UP)).force.tolist()
    for _ in range(2):
        tissue.frame(None)
    shape = np.ravel(tissue.simulation.displacement).tolist()
    return [*out, tissue.simulation.elements_cut, mesh.topology, *shape]


def ticks() -> list[float]:
    """The force loop over the tissue: down to the surface and into it."""
    device, radius = DeviceSettings(), 0.004
    path = ForcePath(ToolSettings(radius=radius), device, HapticsSettings(), device.load_profile())
    loop = InProcess(path, tissue(100.0, 1e3), 100.0)
    heights = TOP + radius + np.interp(np.arange(60), [0, 20, 60], [1e-3, 0.0, -3e-3])
    middle = 0.5 * CELL * np.array(CELLS) - 0.003
    return [f for z in heights for f in loop.tick(np.array([*middle[:2], z])).wrench[:3]]


if __name__ == '__main__':
    tissues = {
        'linear, symplectic_euler': (tissue(300.0, 0.005, 'linear', 'symplectic_euler'), 9),
        'corotational, implicit': (tissue(450.0, 0.005, 'corotational', 'implicit'), 0),
        'corotational_smoothed, euler': (
            tissue(450.0, 0.005, 'corotational_smoothed', 'euler', mode='budget', nodes=20),
            0,
        ),
    }
    numbers = {name: cut(*given) for name, given in tissues.items()}
    cuts = tissues['linear, symplectic_euler'][0].simulation.elements_cut
    json.dump(numbers | {'ticks': ticks(), 'elements cut': [cuts]}, sys.stdout)
