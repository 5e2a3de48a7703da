"""Force on a blade before which the crack runs in steps: its mean and the length of its teeth."""

import time
from dataclasses import dataclass
from functools import cache

import numpy as np

from bench.validate.blade import DEPTH, ENTRY, FIRM, SLICED, block, frames
from bench.validate.case import Result
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.in_process import InProcess, Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.blade_constants import BladeConstants

SIZE = (0.048, 0.024, 0.012)
"""Block, to half a cell [m]."""
CRACK = 0.003
"""Length of a step [m]: chosen here."""
START, STROKE, SPEED = 0.008, 0.030, 0.02
"""Place where the blade enters and length of its way, both along x [m]; its speed [m/s]."""
RUNS = ((0.004, 20.0), (0.004, 60.0), (0.003, 20.0), (0.0024, 60.0))
"""Edges of the cubes of twelve tetrahedra [m], and rates of frames [Hz]."""


TOOL = ToolSettings(
    radius=0.001, coupling_stiffness=400.0, blade_root=(0, 0, 0.028), blade_tip=(0, 0, -0.002)
)
_SETTLES_MS = 300
"""Time before the hand moves on [ms]."""


@dataclass(frozen=True)
class Teeth:
    """Force of whole teeth, from a rise through the steady force to another.

    Attributes:
        mean: force along the way [N].
        length: of a tooth [m].
        paid: work of cutting [J].
        way: of the hand [m].
        swing: largest less least force [N].
        tetrahedra: before the cut.
        cpu: CPU time [s].
    """

    mean: float
    length: float
    paid: float
    way: float
    swing: float
    tetrahedra: int
    cpu: float


@cache
def teeth(cell: float, rate: float, crack: float = CRACK) -> Teeth:
    """Draw a blade without friction along x, and measure the teeth of its force.

    Args:
        cell: edge of a cube of twelve tetrahedra [m].
        rate: of frames [Hz].
        crack: length of a step [m].
    """
    resistance = Resistance(0.02, SLICED, 0.0, crack_length=crack)
    simulation = block('stiffening', resistance, FIRM, cell, rate, SIZE)
    count, top = len(simulation.mesh.tetrahedra), float(simulation.mesh.rest[:, 2].max())
    heights = np.linspace(top + 0.0005, top - DEPTH, round((DEPTH + 0.0005) / ENTRY * rate))
    along = np.linspace(START, START + STROKE, round(STROKE / SPEED * rate))
    places = np.concatenate([np.full_like(heights, START), along])
    tips = np.column_stack(
        [
            places,
            np.full_like(places, SIZE[1] / 2 + 0.0007),
            np.concatenate([heights, np.full_like(along, top - DEPTH)]),
        ]
    )
    began, forces, paid = time.thread_time(), [], []
    for frame in frames(simulation, tips):
        forces.append(-frame.force[0])
        paid.append(0.0 if simulation.blade is None else simulation.blade.paid)
    cpu = time.thread_time() - began
    felt, work = np.array(forces[len(heights) :]), np.array(paid[len(heights) :])
    return _measured(along, felt, work, count, cpu)


def _measured(
    along: np.ndarray, felt: np.ndarray, work: np.ndarray, count: int, cpu: float
) -> Teeth:
    """Return the teeth of a record by place of the hand [m], force [N] and work [J], (k,)."""
    steady = SLICED * DEPTH
    rises = np.flatnonzero((felt[:-1] < steady) & (felt[1:] >= steady))
    part = (steady - felt[rises]) / (felt[rises + 1] - felt[rises])
    crossed = along[rises] + part * (along[rises + 1] - along[rises])
    # The first is that of the tissue which is loaded, not of a tooth.
    first, last = rises[1], rises[-1]
    return Teeth(
        float(np.mean(felt[first + 1 : last + 1])),
        float(np.diff(crossed[1:]).mean()),
        float(work[last] - work[first]),
        float(crossed[-1] - crossed[1]),
        float(np.ptp(felt[first + 1 : last + 1])),
        count,
        cpu,
    )


def felt_by_hand(cell: float, crack: float = CRACK) -> tuple[Teeth, float]:
    """Draw the blade by the force loop at 1 kHz over the tissue at 30 Hz.

    Args:
        cell: edge of a cube of twelve tetrahedra [m].
        crack: length of a step [m].

    Returns:
        Teeth of the commanded force, and its largest fall from tick to tick [N].
    """
    resistance = Resistance(0.02, SLICED, 0.0, crack_length=crack)
    simulation = block('stiffening', resistance, FIRM, cell, 30.0, SIZE)
    device, haptics = DeviceSettings(), HapticsSettings(soft_start=0.0, max_damping=0.0)
    path = ForcePath(TOOL, device, haptics, device.load_profile(), constants=BladeConstants(crack))
    session = InProcess(path, Tissue(simulation, make_method(CuttingSettings())), 30.0)
    top, lowest = float(simulation.mesh.rest[:, 2].max()), -TOOL.blade_tip[2]
    down = round(1e3 * (DEPTH + 0.002) / ENTRY)
    heights = np.interp(np.arange(down), [0, down], [top + 0.002, top - DEPTH]) + lowest
    along = (
        START + np.maximum(np.arange(-_SETTLES_MS, round(1e3 * STROKE / SPEED)), 0) * SPEED / 1e3
    )
    began, felt, work = time.thread_time(), [], []
    for x, z in [*((START, z) for z in heights), *((x, heights[-1]) for x in along)]:
        wrench = session.tick(np.array([x, SIZE[1] / 2 + 0.0007, z])).wrench
        felt.append(-wrench[0])
        work.append(0.0 if simulation.blade is None else simulation.blade.paid)
    forces, paid, count = np.array(felt[down:]), np.array(work[down:]), len(simulation.mesh.rest)
    found = _measured(along, forces, paid, count, time.thread_time() - began)
    return found, float(-np.diff(forces).min())


def run_sawtooth(quick: bool) -> list[Result]:
    """Return mean force and length of the teeth, by mesh and rate of frames."""
    results = []
    for cell, rate in RUNS[:2] if quick else RUNS:
        found = teeth(cell, rate)
        for name, unit, exact, value in (
            ('mean force', 'N', SLICED * DEPTH, found.mean),
            ('length of a tooth', 'm', CRACK, found.length),
            ('work of cutting', 'J', SLICED * DEPTH * found.way, found.paid),
        ):
            results.append(
                Result(
                    f'{name}, {rate:g} frames/s',
                    'stiffening',
                    found.tetrahedra,
                    unit,
                    exact,
                    value,
                    value / exact - 1,
                    found.cpu,
                )
            )
    return results
