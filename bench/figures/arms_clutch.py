"""Re-indexings of a hand that touches and cuts, beside the same motion without a clutch.

Two sessions run tick by tick beside each other. In both the tool makes the same random motion, and
stands still at the same random times. In one the hand stands still with it; in the other the clutch
takes it off, it moves and turns at random, and takes the tool again.

`./trainer run python -m bench.figures.arms_clutch --rounds 40 --each 25` makes a thousand.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bench.cuts.strokes import good_block
from bench.figures.figure import Figure
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
    Transform,
)
from cutting_trainer.node_common.cdr_codec import ContactCodec
from cutting_trainer.session.in_process import InProcess, Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

ROUNDS = 2
"""Sessions, each with a new tissue; one half touches, the other cuts."""
PER_ROUND = 10
SOFT_START_S, SETTLED_MS = 0.1, 120
"""[s] of the force after the clutch, and [ms] after which it is compared again."""
SLEW_MS = 12
"""[ms] in which the force is down to zero."""
FRAME = Transform(translation=(0.01, -0.02, 0.03), rotation_rpy_deg=(20, -35, 110), scale=1.3)
PROFILE = DeviceProfile(max_force=3.3, max_slew=500.0, max_stiffness=1000.0)
TOOL = ToolSettings(
    radius=0.002, coupling_stiffness=400.0, blade_root=(0, 0, 0.028), blade_tip=(0, 0, -0.002)
)
_CELLS, _CELL = (16, 6, 4), 0.005
_TOP = _CELLS[2] * _CELL
_DOWN_MS, _REST_MS = 400, 300
_AT = ContactCodec.fields


@dataclass
class Measured:
    """Worst of all re-indexings.

    Attributes:
        beside: difference of the force on the hand from that without clutch, before and after, as a
            share of the largest force.
        clutched: force on the hand while clutched [N].
        jump: way of the tool from where it is without clutch [m].
        count: number of re-indexings.
        loaded: number of them that began in contact.
    """

    beside: float = 0.0
    clutched: float = 0.0
    jump: float = 0.0
    count: int = 0
    loaded: int = 0


def _session(cuts: bool) -> InProcess:
    nodes, tetrahedra = good_block(_CELLS, _CELL, seed=3)
    simulation = TissueSimulation(
        TetMesh(nodes, tetrahedra, nodes[:, 2] < 1e-9),
        Material(20000.0, 0.4, 1000.0, 5.0, 2e-4),
        Resistance(0.05 if cuts else 100.0, 20.0, 5.0),
        stepping=TimeStepping(rate=30.0, max_substeps=1000),
    )
    haptics = HapticsSettings(soft_start=SOFT_START_S)
    device = DeviceSettings(tissue_from_device=FRAME)
    path = ForcePath(TOOL, device, haptics, PROFILE)
    return InProcess(path, Tissue(simulation, make_method(CuttingSettings())), 30.0)


class _Pair:
    """Two sessions whose tools make the same motion, one of them with a clutch."""

    def __init__(self, cuts: bool, seed: int, measured: Measured) -> None:
        self._without, self._with = _session(cuts), _session(cuts)
        self._cuts, self._random, self._found = cuts, np.random.default_rng(seed), measured
        self._base = Rotation.from_matrix(FRAME.rotation().T)
        begin = (0.015 if cuts else 0.04, 0.0138, _TOP + 0.006)
        self._tip, self._turn = np.array(begin), Rotation.identity()
        self._hand, self._held = FRAME.to_device(self._tip), self._base
        self._compares, self._free = 0, -1

    def move(self, tip: np.ndarray, turn: Rotation, ms: int) -> None:
        """Move the tool with an easy start and end."""
        start, began = self._tip, self._turn
        way = (turn * began.inv()).as_rotvec()
        for tick in range(1, ms + 1):
            part = tick / ms
            part = part**3 * (10 - 15 * part + 6 * part * part)
            self._step(start + part * (tip - start), Rotation.from_rotvec(part * way) * began)

    def _step(self, tip: np.ndarray, turn: Rotation) -> None:
        self._hand = self._hand + FRAME.rotation().T @ (tip - self._tip) / FRAME.scale
        turned = self._base * (turn * self._turn.inv()) * self._base.inv()
        self._held = turned * self._held
        self._tip, self._turn = tip, turn
        self._tick()

    def _tick(self) -> None:
        plain = self._without.tick(FRAME.to_device(self._tip), (self._base * self._turn).as_quat())
        other = self._with.tick(self._hand, self._held.as_quat())
        forces = np.array([plain.wrench[:3], other.wrench[:3]])
        for name in ('device', 'blade_root', 'blade_tip'):
            off = np.subtract(plain.contact[_AT[name]], other.contact[_AT[name]])
            self._found.jump = max(self._found.jump, float(np.linalg.norm(off)))
        self._state = int(plain.contact[1])
        self._compares += 1
        if self._free >= 0:
            self._free += 1
            if self._free > SLEW_MS:
                felt = float(np.linalg.norm(forces[1]))
                self._found.clutched = max(self._found.clutched, felt)
        elif self._compares > 0:
            off = np.linalg.norm(forces[1] - forces[0])
            self._found.beside = max(self._found.beside, float(off / PROFILE.max_force))

    def touch_down(self) -> None:
        """Bring the tool to the tissue, and let it come to rest."""
        deep = 0.012 if self._cuts else 0.003
        down = np.array([*self._tip[:2], _TOP + TOOL.radius - deep])
        self.move(down, self._turn, _DOWN_MS)
        self.move(down, self._turn, _REST_MS)

    def reindex(self, progress: float) -> None:
        """Move the tool, take the hand off and put it to the tool again on the way."""
        random = self._random
        if self._cuts:
            tip = np.array(
                [
                    0.018 + 0.03 * progress,
                    0.0138 + 4e-4 * random.standard_normal(),
                    _TOP + TOOL.radius - random.uniform(0.010, 0.013),
                ]
            )
            turn = Rotation.from_rotvec([0, 0, 0.1 * random.standard_normal()])
        else:
            place = [0.04, 0.015] + 0.003 * random.uniform(-1, 1, 2)
            tip = np.array([*place, _TOP + TOOL.radius - random.uniform(0.001, 0.004)])
            turn = Rotation.from_rotvec(0.2 * random.standard_normal(3))
        middle = self._tip + random.uniform(0.2, 0.8) * (tip - self._tip)
        half = Rotation.from_rotvec((turn * self._turn.inv()).as_rotvec() / 2) * self._turn
        self.move(middle, half, int(random.integers(40, 80)))
        self._found.count += 1
        self._found.loaded += self._state == (INSIDE if self._cuts else TOUCHING)
        self._clutch(True)
        self._wander(int(random.integers(30, 120)))
        self._clutch(False)
        self.move(tip, turn, int(random.integers(40, 80)))
        self.move(tip, turn, SETTLED_MS)

    def _clutch(self, pressed: bool) -> None:
        self._with.path.coupling.change(clutched=pressed)
        self._free = 0 if pressed else -1
        self._compares = -SETTLED_MS

    def _wander(self, ms: int) -> None:
        """Move and turn the hand alone."""
        start, began = self._hand, self._held
        way = self._random.uniform(-0.04, 0.04, 3)
        turn = self._random.uniform(-0.6, 0.6, 3)
        for tick in range(1, ms + 1):
            part = tick / ms
            part = part**3 * (10 - 15 * part + 6 * part * part)
            self._hand, self._held = start + part * way, Rotation.from_rotvec(part * turn) * began
            self._tick()


def measured(rounds: int = ROUNDS, per_round: int = PER_ROUND) -> Measured:
    """Make re-indexings in new tissues, one half touched and the other cut."""
    found = Measured()
    for number in range(rounds):
        pair = _Pair(number % 2 == 1, number, found)
        pair.touch_down()
        for turn in range(per_round):
            pair.reindex(turn / per_round)
    return found


def measure(rounds: int = ROUNDS, per_round: int = PER_ROUND) -> list[Figure]:
    """Return the figures of a number of sessions."""
    found = measured(rounds, per_round)
    if found.loaded < 0.9 * found.count:
        raise RuntimeError(f'{found.loaded} of {found.count} re-indexings began in contact')
    n, jump = found.count, 1e3 * found.jump
    name = 'force before and after re-indexing, off that without clutch, over max_force'
    return [
        Figure(2, name, found.beside, 0.02, 'at most', '', n),
        Figure(2, 'force while clutched', found.clutched, 0.0, 'at most', 'N', n),
        Figure(2, 'way of the tool off that without clutch', jump, 0.1, 'at most', 'mm', n),
    ]


def main() -> int:
    """Print the figures; return 1 where one falls short."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rounds', type=int, default=ROUNDS, help='number of sessions')
    parser.add_argument('--each', type=int, default=PER_ROUND, help='re-indexings of each')
    options = parser.parse_args()
    figures = measure(options.rounds, options.each)
    for figure in figures:
        verdict = 'ok   ' if figure.passes else 'SHORT'
        print(f'{verdict} {figure.name}: {figure.value:.5g}, {figure.side} {figure.bound:.5g}')
    return 0 if all(figure.passes for figure in figures) else 1


if __name__ == '__main__':
    sys.exit(main())
