"""Palpate and cut a block with a far field, and compare with all nodes moving, frame by frame.

Run `python -m bench.accuracy.far_field_session 197472 --nodes 500 1000`. A sphere goes in, rests,
slides, rests and comes out; then a blade cuts, and the sphere palpates beside the cut. The load of
the sphere is spread over 8 mm. Both sessions get the cuts of the one with all nodes moving, so that
they can be compared node by node.
"""

import argparse
import time
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.footprint import BLOCK, MATERIAL, block, touched
from bench.speed.strokes import blade_contact
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.session.in_process import answer
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.footprint import Footprints
from cutting_trainer.tissue_sim.contact.tool import (
    ContactState,
    CutOutcome,
    ToolContact,
    ToolMode,
    indenter_contact,
)
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming.messages import DeltaEncoder
from cutting_trainer.tissue_sim.warm_up import warm_up

Floats = NDArray[np.float64]

BRICKS = {51_744: (28, 28, 11), 197_472: (44, 44, 17)}
"""Of the block along its axes, by number of tetrahedra."""
_UP = np.array([0.0, 0.0, 1.0])
_RADIUS = 0.008
"""[m] of the sphere; its footprint is as wide at 3 mm of depth."""
_DEPTH = 0.004
_TOUGHNESS, _THRESHOLD, _FRICTION = 10.0, 0.1, 0.3
"""[J/m^2], [N], [-]: so low that the blade cuts steadily in the linear model. Where it sticks and
slips, as in the smoothed one, sessions part after the least difference."""
_ALPHA, _BETA, _GROWTH = 15.0, 1e-4, 1.1
"""[1/s], [s]; of the highest frequency by cuts, as in `liver`."""
_GOES, _RESTS, _SLIDES = 10, 8, 16
"""Frames."""
_STEP = 5e-4
"""[m] of the sliding sphere in a frame."""
_BLADE_STEP, _CUT_DEPTH, _CUT_LENGTH = 1e-3, 0.008, 0.024
"""[m] in a frame, and of the cut."""
_BESIDE = 0.006
"""[m] from the cut to the place that is palpated after it."""
_ENTERS, _PAUSE = 12, 4
"""Frames in which the blade breaks in and the swing after it fades; between cut and palpation."""


class Phase(NamedTuple):
    """Frames of a session.

    Attributes:
        first, end: number of the first frame, and of the one after the last.
        rests: frame at which a palpating tool is at rest; -1: none.
    """

    first: int
    end: int
    rests: int


PALPATED = Phase(0, 2 * _GOES + 2 * _RESTS + _SLIDES, _GOES + _RESTS - 1)
_CUT_END = PALPATED.end + round((_CUT_DEPTH + _CUT_LENGTH) / _BLADE_STEP)
ENTERED = Phase(PALPATED.end, PALPATED.end + _ENTERS, -1)
DRAWN = Phase(ENTERED.end, _CUT_END, -1)
AFTER = Phase(
    _CUT_END + _PAUSE,
    _CUT_END + _PAUSE + 2 * _GOES + _RESTS,
    _CUT_END + _PAUSE + _GOES + _RESTS - 1,
)
FRAMES = AFTER.end
PHASES = {
    'palpated': PALPATED,
    'as the blade breaks in': ENTERED,
    'as it is drawn': DRAWN,
    'palpated beside the cut': AFTER,
}


@dataclass(frozen=True)
class Course:
    """A session.

    Attributes:
        shapes: displacement after each frame [m], each shape (n, 3).
        forces: of the tissue on the tool [N], shape (f, 3).
        times: processor time of each frame with its delta [s], shape (f,).
        deltas: the cut that each frame began with, or None.
        elements_cut: their number.
    """

    shapes: list[Floats]
    forces: Floats
    times: Floats
    deltas: list[TopologyDelta | None]
    elements_cut: int


class Errors(NamedTuple):
    """Errors of a phase, against all nodes moving.

    Attributes:
        compliance: of the footprint's mean displacement over the force, at rest; NaN: no rest.
        worst: largest distance of a node from where it should be, over the largest displacement.
        force: rms, over the rms of the force.
    """

    compliance: float
    worst: float
    force: float


class FarFieldSession:
    """The session on a block.

    Args:
        tetrahedra: of `BRICKS`.
        seed: of the block.
        place: x and y that are palpated first [m]; the blade cuts there, too.
        model: of the tissue.
    """

    def __init__(
        self, tetrahedra: int, seed: int, place: tuple[float, float], model: ModelName
    ) -> None:
        self._bricks, self._seed = BRICKS[tetrahedra], seed
        self._model, self._place = model, np.array([*place, BLOCK[2]])

    def run(
        self,
        active: ActiveSettings,
        like: Course | None = None,
        frames: int = FRAMES,
        concession: int = 0,
    ) -> Course:
        """Return the session.

        Args:
            active: which nodes move.
            like: the session whose cuts are applied; None: `combined` cuts.
            frames: so many, from the first.
            concession: of every frame, see `FarField.concede`.
        """
        mesh = block(self._bricks, self._seed)
        simulation = TissueSimulation(
            mesh,
            replace(MATERIAL, alpha=_ALPHA, beta=_BETA),
            Resistance(_THRESHOLD, _TOUGHNESS, _FRICTION),
            model=self._model,
            stepping=TimeStepping('symplectic_euler', max_substeps=2000, frequency_growth=_GROWTH),
            active=active,
        )
        method, asks = make_method(CuttingSettings()), CutTransaction(simulation)
        encoder = DeltaEncoder(mesh, simulation.displacement)
        shapes, forces, times, deltas = [], [], [], []
        for number in range(frames):
            contact, delta = self._contact(mesh, number), None
            began, spent = time.thread_time(), 0.0
            if like is not None:
                delta = like.deltas[number]
            elif asks.due and asks.asked is not None:
                start = time.thread_time()
                outcome, found = answer(method, asks.asked, simulation)
                spent = time.thread_time() - start
                delta = found if outcome is CutOutcome.APPLIED else None
            if asks.due:
                asks.resolve(CutOutcome.EMPTY)
            touched_slots = None if delta is None else simulation.apply_cut(delta)
            frame = simulation.frame(contact, concession=concession)
            asks.ask(frame)
            encoder.encode(simulation.displacement, frame.step, 0, touched_slots, frame.step)
            times.append(time.thread_time() - began - spent)
            if frame.trouble:
                raise RuntimeError(f'frame {number}: {frame.trouble}')
            deltas.append(delta)
            shapes.append(simulation.displacement.copy())
            forces.append(frame.force)
        count = simulation.elements_cut
        return Course(shapes, np.array(forces), np.array(times), deltas, count)

    def errors(self, course: Course, exact: Course, phase: Phase) -> Errors:
        """Return the errors of a session in one of its phases."""
        some = range(phase.first, phase.end)
        away = [np.linalg.norm(course.shapes[k] - exact.shapes[k], axis=1).max() for k in some]
        largest = max(np.linalg.norm(exact.shapes[k], axis=1).max() for k in some)
        off, felt = (
            values[phase.first : phase.end]
            for values in (course.forces - exact.forces, exact.forces)
        )
        force = float(np.linalg.norm(off) / np.linalg.norm(felt))
        compliance = np.nan
        if phase.rests >= 0:
            ratio = self._compliance(course, phase) / self._compliance(exact, phase)
            compliance = abs(ratio - 1)
        return Errors(compliance, float(max(away) / largest), force)

    def _compliance(self, course: Course, phase: Phase) -> float:
        """Return mean displacement of the footprint by force [m/N]."""
        mesh = block(self._bricks, self._seed)
        place = self._place + (_BESIDE * np.array([0.0, 1.0, 0.0]) if phase is AFTER else 0.0)
        nodes, weights = touched(mesh, place[:2])
        found = Footprints(mesh).around(nodes, weights, _RADIUS)
        moved = course.shapes[phase.rests][found.nodes, 2]
        return float(found.weights @ moved / course.forces[phase.rests, 2])

    def _contact(self, mesh: TetMesh, number: int) -> ToolContact | None:
        if number < PALPATED.end:
            slide = min(max(number - _GOES - _RESTS, 0), _SLIDES)
            depth = min((number + 1) / _GOES, 1.0, (PALPATED.end - 1 - number) / _GOES)
            return self._sphere(
                mesh, self._place + np.array([_STEP * slide, 0.0, 0.0]), _DEPTH * depth
            )
        if number < DRAWN.end:
            return self._blade(mesh, number - ENTERED.first)
        if number < AFTER.first:
            return self._blade(mesh, -1)
        step = number - AFTER.first
        depth = min((step + 1) / _GOES, 1.0, (AFTER.end - 1 - number) / _GOES)
        return self._sphere(mesh, self._place + np.array([0.0, _BESIDE, 0.0]), _DEPTH * depth)

    def _sphere(self, mesh: TetMesh, place: Floats, depth: float) -> ToolContact:
        nodes, weights = touched(mesh, place[:2])
        contact = indenter_contact(mesh, place, -_UP, depth)
        centre = weights @ mesh.rest[nodes] + (_RADIUS - depth) * _UP
        return replace(
            contact,
            nodes=nodes,
            weights=weights,
            radius=_RADIUS,
            device=centre,
            offset=_RADIUS * _UP,
            mode=ToolMode.PALPATOR,
        )

    def _blade(self, mesh: TetMesh, step: int) -> ToolContact:
        """Return the blade in a frame of the cut; before its first it has left."""
        start = self._place - np.array([_CUT_LENGTH / 2, 0.0, 0.0])
        deep = min((step + 1) * _BLADE_STEP, _CUT_DEPTH)
        along = max((step + 1) * _BLADE_STEP - _CUT_DEPTH, 0.0)
        state = ContactState.NONE if step < 0 else ContactState.TOUCHING
        return blade_contact(mesh, state, start, start + np.array([along, 0.0, -deep]), _UP)


def prepared() -> None:
    """Load all kernels, so that no frame does."""
    warm_up()
    warm_up_cutting(CuttingSettings())


def main() -> None:
    """Print errors and frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('tetrahedra', type=int, choices=sorted(BRICKS))
    parser.add_argument('--nodes', type=int, nargs='+', default=[300, 500, 1000])
    parser.add_argument('--concessions', type=int, nargs='+', default=[0])
    parser.add_argument('--model', choices=MODELS, default='linear')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    prepared()
    session = FarFieldSession(options.tetrahedra, options.seed, (0.047, 0.053), options.model)
    exact = session.run(ActiveSettings())
    print(f'{exact.elements_cut} elements cut; all nodes: {_frames(exact)}')
    for nodes, concession in product(options.nodes, options.concessions):
        course = session.run(ActiveSettings('budget', nodes), exact, FRAMES, concession)
        print(f'{nodes} nodes, {concession} concessions: {_frames(course)}')
        for name, phase in PHASES.items():
            e = session.errors(course, exact, phase)
            soft = '' if phase.rests < 0 else f'compliance {100 * e.compliance:.2f} %, '
            print(
                f'  {name}: {soft}worst node {100 * e.worst:.2f} %, force {100 * e.force:.2f} % rms'
            )


def _frames(course: Course) -> str:
    median, late = 1e3 * np.percentile(course.times, [50, 99])
    return f'frame {median:.1f} ms, p99 {late:.1f} ms (processor time)'


if __name__ == '__main__':
    main()
