"""Random loads, cuts and yanks of sliver meshes with the law that stiffens.

A round grips the tissue and yanks it by 3 cm a frame, presses it, or cuts it and yanks the blade;
then it lets go for a second. Meshes are independent: each is kept in a file as soon as it is done,
so that a run that was stopped goes on.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from bench.common.meshes import kuhn_block
from bench.speed.strokes import blade_contact
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import HOLD, Coupling
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact, indenter_contact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

SIZE_M = np.array([0.025, 0.02, 0.02])
STIFFENING = 6.0
LOADED_FRAMES, RELEASED_FRAMES = 20, 30
ROUNDS = 10
"""Rounds of a mesh: 500 frames, 10 releases."""
MAX_AWAY = 0.1
"""|J - 1| a second after a release, at most, where the law counts."""
_YANK_M, _DEPTH_M, _BLADE_STEP_M = 0.03, 0.012, 2e-3
_CELLS, _JITTER = (5, 4, 4), 0.24
_UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Outcome:
    """Result of one mesh.

    Attributes:
        mesh: its number, and the seed of all that is random.
        frames, releases: how many.
        bad: frames with a number that is not finite.
        said: frames that said what went wrong.
        silent: frames that were rolled back without a word.
        least, largest: ratio of volumes J a second after a release, where the law counts.
        inverted: elements inside out then, at most.
        cut: elements.
    """

    mesh: int
    frames: int = 0
    releases: int = 0
    bad: int = 0
    said: int = 0
    silent: int = 0
    least: float = 1.0
    largest: float = 1.0
    inverted: int = 0
    cut: int = 0

    @property
    def away(self) -> float:
        """Largest |J - 1| a second after a release."""
        return max(1.0 - self.least, self.largest - 1.0)

    @property
    def failed(self) -> bool:
        """Whether a claim does not hold."""
        return bool(self.bad or self.silent or self.inverted or self.away > MAX_AWAY)


def run_yanks(meshes: int, seed: int, file: Path) -> Status:
    """Load, cut and yank so many meshes, and print the result of each.

    Args:
        meshes: how many.
        seed: of the first; the others follow.
        file: of outcomes, one a line; those in it are not run again.
    """
    console = Console(soft_wrap=True, highlight=False)
    known = {o.mesh: o for o in read_outcomes(file)}
    outcomes = []
    for number in range(seed, seed + meshes):
        outcome = known.get(number)
        if outcome is None:
            outcome = torture(number)
            with file.open('a', encoding='utf-8') as out:
                out.write(json.dumps(asdict(outcome)) + '\n')
        outcomes.append(outcome)
        console.print(
            f'mesh {number}: {outcome.frames} frames, {outcome.cut} elements cut, '
            f'{outcome.said} frames said what went wrong, {outcome.bad} not finite, '
            f'{outcome.silent} silent; a second after release J {outcome.least:.2f} to '
            f'{outcome.largest:.2f}, {outcome.inverted} elements inside out'
        )
    failed = [o for o in outcomes if o.failed]
    console.print(
        f'{sum(o.frames for o in outcomes)} frames, {sum(o.releases for o in outcomes)} releases: '
        f'{len(failed)} of {len(outcomes)} meshes failed'
    )
    return Status.FAILED if failed else Status.OK


def read_outcomes(file: Path) -> list[Outcome]:
    """Return the outcomes in a file; none without it. A line that was cut off is left out."""
    outcomes = []
    for line in file.read_text(encoding='utf-8').splitlines() if file.is_file() else []:
        try:
            outcomes.append(Outcome(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return outcomes


def torture(number: int, rounds: int = ROUNDS) -> Outcome:
    """Load, cut and yank one mesh.

    Args:
        number: of the mesh.
        rounds: of a second and two thirds each.
    """
    rng = np.random.default_rng(number)
    simulation = TissueSimulation(
        _slivers(rng),
        Material(5400.0, 0.45, 1060.0, 15.0, 1e-4, STIFFENING),
        Resistance(0.3, 164.0, 5.0),
        model='stiffening',
        stepping=TimeStepping('symplectic_euler', max_substeps=2000),
    )
    tissue, outcome = Tissue(simulation, make_method(CuttingSettings())), Outcome(number)
    for _ in range(rounds):
        kind = rng.integers(3)
        if kind == 0:
            _yank(simulation, rng, outcome)
        else:
            contacts = _pressed if kind == 1 else _cut
            for contact in contacts(simulation.mesh, rng):
                _note(tissue, contact, outcome)
        for _ in range(RELEASED_FRAMES):
            strain = _note(tissue, None, outcome)
        outcome.releases += 1
        outcome.least = min(outcome.least, strain[0])
        outcome.largest = max(outcome.largest, strain[1])
        outcome.inverted = max(outcome.inverted, simulation.dynamics.inverted)
    outcome.cut = simulation.elements_cut
    return outcome


def _slivers(rng: np.random.Generator) -> TetMesh:
    mesh = kuhn_block(_CELLS, SIZE_M)
    nodes = mesh.rest.copy()
    inner = ((nodes > 1e-9) & (nodes < SIZE_M - 1e-9)).all(axis=1)
    nodes[inner] += rng.uniform(-_JITTER, _JITTER, (int(inner.sum()), 3)) * 0.005
    return TetMesh(nodes, mesh.tetrahedra, nodes[:, 2] < 1e-9)


def _note(tissue: Tissue, contact: ToolContact | None, outcome: Outcome) -> tuple[float, float]:
    """Simulate and judge a frame; return least and largest J where the law counts."""
    frame, simulation = tissue.frame(contact), tissue.simulation
    finite = np.isfinite(simulation.displacement).all() and np.isfinite(simulation.velocity).all()
    _judge(outcome, bool(finite and np.isfinite(frame.force).all()), frame.diverged, frame.trouble)
    return (1.0, 1.0) if frame.strain is None else frame.strain.ratio


def _judge(outcome: Outcome, finite: bool, diverged: bool, trouble: str) -> None:
    outcome.frames += 1
    outcome.bad += not finite
    outcome.said += bool(trouble)
    outcome.silent += diverged and not trouble


def _yank(simulation: TissueSimulation, rng: np.random.Generator, outcome: Outcome) -> None:
    """Grip three nodes near a place of the upper side, and move them by up to 3 cm a frame."""
    mesh, top = simulation.mesh, np.append(rng.uniform(0.2, 0.8, 2), 1.0) * SIZE_M
    held = np.argsort(np.square(mesh.rest - top).sum(axis=1))[:3]
    here, share = mesh.rest[held].mean(axis=0), np.full(3, 1 / 3)
    for _ in range(LOADED_FRAMES):
        there = top + rng.normal(size=3) * _YANK_M / np.sqrt(3)
        spring = Coupling(HOLD, held, share, here, there, np.zeros(3), 200.0)
        motion = simulation.dynamics.advance(spring)
        finite = np.isfinite(motion.elastic_force).all() and np.isfinite(simulation.velocity).all()
        _judge(outcome, bool(finite), motion.diverged, motion.trouble)
        here = there


def _pressed(mesh: TetMesh, rng: np.random.Generator) -> Iterator[ToolContact]:
    """Press places of the upper side, another every five frames."""
    for k in range(LOADED_FRAMES):
        if k % 5 == 0:
            place = np.append(rng.uniform(0.1, 0.9, 2), 1.0) * SIZE_M
            way = rng.normal(size=3) * [0.4, 0.4, 0.0] - _UP
            way /= np.linalg.norm(way)
        yield indenter_contact(mesh, place, way, rng.uniform(0.0, _DEPTH_M))


def _cut(mesh: TetMesh, rng: np.random.Generator) -> Iterator[ToolContact]:
    """Push a blade in, draw it, and yank it by up to 3 cm a frame."""
    place = np.append(rng.uniform(0.2, 0.8, 2), 1.0) * SIZE_M
    turn = rng.uniform(0, 2 * np.pi)
    along, tip = np.array([np.cos(turn), np.sin(turn), 0.0]), place.copy()
    for k in range(LOADED_FRAMES):
        tip = tip + _BLADE_STEP_M * (-_UP if k < LOADED_FRAMES // 2 else along)
        if k >= LOADED_FRAMES - 4:
            tip = tip + rng.normal(size=3) * _YANK_M / np.sqrt(3)
        yield blade_contact(mesh, ContactState.TOUCHING, place, tip, _UP)
