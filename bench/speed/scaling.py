"""`trainer bench-scaling`: growth of the costs with the size of the mesh."""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich import box as borders
from rich.console import Console
from rich.table import Table

from bench.common.clock import by_turns
from bench.speed.cut import block_of, stroke_costs
from bench.speed.tissue import box, liver_material, steps_of
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder
from cutting_trainer.tissue_sim.warm_up import warm_up

SIZES = (1_000, 4_000, 16_000, 63_000, 180_000, 500_000)
REGION_NODES = 500
_NAMES = {
    'step': 'step, linear, all nodes',
    'region': f'frame at {REGION_NODES} nodes moving, by substep',
    'encode': 'encode, all nodes',
    'encode_cut': 'encode with a cut',
    'batch': 'cut batch',
    'start': 'mesh and tissue made',
}


@dataclass(frozen=True)
class Line:
    """One cost over the size of the mesh.

    Attributes:
        name: of the cost.
        tetrahedra: shape (s,).
        milliseconds: medians, shape (s,).
        exponent: of the power of the size that fits all of it.
        steepest: the largest exponent between two sizes next to each other.
    """

    name: str
    tetrahedra: list[int]
    milliseconds: list[float]
    exponent: float
    steepest: float


def line(name: str, tetrahedra: list[int], milliseconds: list[float]) -> Line:
    """Return a cost with the power law that fits it best."""
    x, y = np.log(tetrahedra), np.log(milliseconds)
    slopes = np.diff(y) / np.diff(x)
    fitted = float(np.polyfit(x, y, 1)[0])
    return Line(name, tetrahedra, milliseconds, fitted, float(slopes.max()))


def run_scaling(output: Path, sizes: list[int], *, as_json: bool) -> None:
    """Measure, print, and write the picture and its figures.

    Args:
        output: folder; charts/ in it takes the picture.
        sizes: in tetrahedra, two at least; none: SIZES.
    """
    lines = measure(sizes or list(SIZES))
    folder = output / 'charts'
    folder.mkdir(parents=True, exist_ok=True)
    picture(lines).savefig(folder / 'scaling.png', dpi=110, bbox_inches='tight')
    report = [asdict(entry) for entry in lines]
    (folder / 'scaling.json').write_text(json.dumps(report, indent=1) + '\n')
    console = Console()
    if as_json:
        console.out(json.dumps(report, indent=2), highlight=False)
        return
    table = Table(title='Processor time [ms]', box=borders.SIMPLE_HEAD)
    for column in ('', *(f'{size}' for size in lines[0].tetrahedra), 'exponent', 'steepest'):
        table.add_column(column, justify='right' if column else 'left')
    for entry in lines:
        cells = (f'{value:.3g}' for value in entry.milliseconds)
        table.add_row(entry.name, *cells, f'{entry.exponent:.2f}', f'{entry.steepest:.2f}')
    console.print(table)


def measure(sizes: list[int]) -> list[Line]:
    """Return all costs at all sizes; that of a batch at the sizes of its own blocks."""
    found: dict[str, list[float]] = {name: [] for name in _NAMES}
    counts, blocks = [], []
    warm_up()
    for size in sizes:
        start = time.thread_time()
        mesh = box(size)
        simulation = _tissue(mesh, ActiveSettings())
        found['start'].append(1e3 * (time.thread_time() - start))
        counts.append(len(mesh.tetrahedra))
        found['step'].append(_step(simulation))
        found['region'].append(_frame(_tissue(mesh, ActiveSettings('budget', REGION_NODES))))
        plain, cut = _encode(mesh)
        found['encode'].append(plain)
        found['encode_cut'].append(cut)
        cells = block_of(size)
        found['batch'].append(float(np.median(stroke_costs(cells, 3).batch)))
        blocks.append(12 * cells[0] * cells[1] * cells[2])
    return [
        line(label, blocks if name == 'batch' else counts, found[name])
        for name, label in _NAMES.items()
    ]


def _tissue(mesh: TetMesh, active: ActiveSettings) -> TissueSimulation:
    stepping = TimeStepping('symplectic_euler', max_substeps=2000)
    resistance = Resistance(10.0, 30.0, 5.0)
    return TissueSimulation(mesh, liver_material(), resistance, stepping=stepping, active=active)


def _step(simulation: TissueSimulation) -> float:
    dynamics, count = simulation.dynamics, 8
    dt = 0.8 * dynamics.time_steps.bound()
    steps = steps_of(simulation.model, dynamics.masses.inverse, 'symplectic_euler', dt, count)
    return 1e3 * float(np.median(by_turns(steps))) / count


def _frame(simulation: TissueSimulation) -> float:
    mesh, times = simulation.mesh, []
    for number in range(16):
        depth = 1e-3 * min(number / 6, 1.0)
        place, down = np.array([0.05, 0.05, 0.04]), np.array([0.0, 0.0, -1.0])
        contact = indenter_contact(mesh, place, down, depth)
        start = time.thread_time()
        frame = simulation.frame(contact)
        times.append((time.thread_time() - start) / frame.substeps)
    return 1e3 * float(np.median(times[6:]))


def _encode(mesh: TetMesh) -> tuple[float, float]:
    touched = mesh.apply(TopologyDelta(removed_tetrahedra=np.array([0])))
    before = np.zeros((mesh.node_count, 3))
    after = before + 1e-4
    times = by_turns(
        lambda: DeltaEncoder(mesh, before).encode(after, 1, 0, None, 0),
        lambda: DeltaEncoder(mesh, before).encode(after, 1, 0, touched, 0),
    )
    plain, cut = np.median(times, axis=0)
    return 1e3 * float(plain), 1e3 * float(cut)


def picture(lines: list[Line]) -> Figure:
    """Return processor time over the number of tetrahedra, both logarithmic."""
    figure = Figure(figsize=(7, 4.5))
    axes = figure.add_subplot()
    for entry in lines:
        label = f'{entry.name} (exponent {entry.exponent:.2f})'
        axes.loglog(entry.tetrahedra, entry.milliseconds, marker='o', ms=4, label=label)
    axes.set_xlabel('tetrahedra')
    axes.set_ylabel('processor time [ms]')
    axes.grid(which='both', alpha=0.3)
    axes.legend(fontsize=8, loc='upper left', bbox_to_anchor=(1.01, 1.0))
    return figure
