"""Steady force of a blade drawn through a block, against toughness times length of edge, and
against Atkins' force of a blade that slices.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from bench.cuts.strokes import good_block
from bench.speed.strokes import blade_contact
from bench.validate.case import Result
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.in_process import answer
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState, Frame
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

SIZE = (0.064, 0.024, 0.016)
"""Block, fixed at its underside, to half a cell [m]."""
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
SLICE_PUSH = (0.0, 0.5, 1.0, 2.0, 4.0)
SLICED, FIRM = 76.0, 21600.0
"""Toughness of the tissue that is sliced [J/m^2], and its modulus [Pa]: it yields so little that
the force is steady on a short way."""
BELOW, EDGE, STIFF, SLICE = 0.003, 0.085, 2000.0, 0.016
"""How far the tip of a slicing blade is below the block at first [m], length of its edge [m],
stiffness of its coupling [N/m]; its way along x [m]."""
E0, STIFFENING = 5400.0, 6.0
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Drawn:
    """A blade drawn through the block.

    Attributes:
        force: that the hand needs, mean of the last part of the way [N], shape (3,).
        depth: of the blade's tip below the surface at rest, or the height of the block [m].
        cut: elements that were cut.
        tetrahedra: before the cut.
        cpu: CPU time [s].
    """

    force: np.ndarray
    depth: float
    cut: int
    tetrahedra: int
    cpu: float


@cache
def drawn(
    model: ModelName,
    toughness: float,
    youngs_modulus: float,
    cell: float,
    slice_push: float | None = None,
) -> Drawn:
    """Draw a blade without friction along x.

    Args:
        model: elastic model.
        toughness: J [J/m^2].
        youngs_modulus: at small strain [Pa].
        cell: edge of a cube of twelve tetrahedra [m].
        slice_push: speed along the edge over speed along x, of a blade through the whole block;
            None: the blade's tip stays at its depth.
    """
    simulation = block(model, Resistance(0.02, toughness, 0.0), youngs_modulus, cell, RATE)
    count, top = len(simulation.mesh.tetrahedra), float(simulation.mesh.rest[:, 2].max())
    depth = DEPTH if slice_push is None else top + BELOW
    start = time.thread_time()
    stroke = STROKE if slice_push is None else SLICE
    tips = _way(top, depth, stroke, slice_push or 0.0)
    forces = [-frame.force for frame in frames(simulation, tips, slices=slice_push is not None)]
    cpu = time.thread_time() - start
    steady = np.mean(forces[-round(STEADY * stroke / SPEED * RATE) :], axis=0)
    return Drawn(steady, min(depth, top), simulation.elements_cut, count, cpu)


def block(
    model: ModelName,
    resistance: Resistance,
    youngs_modulus: float,
    cell: float,
    rate: float,
    size: tuple[float, float, float] = SIZE,
) -> TissueSimulation:
    """Return a block of about a size [m] in cubes of twelve tetrahedra, fixed at its underside.

    Args:
        model: elastic model.
        resistance: against the blade.
        youngs_modulus: at small strain [Pa].
        cell: edge of a cube [m].
        rate: of frames [Hz].
        size: along x, y and z [m].
    """
    cells = tuple(round(s / cell) for s in size)
    nodes, tetrahedra = good_block((cells[0], cells[1], cells[2]), cell, seed=1)
    return TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9),
        Material(youngs_modulus, 0.45, 1060.0, 15.0, 1e-4, STIFFENING),
        resistance,
        model=model,
        stepping=TimeStepping('symplectic_euler', rate=rate, max_substeps=2000),
    )


def frames(
    simulation: TissueSimulation, tips: np.ndarray, *, slices: bool = False
) -> Iterator[Frame]:
    """Yield the frames of a blade that is drawn through a block and cuts it.

    Args:
        simulation: of the block.
        tips: of the blade by frame [m], shape (k, 3).
        slices: whether its edge is long and its coupling stiff.
    """
    mesh, top = simulation.mesh, float(simulation.mesh.rest[:, 2].max())
    method, asks = make_method(CuttingSettings()), CutTransaction(simulation)
    for tip in tips:
        if asks.due and asks.asked is not None:
            asks.resolve(*answer(method, asks.asked, simulation))
        place = np.array([tip[0], tip[1], top])
        contact = blade_contact(mesh, ContactState.TOUCHING, place, tip, _UP)
        if slices:
            contact = replace(contact, blade_root=tip + EDGE * _UP, stiffness=STIFF)
        frame = simulation.frame(contact)
        asks.ask(frame)
        yield frame


def _way(top: float, depth: float, stroke: float, slice_push: float) -> np.ndarray:
    """Return tips of the blade by frame [m], shape (k, 3)."""
    down = np.linspace(top + 0.0005, top - depth, round((depth + 0.0005) / ENTRY * RATE))
    along = np.linspace(START, START + stroke, round(stroke / SPEED * RATE))
    y = SIZE[1] / 2 + 0.0007
    first = np.stack([np.full_like(down, START), np.full_like(down, y), down], axis=1)
    low = top - depth - slice_push * (along - START)
    then = np.stack([along, np.full_like(along, y), low], axis=1)
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


def run_slicing(quick: bool) -> list[Result]:
    """Return the force across and along the edge by the slice/push ratio, after Atkins."""
    results = []
    for cell in CELLS[:1] if quick else CELLS:
        for ratio in SLICE_PUSH:
            found = drawn('stiffening', SLICED, FIRM, cell, ratio)
            both = SLICED * found.depth / (1 + ratio**2)
            for name, exact, axis in (('across', both, 0), ('along', ratio * both, 2)):
                if exact == 0.0:
                    continue
                force = abs(float(found.force[axis]))
                results.append(
                    Result(
                        f'slice/push {ratio:g}, force {name} the edge',
                        'stiffening',
                        found.tetrahedra,
                        'N',
                        exact,
                        force,
                        force / exact - 1,
                        found.cpu,
                    )
                )
    return results


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
    exact = toughness * found.depth
    if found.cut < MIN_CUT:
        note = 'the tissue gives way, nothing is cut'
        return Result(quantity, model, found.tetrahedra, 'N', exact, None, None, found.cpu, note)
    force = float(found.force[0])
    return Result(
        quantity, model, found.tetrahedra, 'N', exact, force, force / exact - 1, found.cpu
    )
