"""Stability map: conditions under which the hand can hold the tool still.

An emulated arm with a hand on it presses a block of tissue through the whole force path, in a
closed loop in one process, with delay, jitter and loss between force path and tissue. A cell of the
map is the worst of a few such runs.
"""

import itertools
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cutting_trainer.haptic_bridge.emulated_arm.arm import EmulatedArm
from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.force_path import ENERGY_CREDIT_J, ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.in_process import TICK_S, InProcess, LinkSettings, Tissue
from cutting_trainer.session.scene_loader import SCENES
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.files import load_mesh
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

LAWS = ('constant', 'time', 'position', 'local_stiffness')
HAND_STIFFNESSES = (30.0, 100.0, 300.0, 1000.0)
"""[N/m] limp to stiff."""
TISSUE_STIFFNESSES = (50.0, 150.0, 400.0, 1000.0)
"""[N/m] of a point of the tissue, before the coupling spring."""
DELAYS = (0.0, 0.01, 0.025, 0.05, 0.075, 0.1)
"""[s] each way."""
LOSSES = (0.0, 0.05, 0.1, 0.2)
RELATIVE_JITTER = 0.2
"""Largest lateness beyond the delay, as a part of it."""
SEEDS = (1, 2, 3)
MAX_HELD_MOTION_M = 3e-4
"""[m] from peak to peak that a held tool may move at the end of a rest."""
RADIUS = 0.004
DEPTH = 0.006
COUPLING_STIFFNESS = 1000.0
"""[N/m]: the largest stiffness that the emulated device renders."""
_TOP = 0.01
_PLACE = (0.002, 0.003)
_YOUNG_BY_STIFFNESS = 1000.0 / 88.0
"""[1/m] Young's modulus of the block over the stiffness of the pressed point."""
_REST_ENDS = (1.2, 2.3)
_OBSERVED_S = 0.3
_START_DELAY_S = 0.1
"""[s] and the way forth and back: the tool sets out when the tissue has been heard of."""
_DURATION_S = 2.7
_MAX_DELAY, _MAX_LOSS = 0.05, 0.05
"""Up to which the default must be stable and passive everywhere."""


@dataclass(frozen=True)
class Place:
    """Condition of a run. Stiffness [N/m], delay [s] each way, loss as a share of the messages."""

    law: str
    hand: float
    tissue: float
    delay: float
    loss: float


@dataclass(frozen=True)
class Cell(Place):
    """A place without or with the passivity controller."""

    controlled: bool


@dataclass(frozen=True)
class Outcome:
    """Result of the runs of a cell.

    Attributes:
        swing: peak to peak of the tool at the end of the rests, the worst of them [m].
        made: largest net energy from the motors to the hand [J].
        controller_due: whether a passivity controller had something to do, or would have had.
    """

    swing: float = 0.0
    made: float = 0.0
    controller_due: bool = False

    @property
    def stable(self) -> bool:
        """The tool is at rest when the hand is."""
        return self.swing <= MAX_HELD_MOTION_M

    @property
    def passive(self) -> bool:
        """The motors gave the hand no more than the credit that the force path has."""
        return self.made <= ENERGY_CREDIT_J

    def worse(self, other: 'Outcome') -> 'Outcome':
        """Return the worse of two, figure by figure."""
        return Outcome(
            max(self.swing, other.swing),
            max(self.made, other.made),
            self.controller_due or other.controller_due,
        )


@dataclass(frozen=True)
class Count:
    """How many cells of a law are stable, and passive too (`both`): of all, and of those where the
    default must be (`bound`).
    """

    law: str
    controlled: bool
    cells: int
    stable: int
    both: int
    bound: int
    both_bound: int


def places(laws: tuple[str, ...] = LAWS) -> list[Place]:
    """Return the whole map."""
    axes = (laws, HAND_STIFFNESSES, TISSUE_STIFFNESSES, DELAYS, LOSSES)
    return [Place(*values) for values in itertools.product(*axes)]


def run_place(place: Place) -> dict[Cell, Outcome]:
    """Return the worst of all seeds, without the passivity controller and with it.

    A cell is done with the first seed that is not stable. Where the observer of a run without the
    controller calls for nothing, the run with it is the same.
    """
    bare, controlled = Outcome(), Outcome()
    for seed in SEEDS if place.delay or place.loss else SEEDS[:1]:
        run = run_once(place, False, seed) if bare.stable or controlled.stable else None
        if run is None:
            break
        if controlled.stable:
            due = run.controller_due
            controlled = controlled.worse(run_once(place, True, seed) if due else run)
        bare = bare.worse(run) if bare.stable else bare
    values = asdict(place)
    return {Cell(**values, controlled=c): o for c, o in ((False, bare), (True, controlled))}


def run_once(place: Place, controlled: bool, seed: int) -> Outcome:
    """Press, rest, release, press again, rest, and leave."""
    device = DeviceSettings()
    haptics = HapticsSettings.model_validate(
        {'extrapolation': place.law, 'soft_start': 0.0}
        | ({} if controlled else {'max_damping': 0.0})
    )
    tool = ToolSettings(radius=RADIUS, coupling_stiffness=COUPLING_STIFFNESS)
    path = ForcePath(tool, device, haptics, device.load_profile())
    link = LinkSettings(place.delay, place.loss, RELATIVE_JITTER * place.delay, seed=seed)
    session = InProcess(path, Tissue(block(place.tissue)), 30.0, link)
    arm = _arm(place.hand, device)
    session.wait(_START_DELAY_S + 2 * place.delay, arm.position)
    arm.script_running = True
    heights = np.empty(round(_DURATION_S / TICK_S))
    given = most = least = 0.0
    for i in range(len(heights)):
        wrench = session.tick(arm.position, arm.orientation).wrench
        before = arm.true_position.copy()
        now = 1 + round(i * TICK_S * 1e9)
        arm.command(now, wrench[:3], now)
        arm.advance(now, enabled=True)
        given += float(arm.force @ (arm.true_position - before))
        most = max(most, given)
        least = min(least, path.energy)
        heights[i] = arm.true_position[2]
    swings = [
        np.ptp(heights[round((end - _OBSERVED_S) / TICK_S) : round(end / TICK_S)])
        for end in _REST_ENDS
    ]
    return Outcome(float(max(swings)), most, least < -ENERGY_CREDIT_J)


def tip_over(device: DeviceSettings, height: float) -> np.ndarray:
    """Return device position of a tip at a height over the touch [m], shape (3,)."""
    return device.tissue_from_device.to_device(np.array([*_PLACE, _TOP + RADIUS + height]))


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
    return EmulatedArm(settings, EmulatedHand(settings.hand, compiled))


def block(stiffness: float) -> TissueSimulation:
    """Return a block of which the pressed point has a stiffness [N/m], at any depth."""
    nodes, tetrahedra = load_mesh(SCENES.parent / 'meshes' / 'block_yi2007.msh', 1.0)
    return TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-6),
        Material(_YOUNG_BY_STIFFNESS * stiffness, 0.45, 1060.0, 15.0, 1e-4),
        Resistance(1e3, 100.0, 10.0),
        stepping=TimeStepping(max_substeps=2000),
        contact='triangle',
    )


def counts(results: dict[Cell, Outcome]) -> list[Count]:
    """Count the cells by law, without and with the controller."""
    found = []
    for law in dict.fromkeys(cell.law for cell in results):
        for controlled in (False, True):
            all_ = [
                (o.stable, o.stable and o.passive, _is_bound(cell))
                for cell, o in results.items()
                if cell.law == law and cell.controlled == controlled
            ]
            bound = [both for _, both, within in all_ if within]
            stable, both = (sum(column) for column in list(zip(*all_, strict=True))[:2])
            found.append(Count(law, controlled, len(all_), stable, both, len(bound), sum(bound)))
    return found


def _is_bound(place: Place) -> bool:
    """Return whether the default must be stable and passive there."""
    return place.delay <= _MAX_DELAY and place.loss <= _MAX_LOSS


def default_failures(results: dict[Cell, Outcome]) -> list[str]:
    """Return failures of the default up to 50 ms each way and 5 % loss."""
    default = HapticsSettings().extrapolation
    return [
        f'{cell}: swings {1e3 * out.swing:.2f} mm, makes {1e3 * out.made:.2f} mJ'
        for cell, out in results.items()
        if cell.law == default
        and cell.controlled
        and _is_bound(cell)
        and not (out.stable and out.passive)
    ]
