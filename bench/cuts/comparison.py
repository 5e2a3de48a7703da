"""The methods of cutting side by side, measured.

The same strokes through the same mesh at rest, without mechanics; the cut surface, the mesh,
the stable step and the clock make of it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from bench.cuts.strokes import CELL_M, Floats, Stroke, good_block, strokes
from cutting_trainer.cutting.cut_invariants import cut_faces, pieces
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.coupling import NO_SPRINGS
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.locate import distances_to_triangles
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown
from cutting_trainer.tissue_sim.motion.integrators import Integrator
from cutting_trainer.tissue_sim.motion.stability import FrequencyBound

METHODS = ('combined', 'combined_midpoint', 'subdivide', 'separate', 'delete')
MAX_FREQUENCY_GROWTH = 3.0
"""Growth of the highest frequency above which nodes get added mass, as in `TissueSimulation`."""
REPEATS = 3
"""Runs of each stroke; the fastest counts."""
_TISSUE = Material(3500.0, 0.45, 1060.0)


@dataclass(frozen=True)
class Row:
    """One method on one stroke; the names are the columns of the table."""

    stroke: str
    method: str
    rms_distance_h: float
    largest_distance_h: float
    elements_before: int
    elements_after: int
    step_shrink: float
    added_mass_percent: float
    lost_mass_percent: float
    pieces: int
    batches: int
    cut_elements: int
    median_ms: float
    largest_ms: float


@dataclass(frozen=True)
class Cut:
    """Result of a method on a stroke.

    Attributes:
        mesh: after it.
        added: mass that `MAX_FREQUENCY_GROWTH` adds, as a share of the tissue's [-].
        milliseconds: by batch, connectivity and physics together.
        cut_elements: tetrahedra taken out or replaced.
    """

    mesh: TetMesh
    added: float
    milliseconds: list[float]
    cut_elements: int


def compare(progress: Callable[[str], None] = lambda name: None) -> tuple[list[Row], list[Cut]]:
    """Cut all strokes by all methods.

    Args:
        progress: called with the next step.

    Returns:
        The table, and the first stroke as each method cut it.
    """
    rows: list[Row] = []
    shown: list[Cut] = []
    for stroke in strokes():
        for method in METHODS:
            progress(f'{stroke.name}, {method}')
            runs = [cut(stroke, method) for _ in range(REPEATS)]
            rows.append(_row(stroke, method, runs))
            if len(shown) < len(METHODS):
                shown.append(runs[0])
    return rows, shown


def spread(strokes: tuple[Stroke, ...]) -> Floats:
    """Return the spread of `combined` over some strokes.

    Returns:
        By stroke: distance of the cut surface from the blade, root of the mean square and largest
        [h], step shrink; shape (k, 3). Strokes that miss the tissue are left out.
    """
    found = []
    for stroke in strokes:
        mesh = cut(stroke, 'combined').mesh
        if not len(cut_faces(mesh)):
            continue
        before = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
        distance, area = distances(mesh, stroke.paths, mean_edge(before))
        shrink = _shrink(before, mesh)
        found.append((np.sqrt(area @ distance**2 / area.sum()), distance.max(), shrink))
    return np.array(found)


def _shrink(before: TetMesh, after: TetMesh) -> float:
    models = (ElasticModel(mesh, _TISSUE) for mesh in (before, after))
    one, two = (highest_frequency(model, _inverse(model)) for model in models)
    return two / one


def cut(stroke: Stroke, method: str) -> Cut:
    """Cut a stroke by a method, with the physics following each batch."""
    mesh = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
    model = ElasticModel(mesh, _TISSUE)
    inverse, inertia = _inverse(model), model.mass.copy()
    bound = FrequencyBound(model, inverse, MAX_FREQUENCY_GROWTH)
    cutter = make_method(CuttingSettings.model_validate({'method': method}))
    milliseconds: list[float] = []
    elements = 0
    for path in stroke.paths:
        sweeps = [Sweep(*a, *b) for a, b in pairwise(path)]
        for sweep in [*sweeps, None]:
            start = time.thread_time()
            if sweep is None:
                result = cutter.finish(mesh, mesh.rest)
            else:
                result = cutter.advance(mesh, mesh.rest, sweep)
            if result.delta.empty:
                continue
            touched = mesh.apply(result.delta)
            model.update(touched)
            spent = time.thread_time() - start
            n = mesh.node_count
            inverse, inertia = grown(inverse, 3 * n), grown(inertia, n)
            start = time.thread_time()
            inertia[touched.nodes] = bound.limit(touched.nodes, inverse[: 3 * n])
            milliseconds.append(1e3 * (spent + time.thread_time() - start))
            elements += len(result.delta.removed_tetrahedra)
    added = float(inertia[: mesh.node_count].sum() / model.mass.sum()) - 1
    return Cut(mesh, added, milliseconds, elements)


def _inverse(model: ElasticModel) -> Floats:
    return np.repeat(np.where(model.mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)


def _row(stroke: Stroke, method: str, runs: list[Cut]) -> Row:
    before = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
    mesh = runs[0].mesh
    distance, area = distances(mesh, stroke.paths, mean_edge(before))
    batches = np.min([run.milliseconds for run in runs], axis=0)
    return Row(
        stroke.name,
        method,
        float(np.sqrt(area @ distance**2 / area.sum())),
        float(distance.max()),
        len(before.tetrahedra),
        len(mesh.tetrahedra),
        _shrink(before, mesh),
        100 * runs[0].added,
        100 * float(1 - mesh.volumes().sum() / before.volumes().sum()),
        int(pieces(mesh).max()) + 1,
        len(batches),
        runs[0].cut_elements,
        float(np.median(batches)),
        float(batches.max()),
    )


def highest_frequency(model: ElasticModel, inverse: Floats) -> float:
    """Return highest natural frequency of small motions, converged [rad/s].

    Args:
        model: with the rotations of its shape.
        inverse: masses by coordinate, 0 where fixed [1/kg], shape (3 n,).
    """
    root = np.sqrt(inverse)

    def scaled(x: Floats) -> Floats:
        return np.asarray(root * model.product((root * x.ravel()).reshape(-1, 3)).ravel())

    operator = LinearOperator((len(root), len(root)), matvec=scaled, dtype=float)
    start = np.random.default_rng(0).standard_normal(len(root))
    top = eigsh(operator, k=1, which='LA', v0=start, tol=1e-6, return_eigenvectors=False)
    return float(np.sqrt(top[0]))


def mean_edge(mesh: TetMesh) -> float:
    """Return mean length of the edges [m]."""
    tets = mesh.tetrahedra
    pairs = np.concatenate([tets[:, [i, j]] for i in range(4) for j in range(i)])
    ends = mesh.rest[np.unique(np.sort(pairs, axis=1), axis=0)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())


def distances(mesh: TetMesh, paths: tuple[Floats, ...], h: float) -> tuple[Floats, Floats]:
    """Return the distance of the cut surface from the path of the blade, in units of h.

    The blade's path is continued by two h on all sides: how deep a cut ends is another question.

    Returns:
        Distances at seven points of each triangle, and the area that each stands for, shape (7 k,).
    """
    corners = cut_faces(mesh)
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    points = np.concatenate([corners, middles, corners.mean(axis=1, keepdims=True)], axis=1)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Exact for the square of a linear function.
    share = np.array([3, 3, 3, 8, 8, 8, 27]) / 60
    area = np.linalg.norm(sides, axis=1)[:, None] / 2 * share
    sheet = np.concatenate([_continued(path, 2 * h) for path in paths])
    places, triangles = sheet.reshape(-1, 3), np.arange(3 * len(sheet)).reshape(-1, 3)
    away = distances_to_triangles(points.reshape(-1, 3), places, triangles)
    return away / h, area.ravel()


def _continued(path: Floats, by: float) -> Floats:
    """Return triangles of the path, continued on all sides [m], shape (t, 3, 3)."""
    along = path[:, 0] - path[:, 1]
    along *= by / np.linalg.norm(along, axis=1, keepdims=True)
    wide = np.stack([path[:, 0] + along, path[:, 1] - along], axis=1)
    first, last = wide[0] - wide[1], wide[-1] - wide[-2]
    first *= by / np.linalg.norm(first, axis=1).mean()
    last *= by / np.linalg.norm(last, axis=1).mean()
    wide = np.concatenate([wide[:1] + first, wide, wide[-1:] + last])
    a, b, c, d = wide[:-1, 0], wide[:-1, 1], wide[1:, 1], wide[1:, 0]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def rk4_milliseconds() -> float:
    """Return the time of an RK4 step of about 10,000 tetrahedra on this machine [ms]."""
    model = ElasticModel(TetMesh(*good_block((17, 7, 7), CELL_M, seed=-1)), _TISSUE)
    size = 3 * model.mesh.node_count
    state = np.random.default_rng(0).standard_normal((2, size)) * 1e-9
    integrator, inverse = Integrator('rk4', 0.0, 0.0), _inverse(model)
    no_tool = NO_SPRINGS
    spent = []
    for _ in range(30):
        start = time.thread_time()
        integrator.step(
            model.operands(), inverse, model.diagonal, no_tool, state[0], state[1], 1e-5, 1
        )
        spent.append(1e3 * (time.thread_time() - start))
    return median(spent)
