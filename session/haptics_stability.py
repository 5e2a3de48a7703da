"""Where the hand can hold the tool still: the command `trainer haptics-stability`.

An emulated arm with a hand on it presses a block of tissue through the whole force path, in a
closed loop in one process, with delay and loss between force path and tissue. A cell of the map is
one such run.
"""

import csv
import itertools
import os
from dataclasses import astuple, dataclass, fields
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from haptic_bridge.arm import EmulatedArm
from haptic_bridge.arm_settings import ArmSettings
from haptic_bridge.force_path import ENERGY_CREDIT, ForcePath
from haptic_bridge.hand import Hand, compile_script
from haptic_bridge.settings import DeviceSettings, HapticsSettings, ToolSettings
from session.errors import SessionError
from session.in_process import TICK, InProcess, LinkSettings, Tissue
from session.scene import SCENES
from tissue_sim.blade import Resistance
from tissue_sim.dynamics import TimeStepping
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.mesh_io import load_mesh
from tissue_sim.simulation import TissueSimulation

LAWS = ('constant', 'time', 'position', 'local_stiffness')
HANDS = (50.0, 200.0, 1000.0)
"""[N/m] limp to stiff."""
TISSUES = (50.0, 200.0, 1000.0)
"""[N/m] of a point of the tissue, before the coupling spring."""
DELAYS = (0.0, 0.025, 0.05, 0.1)
"""[s] each way."""
LOSSES = (0.0, 0.05, 0.2)
STILL = 3e-4
"""[m] from peak to peak that a held tool may move at the end of a rest."""
RADIUS = 0.004
DEPTH = 0.006
COUPLING = 1000.0
"""[N/m]: the largest stiffness that the emulated device renders."""
_TOP = 0.01
_PLACE = (0.002, 0.003)
_YOUNG_BY_STIFFNESS = 1000.0 / 88.0
"""[1/m] Young's modulus of the block over the stiffness of the pressed point."""
_REST_ENDS = (1.2, 2.3)
_WATCHED = 0.3
_SECONDS = 2.7
_MOST_DELAY, _MOST_LOSS = 0.05, 0.05
"""Up to which the default must be stable and passive everywhere."""


@dataclass(frozen=True)
class Cell:
    """What is run. Stiffness [N/m], delay [s] each way, loss as a share of the messages."""

    law: str
    controlled: bool
    hand: float
    tissue: float
    delay: float
    loss: float


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    Attributes:
        swing: peak to peak of the tool at the end of the rests, the worse of them [m].
        made: most energy that the motors had given to the hand, net of what they got [J].
    """

    swing: float
    made: float

    @property
    def stable(self) -> bool:
        """The tool is at rest when the hand is."""
        return self.swing <= STILL

    @property
    def passive(self) -> bool:
        """The motors gave the hand no more than the credit that the force path has."""
        return self.made <= ENERGY_CREDIT


def cells(laws: tuple[str, ...] = LAWS) -> list[Cell]:
    """The whole map."""
    axes = (laws, (False, True), HANDS, TISSUES, DELAYS, LOSSES)
    return [Cell(*values) for values in itertools.product(*axes)]


def run_cell(cell: Cell) -> Outcome:
    """Presses, rests, lets go, presses again, rests, and leaves."""
    device = DeviceSettings()
    haptics = HapticsSettings.model_validate(
        {'extrapolation': cell.law, 'soft_start': 0.0}
        | ({} if cell.controlled else {'max_damping': 0.0})
    )
    tool = ToolSettings(radius=RADIUS, coupling_stiffness=COUPLING)
    path = ForcePath(tool, device, haptics, device.load_profile())
    link = LinkSettings(delay=cell.delay, loss=cell.loss, seed=1)
    session = InProcess(path, Tissue(_block(cell.tissue)), 30.0, link)
    arm = _arm(cell.hand, device)
    arm.script_running = True
    heights = np.empty(round(_SECONDS / TICK))
    given = most = 0.0
    for i in range(len(heights)):
        wrench = session.tick(arm.position, arm.orientation).wrench
        before = arm.true_position.copy()
        now = 1 + round(i * TICK * 1e9)
        arm.command(now, wrench[:3], now)
        arm.advance(now, enabled=True)
        given += float(arm.force @ (arm.true_position - before))
        most = max(most, given)
        heights[i] = arm.true_position[2]
    swings = [
        np.ptp(heights[round((end - _WATCHED) / TICK) : round(end / TICK)]) for end in _REST_ENDS
    ]
    return Outcome(float(max(swings)), most)


def _arm(stiffness: float, device: DeviceSettings) -> EmulatedArm:
    def at(height: float, share: float) -> dict[str, Any]:
        return {'position': (*_PLACE, _TOP + RADIUS + height), 'share': share}

    way = ((-DEPTH, 0.3), (-DEPTH, 0.9), (0.002, 0.15), (-DEPTH, 0.15), (-DEPTH, 0.8), (0.004, 0.3))
    script = {
        'start': {'position': (*_PLACE, _TOP + RADIUS + 0.003)},
        'seconds': sum(share for _, share in way),
        'phases': [{'kind': 'palpate', 'waypoints': [at(*point) for point in way]}],
    }
    hand = {'stiffness': stiffness, 'damping': 0.4 * stiffness**0.5}
    settings = ArmSettings.model_validate({'hand': hand, 'script': script})
    compiled = compile_script(settings.script, device.tissue_from_device)
    return EmulatedArm(settings, Hand(settings.hand, compiled))


def _block(stiffness: float) -> TissueSimulation:
    nodes, tetrahedra = load_mesh(SCENES.parent / 'meshes' / 'block_yi2007.msh', 1.0)
    return TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-6),
        Material(_YOUNG_BY_STIFFNESS * stiffness, 0.45, 1060.0, 15.0, 1e-4),
        Resistance(1e3, 100.0, 10.0),
        stepping=TimeStepping(max_substeps=2000),
    )


def run_stability(folder: Path, laws: tuple[str, ...] = LAWS) -> list[str]:
    """Runs the map; writes the table and the pictures to a folder.

    Args:
        folder: that exists.
        laws: of extrapolation.

    Returns:
        What the default does not keep, in sentences.

    Raises:
        SessionError: the folder does not exist.
    """
    from session.haptics_pictures import draw_stability

    if not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, the map goes into it')
    console, todo = Console(highlight=False), cells(laws)
    outcomes: list[Outcome] = []
    with console.status('') as line, get_context('spawn').Pool(os.cpu_count() or 1) as pool:
        for outcome in pool.imap(run_cell, todo, chunksize=4):
            outcomes.append(outcome)
            line.update(f'{len(outcomes)} of {len(todo)} runs')
    results = dict(zip(todo, outcomes, strict=True))
    write_map(folder / 'haptics-stability.csv', results)
    draw_stability(folder / 'images' / 'haptics-stability.png', results)
    console.print(f'{folder / "haptics-stability.csv"} has {len(results)} rows')
    return broken(results)


def broken(results: dict[Cell, Outcome]) -> list[str]:
    """What the default does not keep up to 50 ms each way and 5 % loss."""
    default = HapticsSettings().extrapolation
    return [
        f'{cell}: swings {1e3 * out.swing:.2f} mm, makes {1e3 * out.made:.2f} mJ'
        for cell, out in results.items()
        if cell.law == default
        and cell.controlled
        and cell.delay <= _MOST_DELAY
        and cell.loss <= _MOST_LOSS
        and not (out.stable and out.passive)
    ]


def write_map(file: Path, results: dict[Cell, Outcome]) -> None:
    """Writes every run as a row."""
    with file.open('w', newline='', encoding='utf-8') as out:
        rows = csv.writer(out, lineterminator='\n')
        names = [field.name for field in fields(Cell)]
        rows.writerow([*names, 'swing_m', 'made_joule', 'stable', 'passive'])
        for cell, o in results.items():
            numbers = (f'{o.swing:.6g}', f'{o.made:.6g}', int(o.stable), int(o.passive))
            rows.writerow([*astuple(cell), *numbers])
