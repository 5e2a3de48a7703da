"""Steady force of a blade drawn through a block, against toughness times length of edge."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from bench.cuts.strokes import good_block
from bench.speed.strokes import blade_contact
from bench.validate.case import Result
from cutting_trainer.cutting.methods import make_method
from cutting_trainer.cutting.settings import CuttingSettings
from cutting_trainer.session.in_process import answer
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import TimeStepping
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

SIZE = (0.064, 0.024, 0.016)
"""Block, fixed at its underside [m]."""
DEPTH = 0.0055
"""Depth of the blade's tip below the surface at rest [m]."""
START, STROKE, SPEED = 0.008, 0.048, 0.08
"""Place where the blade enters and length of its way, both along x [m]; its speed [m/s]."""
ENTRY = 0.02
"""Speed with which it enters [m/s]."""
RATE = 120.0
STEADY = 0.25
"""Last part of the way, over which the force is averaged."""
MIN_CUT = 20
"""Elements below which no incision has begun."""
CELLS = (0.0053, 0.004)
"""Edges of the cubes of twelve tetrahedra [m]."""
MODELS: tuple[ModelName, ...] = ('linear_smoothed', 'stiffening')
TOUGHNESSES = {
    76.0: 'porcine liver, needle, least',
    164.0: 'bovine liver, needle',
    169.4: 'porcine lamina propria, transverse',
    185.0: 'porcine liver, needle, most',
    187.0: 'porcine liver, blade, least',
    225.0: 'porcine liver, blade, most',
    290.0: 'porcine aorta, blade',
    451.1: 'porcine lamina propria, coronal',
}
"""Published toughness [J/m^2]."""
MODULI = (2700.0, 5400.0, 10800.0, 21600.0)
"""Young's moduli of the same toughness [Pa]."""
SAME_TOUGHNESS = 164.0
E0, STIFFENING = 5400.0, 6.0
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Drawn:
    """A blade drawn through the block.

    Attributes:
        force: along its way, mean of the last part [N].
        cut: elements that were cut.
        tetrahedra: before the cut.
        cpu: CPU time [s].
    """

    force: float
    cut: int
    tetrahedra: int
    cpu: float


@cache
def drawn(model: ModelName, toughness: float, youngs_modulus: float, cell: float) -> Drawn:
    """Draw a blade without friction along x.

    Args:
        model: elastic model.
        toughness: J [J/m^2].
        youngs_modulus: at small strain [Pa].
        cell: edge of a cube of twelve tetrahedra [m].
    """
    cells = tuple(round(s / cell) for s in SIZE)
    nodes, tetrahedra = good_block((cells[0], cells[1], cells[2]), cell, seed=1)
    mesh = TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9)
    count = len(mesh.tetrahedra)
    material = Material(youngs_modulus, 0.45, 1060.0, 15.0, 1e-4, STIFFENING)
    simulation = TissueSimulation(
        mesh,
        material,
        Resistance(0.02, toughness, 0.0),
        model=model,
        stepping=TimeStepping('symplectic_euler', rate=RATE, max_substeps=1000),
    )
    method, asks = make_method(CuttingSettings()), CutTransaction(simulation)
    forces = []
    start = time.thread_time()
    for tip in _way():
        if asks.due and asks.asked is not None:
            asks.resolve(*answer(method, asks.asked, simulation))
        place = np.array([tip[0], tip[1], SIZE[2]])
        frame = simulation.frame(blade_contact(mesh, ContactState.TOUCHING, place, tip, _UP))
        asks.ask(frame)
        forces.append(-frame.force[0])
    cpu = time.thread_time() - start
    steady = float(np.mean(forces[-round(STEADY * STROKE / SPEED * RATE) :]))
    return Drawn(steady, simulation.elements_cut, count, cpu)


def _way() -> np.ndarray:
    top = SIZE[2]
    down = np.linspace(top + 0.0005, top - DEPTH, round((DEPTH + 0.0005) / ENTRY * RATE))
    along = np.linspace(START, START + STROKE, round(STROKE / SPEED * RATE))
    y = SIZE[1] / 2 + 0.0007
    first = np.stack([np.full_like(down, START), np.full_like(down, y), down], axis=1)
    then = np.stack([along, np.full_like(along, y), np.full_like(along, top - DEPTH)], axis=1)
    return np.concatenate([first, then])


def run_toughness(quick: bool) -> list[Result]:
    """Return the steady force at each toughness of the table."""
    return [
        _against(f'J {toughness:g} J/m^2, {TOUGHNESSES[toughness]}', model, toughness, E0, cell)
        for cell, toughness in _meshes(tuple(TOUGHNESSES), SAME_TOUGHNESS, quick=quick)
        for model in MODELS
    ]


def run_stiffness(quick: bool) -> list[Result]:
    """Return the steady force at the same toughness in tissue of any stiffness."""
    quantity = f'E %g kPa, J {SAME_TOUGHNESS:g} J/m^2'
    return [
        _against(quantity % (modulus / 1e3), model, SAME_TOUGHNESS, modulus, cell)
        for cell, modulus in _meshes(MODULI, E0, quick=quick)
        for model in MODELS
    ]


def _meshes(
    values: tuple[float, ...], middle: float, *, quick: bool
) -> Iterator[tuple[float, float]]:
    """Yield each value on the fine mesh, and the middle one on both; or all on the coarse."""
    coarse, fine = CELLS
    yield from ((coarse, value) for value in (values if quick else (middle,)))
    if not quick:
        yield from ((fine, value) for value in values)


def _against(
    quantity: str, model: ModelName, toughness: float, modulus: float, cell: float
) -> Result:
    found = drawn(model, toughness, modulus, cell)
    exact = toughness * DEPTH
    if found.cut < MIN_CUT:
        note = 'the tissue gives way, nothing is cut'
        return Result(quantity, model, found.tetrahedra, 'N', exact, None, None, found.cpu, note)
    error = found.force / exact - 1
    return Result(quantity, model, found.tetrahedra, 'N', exact, found.force, error, found.cpu)
