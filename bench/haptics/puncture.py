"""A blade that is pushed straight into tissue: where it goes in, and what its tip then resists."""

from dataclasses import dataclass, replace

import numpy as np

from bench.cuts.strokes import good_block
from bench.speed.strokes import blade_contact
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

TOUGHNESS, WIDTH, RADIUS = 100.0, 0.0005, 0.004
"""[J/m^2]; [m] of the slit at the tip; [m] of the sphere that touches."""
_SIZE, _SPEED, _STIFFNESS, _WAY = (0.06, 0.06, 0.03), 0.02, 400.0, 0.012


@dataclass(frozen=True)
class Entered:
    """A blade that was pushed in.

    Attributes:
        peak: largest force before it went in [N].
        plateau: mean force on the last quarter of the way [N].
    """

    peak: float
    plateau: float


def pushed_in(
    cell: float, rate: float, youngs_modulus: float, *, until_entry: bool = False
) -> Entered:
    """Push a blade without friction straight into a block.

    Args:
        cell: edge of a cube of twelve tetrahedra [m].
        rate: of the frames [Hz].
        youngs_modulus: [Pa].
        until_entry: stop where it goes in.
    """
    cells = [round(size / cell) for size in _SIZE]
    nodes, tetrahedra = good_block((cells[0], cells[1], cells[2]), cell, seed=3)
    mesh = TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9)
    simulation = TissueSimulation(
        mesh,
        Material(youngs_modulus, 0.45, 1000.0, 15.0, 2e-4),
        Resistance(100.0, TOUGHNESS, 0.0, WIDTH),
        model='linear_smoothed',
        stepping=TimeStepping('symplectic_euler', rate=rate, max_substeps=1000),
    )
    up, top = np.array([0.0, 0.0, 1.0]), float(nodes[:, 2].max())
    middle = np.array([_SIZE[0] / 2 + 0.0011, _SIZE[1] / 2 + 0.0007, 0.0])
    forces, entered = [], None
    for height in np.arange(0.0005, -_WAY, -_SPEED / rate):
        tip = middle + (top + height) * up
        contact = blade_contact(mesh, ContactState.TOUCHING, middle + top * up, tip, up)
        centre = tip + RADIUS * up
        contact = replace(
            contact,
            device=centre,
            offset=RADIUS * up,
            radius=RADIUS,
            stiffness=_STIFFNESS,
            blade_tip=tip,
            blade_root=tip + 0.024 * up,
        )
        frame = simulation.frame(contact)
        if frame.command is not None:
            simulation.cut_done()
        if entered is None and frame.state == ContactState.INSIDE:
            entered = len(forces)
            if until_entry:
                break
        forces.append(float(frame.force @ up))
    force = np.array(forces)
    peak = float(force[: entered or len(force)].max())
    return Entered(peak, float(force[-len(force) // 4 :].mean()))
