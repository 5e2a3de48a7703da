"""`trainer bench-strokes`: cost of a session of very many strokes.

A blade is drawn through a tissue all over, cut after cut, at times once more along an old one or
across it; pieces fall off. Tissue and cutting run in one process, the answer of the cutting a frame
late as in the graph. Every so many strokes some frames of a palpation are timed, the arrays are
counted, and the invariants of a cut are checked on the mesh.
"""

import json
import resource
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bench.speed.strokes_report import MAX_RATIO, Row, picture, ratios, table
from bench.speed.tissue import BOX_SIZE_M, TOUGHNESS, box, liver_material
from cutting_trainer.cutting.combined import FOLDED
from cutting_trainer.cutting.cut_invariants import ViolationError, check_mesh, cut_faces, pieces
from cutting_trainer.cutting.method_interface import CutResult
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact, indenter_contact
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.locate import closest_triangle
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import OUTER
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.warm_up import warm_up

MAX_FREQUENCY_GROWTH = 1.1
"""Allowed growth of the highest frequency by cuts; the step of the whole tissue follows it."""
_STIFFNESS, _RADIUS, _BLADE = 200.0, 0.004, 0.03
"""Stiffness of the tool's spring [N/m], radius of its tip and length of its edge [m]."""
_BLADE_STEP = 5e-3
"""Path of the blade in a frame [m], at 150 mm/s."""
_REPEATED_SHARE = 0.3
"""Share of the strokes along an earlier one or across it."""
_PLACES, _WARM, _FRAMES = 4, 6, 12
_DEPTH = 1e-3
"""Depth of a palpation [m]: too small for the blade to enter."""


class _Noting:
    """The method of cutting and its report of the stroke."""

    def __init__(self) -> None:
        self._method = make_method(CuttingSettings())
        self.folded = False

    def advance(self, *arguments: Any) -> CutResult:
        return self._noted(self._method.advance(*arguments))

    def finish(self, *arguments: Any) -> CutResult:
        return self._noted(self._method.finish(*arguments))

    def abort(self) -> None:
        self._method.abort()

    def _noted(self, result: CutResult) -> CutResult:
        self.folded |= FOLDED in result.report.warnings
        return result


def blade_contact(
    mesh: TetMesh, state: ContactState, place: np.ndarray, tip: np.ndarray, up: np.ndarray
) -> ToolContact:
    """Return a blade along a normal of the surface, that touches where it is not in the tissue yet.

    Args:
        mesh: the tissue.
        state: TOUCHING, or NONE: it has left.
        place: of the surface at rest where it goes in [m], shape (3,).
        tip: of the blade [m], shape (3,).
        up: outward unit normal there, shape (3,).
    """
    nodes = mesh.triangles[closest_triangle(place, mesh.rest, mesh.triangles)].astype(np.int64)
    return ToolContact(
        state=state,
        topology=mesh.topology,
        nodes=nodes,
        weights=np.full(3, 1 / 3),
        device=tip,
        offset=np.zeros(3),
        normal=up,
        stiffness=_STIFFNESS,
        radius=_RADIUS,
        blade_root=tip + _BLADE * up,
        blade_tip=tip,
    )


class Session:
    """A tissue that is cut by random strokes.

    Args:
        size: tetrahedra at the beginning, about.
        seed: of the strokes.
        model: of the tissue's elasticity.
        growth: how far cuts may raise the highest frequency [-], see `TimeStepping`.
    """

    def __init__(
        self,
        size: int,
        seed: int = 0,
        model: ModelName = 'linear',
        growth: float = MAX_FREQUENCY_GROWTH,
    ) -> None:
        self._kind = size, seed, model, growth
        scene = load_scene('liver').tissue
        m = scene.material
        self.simulation = TissueSimulation(
            box(size),
            liver_material(),
            Resistance(scene.cut_threshold, TOUGHNESS, m.blade_friction),
            model=model,
            stepping=TimeStepping('symplectic_euler', max_substeps=1000, frequency_growth=growth),
        )
        self._method = _Noting()
        self._tissue = Tissue(self.simulation, self._method)
        self._random = np.random.default_rng(seed)
        self._volume = float(self.simulation.mesh.volumes().sum())
        self._ways: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._cut_faces = cut_faces(self.simulation.mesh)
        self.strokes = self.substeps = 0
        self.troubles: list[str] = []

    def twin(self) -> 'Session':
        """Return another of the same kind, uncut, to be measured beside it."""
        return Session(*self._kind)

    def stroke(self) -> list[float]:
        """Cut once; return the processor time of each frame [ms]."""
        self.strokes += 1
        start, end, up = self._way()
        mesh = self.simulation.mesh
        self._cut_faces, self._method.folded = cut_faces(mesh), False
        depth = self._random.uniform(0.006, 0.014)
        down = np.arange(0.0, depth, _BLADE_STEP)
        steps = max(int(np.ceil(np.linalg.norm(end - start) / _BLADE_STEP)), 1)
        tips = [start - up * way for way in down]
        tips += list(np.linspace(start, end, steps + 1) - up * depth)
        times = [
            self._frame(blade_contact(mesh, ContactState.TOUCHING, start, tip, up)) for tip in tips
        ]
        times.append(self._frame(blade_contact(mesh, ContactState.NONE, start, tips[-1], up)))
        return times + [self._frame(None) for _ in range(2)]  # that finish the cut

    def _frame(self, contact: ToolContact | None) -> float:
        begin = time.thread_time()
        frame = self._tissue.frame(contact)
        spent = 1e3 * (time.thread_time() - begin)
        self.substeps = frame.substeps
        if frame.trouble:
            self.troubles.append(f'frame {frame.step}: {frame.trouble}')
        return spent

    def _way(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return begin and end of a stroke on the surface at rest [m], and its outward normal."""
        random, mesh = self._random, self.simulation.mesh
        if self._ways and random.random() < _REPEATED_SHARE:
            start, end, up = self._ways[random.integers(len(self._ways))]
            shift = random.uniform(-1e-3, 1e-3, 3)
            if random.random() < 0.5:
                return start + shift, end + shift, up
            across, middle = np.cross(up, end - start) / 2, (start + end) / 2 + shift
            return middle - across, middle + across, up
        corners = mesh.rest[mesh.triangles]
        outer = (mesh.triangle_kind == OUTER) & ~mesh.fixed[mesh.triangles].any(axis=1)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.where(outer, np.linalg.norm(normals, axis=1), 0.0)
        at = random.choice(len(areas), p=areas / areas.sum())
        up = normals[at] / areas[at]
        along = np.cross(up, random.normal(size=3))
        along *= random.uniform(0.008, 0.025) / np.linalg.norm(along)
        middle = corners[at].mean(axis=0)
        way = (middle - along / 2, middle + along / 2, up)
        self._ways.append(way)
        return way

    def palpate(self) -> Iterator[tuple[float, int]]:
        """Press at some places of the top; yield each frame's time [ms] and substeps."""
        down = np.array([0.0, 0.0, -1.0])
        for k in range(_PLACES):
            place = np.array(BOX_SIZE_M) * (0.3 + 0.4 * (k % 2), 0.3 + 0.4 * (k // 2), 1.0)
            for number in range(_WARM + _FRAMES):
                depth = _DEPTH * min(number / _WARM, 1.0)
                contact = indenter_contact(self.simulation.mesh, place, down, depth)
                spent = self._frame(contact)
                if number >= _WARM:
                    yield spent, self.substeps
            self._frame(None)

    def check(self) -> None:
        """Check the invariants of a cut on the mesh.

        Raises:
            ViolationError: an invariant is violated; the message says where.
        """
        mesh = self.simulation.mesh
        old = cut_faces(mesh) if self._method.folded else self._cut_faces
        check_mesh(mesh, self._volume, old, tolerance=1e-9)

    @property
    def loose(self) -> int:
        """Return the number of pieces without a fixed node."""
        mesh, piece = self.simulation.mesh, pieces(self.simulation.mesh)
        held = mesh.fixed[mesh.tetrahedra].any(axis=1)
        return len(np.setdiff1d(piece, piece[held]))

    @property
    def added_mass(self) -> float:
        """Added mass as a share of the tissue's own [-]."""
        dynamics = self.simulation.dynamics
        free = dynamics.masses.inverse[::3] > 0
        mass = dynamics.model.mass[free]
        return float((1.0 / dynamics.masses.inverse[::3][free]).sum() / mass.sum() - 1.0)

    @property
    def bytes(self) -> int:
        """Size of all arrays of tissue and cutting [bytes]."""
        return array_bytes([self.simulation, self._method])


def array_bytes(root: object) -> int:
    """Return the size [bytes] of all arrays that an object refers to, counted once."""
    seen: set[int] = set()
    left, total = [root], 0
    while left:
        thing = left.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, np.ndarray):
            if thing.base is None:
                total += thing.nbytes
            else:
                left.append(thing.base)
        elif isinstance(thing, dict):
            left += thing.values()
        elif isinstance(thing, list | tuple):
            left += thing
        elif hasattr(thing, '__dict__'):
            left += vars(thing).values()
    return total


def measure(session: Session, strokes: int, every: int) -> Iterator[Row]:
    """Cut; yield the state before the first stroke and after every so many.

    Args:
        session: not cut yet.
        strokes: how many.
        every: so many, a row.

    Raises:
        ViolationError: an invariant is broken.
    """
    uncut = session.twin()
    times: list[float] = []
    for done in range(strokes + 1):
        if done:
            times += session.stroke()
        if done % every == 0 or done == strokes:
            yield _look(session, uncut, done, times)
            times = []


def _look(session: Session, uncut: Session, done: int, times: list[float]) -> Row:
    session.check()
    troubles = len(session.troubles)
    pairs = list(zip(session.palpate(), uncut.palpate(), strict=True))
    ours = np.array([mine for (mine, _), _ in pairs])
    theirs = np.array([other for _, (other, _) in pairs])
    mesh = session.simulation.mesh
    elements = len(mesh.tetrahedra) / len(uncut.simulation.mesh.tetrahedra)
    session.troubles.clear()
    return Row(
        strokes=done,
        tetrahedra=len(mesh.tetrahedra),
        nodes=mesh.node_count,
        triangles=len(mesh.triangles),
        loose=session.loose,
        substeps=pairs[-1][0][1],
        median=float(np.median(ours)),
        high=float(np.percentile(ours, 90)),
        uncut=float(np.median(theirs)),
        by_element=float(np.median(ours / theirs)) / elements,
        stroke=float(np.median(times)) if times else 0.0,
        worst=max(times, default=0.0),
        arrays=session.bytes,
        resident=_resident(),
        troubles=troubles,
        added=session.added_mass,
    )


def _resident() -> int:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize()


def run_strokes(
    output: Path, strokes: int, every: int, size: int, seed: int, growth: float, *, as_json: bool
) -> Status:
    """Measure, print, and write the picture and its figures; after Ctrl-C, of the strokes so far.

    Args:
        output: folder; charts/ in it takes the picture.
        strokes: how many.
        every: so many, a row.
        size: of the tissue at the beginning [tetrahedra], about.
        seed: of the strokes.
        growth: `integration.frequency_growth`.

    Raises:
        SessionError: an invariant is broken.
    """
    warm_up()
    warm_up_cutting(CuttingSettings())
    console = Console(soft_wrap=True, highlight=False)
    progress = Console(stderr=True, highlight=False)
    session = Session(size, seed, growth=growth)
    rows: list[Row] = []
    interrupted = False
    try:
        for row in measure(session, strokes, every):
            rows.append(row)
            progress.print(f'{row.strokes} of {strokes} strokes, {row.tetrahedra} tetrahedra')
    except ViolationError as error:
        raise SessionError(f'after stroke {session.strokes}: {error}') from None
    except KeyboardInterrupt:
        interrupted = True
        if not rows:
            return Status.INTERRUPTED
    folder = output / 'charts'
    folder.mkdir(parents=True, exist_ok=True)
    picture(rows).savefig(folder / 'strokes.png', dpi=110, bbox_inches='tight')
    report = [asdict(row) for row in rows]
    (folder / 'strokes.json').write_text(json.dumps(report, indent=1) + '\n')
    time_ratio, memory_ratio = ratios(rows)
    if as_json:
        console.out(json.dumps(report, indent=2), highlight=False)
    else:
        console.print(table(rows))
        console.print(
            f'at the end a live element costs {time_ratio:.2f} times the time and '
            f'{memory_ratio:.2f} times the memory of the beginning; the limit is {MAX_RATIO:g}'
        )
    if interrupted:
        return Status.INTERRUPTED
    return Status.FAILED if max(time_ratio, memory_ratio) > MAX_RATIO else Status.OK
