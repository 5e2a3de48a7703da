"""A blade that is moved in tissue with its edge, its spine or its flat leading: force and cut."""

from dataclasses import dataclass, replace

import numpy as np

from bench.cuts.strokes import good_block
from bench.speed.strokes import blade_contact
from cutting_trainer.cutting.cut_invariants import cut_face_area
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.in_process import answer
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

TOUGHNESS, DEPTH, WAY = 20.0, 0.010, 0.012
"""[J/m^2]; [m] of the tip below the surface; [m] of the device across its blade."""
_CELLS, _CELL, _RATE, _SPEED = (8, 8, 4), 0.005, 120.0, 0.04


@dataclass(frozen=True)
class Moved:
    """A blade that was moved across itself in tissue.

    Attributes:
        force: that the hand needs along the way at its end, mean of its last fifth [N].
        opened: area of one side of what was cut on the way [m^2].
        paid: work of cutting on the way [J].
        work: of the hand on the way [J].
    """

    force: float
    opened: float
    paid: float
    work: float


def moved(angle: float, regions: tuple[tuple[float, float], ...] = ()) -> Moved:
    """Push a blade straight into a block, and move it across itself.

    Args:
        angle: from the direction that the edge faces to the way [rad]: 0 edge, pi / 2 flat, pi
            spine.
        regions: see `Resistance`; the block has none of them.
    """
    nodes, tetrahedra = good_block(_CELLS, _CELL, seed=3)
    mesh = TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9)
    simulation = TissueSimulation(
        mesh,
        Material(30000.0, 0.4, 1000.0, 15.0, 2e-4),
        Resistance(0.02, TOUGHNESS, 0.0, regions=regions),
        stepping=TimeStepping('symplectic_euler', rate=_RATE, max_substeps=1000),
    )
    method, asks = make_method(CuttingSettings()), CutTransaction(simulation)
    up, top = np.array([0.0, 0.0, 1.0]), float(nodes[:, 2].max())
    way, facing = np.array([1.0, 0, 0]), np.array([np.cos(angle), -np.sin(angle), 0.0])
    start = np.array([0.0138, 0.0204, top + 0.0005])
    down = np.linspace(0.0, DEPTH + 0.0005, round(DEPTH / _SPEED * _RATE))
    on = np.linspace(0.0, WAY, round(WAY / _SPEED * _RATE))[1:]
    tips = np.concatenate([start - down[:, None] * up, start - down[-1] * up + on[:, None] * way])
    forces, before = [], (0.0, 0.0)
    for number, tip in enumerate(tips):
        if number == len(down):
            blade = simulation.blade
            before = (0.0 if blade is None else blade.paid, cut_face_area(mesh))
        if asks.due and asks.asked is not None:
            asks.resolve(*answer(method, asks.asked, simulation))
        contact = blade_contact(mesh, ContactState.TOUCHING, np.array([*tip[:2], top]), tip, up)
        frame = simulation.frame(replace(contact, blade_facing=facing))
        asks.ask(frame)
        forces.append(float(-frame.force @ way))
    pushed = np.array(forces[len(down) - 1 :])
    blade = simulation.blade
    assert blade is not None
    return Moved(
        force=float(pushed[-len(on) // 5 :].mean()),
        opened=cut_face_area(mesh) - before[1],
        paid=blade.paid - before[0],
        work=float(((pushed[1:] + pushed[:-1]) / 2).sum() * WAY / len(on)),
    )
