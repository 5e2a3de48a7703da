"""Torque of scissors by their opening angle: one blade closes on a sheet that the other supports.

The edge is straight and passes the pivot at a distance e. At an angle a to the sheet, it crosses
the layer at a depth d of the sheet at x = (e - d cos a) / sin a from the pivot. As the scissors
close, the crossing moves outward, and the sheet is cut progressively. Without friction, the torque
is toughness times the area A by angle (Mahvash et al. 2008):

    T = J |dA/da|, A = t (e - t / 2 cos a) / sin a for rigid scissors

The blade is held by the springs of the coupling, so that the edge stays behind the hand's angle.
The area is therefore that of the crossings of the edge itself.
"""

import time
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from bench.cuts.strokes import good_block
from bench.speed.strokes import blade_contact
from bench.validate.case import Result
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance, Sweep
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

SHEET = (0.048, 0.012, 0.004)
"""Sheet, whose underside rests on the lower blade [m]."""
OFFSET, BEGIN, EDGE = 0.010, 0.014, 0.070
"""Distance e of the edge from the pivot, and of the sheet's end from it; length of the edge [m]."""
OPEN, SHUT, SPEED = np.radians(50.0), np.radians(12.0), 0.5
"""Angles [rad] and speed [rad/s] of closing."""
ANGLES = (32.0, 28.0, 24.0, 20.0, 16.0)
"""Middles of the ranges of angle over which torques are compared [deg], each `RANGE` wide."""
RANGE = 4.0
CELLS = (0.002, 0.0016)
TOUGHNESS, MODULUS, STIFF, RATE = 76.0, 86_400.0, 4000.0, 240.0
"""[J/m^2]; [Pa]: the sheet yields little; of the coupling [N/m]; [Hz]."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Closed:
    """A sheet cut by scissors.

    Attributes:
        angles: of the hand by frame [rad], shape (k,).
        torques: of the tissue about the pivot, closing positive [N m], shape (k,).
        crossings: of the edge with the middle of the sheet, from the sheet's end [m]; NaN: not told
            in this frame, shape (k,).
        tetrahedra: before the cut.
        cpu: CPU time [s].
    """

    angles: np.ndarray
    torques: np.ndarray
    crossings: np.ndarray
    tetrahedra: int
    cpu: float


@cache
def closed(cell: float) -> Closed:
    """Close the scissors on a sheet.

    Args:
        cell: edge of a cube of twelve tetrahedra [m].
    """
    cells = tuple(round(s / cell) for s in SHEET)
    nodes, tetrahedra = good_block((cells[0], cells[1], cells[2]), cell, seed=1)
    mesh = TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9)
    count, top = len(mesh.tetrahedra), float(nodes[:, 2].max())
    simulation = TissueSimulation(
        mesh,
        Material(MODULUS, 0.45, 1060.0, 15.0, 1e-4, 6.0),
        Resistance(0.02, TOUGHNESS, 0.0),
        model='stiffening',
        stepping=TimeStepping('symplectic_euler', rate=RATE, max_substeps=1000),
    )
    tissue = Tissue(simulation, make_method(CuttingSettings()))
    pivot = np.array([-BEGIN, SHEET[1] / 2 + 0.0003, top])
    angles = np.arange(OPEN, SHUT, -SPEED / RATE)
    torques, crossings, start = [], [], time.thread_time()
    for angle in angles:
        foot = pivot + OFFSET * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        tip = foot + EDGE * np.array([np.cos(angle), 0.0, np.sin(angle)])
        # The edge touches where it meets the end of the sheet.
        place = np.array([0.0, pivot[1], foot[2] - foot[0] * np.tan(angle)])
        contact = blade_contact(mesh, ContactState.TOUCHING, place, tip, _UP)
        contact = replace(contact, device=place, blade_root=foot, stiffness=STIFF)
        frame = tissue.frame(contact)
        torque = frame.turning.torque + np.cross(tip - pivot, frame.force)
        torques.append(-float(torque[1]))
        crossings.append(_crossing(frame.sweep, top - SHEET[2] / 2))
    cpu = time.thread_time() - start
    return Closed(angles, np.array(torques), np.array(crossings), count, cpu)


def _crossing(sweep: Sweep | None, height: float) -> float:
    """Return where the edge is at a height [m], NaN without a sweep."""
    if sweep is None:
        return float('nan')
    root, tip = sweep.root_to, sweep.tip_to
    share = (height - root[2]) / (tip[2] - root[2])
    return float(root[0] + share * (tip[0] - root[0]))


def run_scissors(quick: bool) -> list[Result]:
    """Return the torque at some angles, against the published form."""
    results = []
    for cell in CELLS[:1] if quick else CELLS:
        found = closed(cell)
        for degrees in ANGLES:
            near = np.abs(np.degrees(found.angles) - degrees) <= RANGE / 2
            angles, crossings = found.angles[near], found.crossings[near]
            told = np.flatnonzero(~np.isnan(crossings))
            first, last = told[0], told[-1]
            area = SHEET[2] * (crossings[last] - crossings[first])
            published = TOUGHNESS * area / (angles[first] - angles[last])
            torque = float(found.torques[near][first : last + 1].mean())
            results.append(
                Result(
                    f'{degrees:g} degrees, torque',
                    'stiffening',
                    found.tetrahedra,
                    'N m',
                    float(published),
                    torque,
                    torque / float(published) - 1,
                    found.cpu,
                )
            )
    return results
