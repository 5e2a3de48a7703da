"""The methods of cutting side by side: the command `trainer compare-cuts` and docs/cut-methods.md.

The same strokes through the same mesh at rest, without mechanics; what the cut surface, the mesh,
the stable step and the clock make of it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.sparse.linalg import LinearOperator, eigsh

from cutting.checks import lips, pieces
from cutting.methods import make_method
from cutting.settings import CuttingSettings
from session.errors import SessionError
from session.scene import load_scene
from tissue_sim.blade import Sweep
from tissue_sim.coupling import Coupling
from tissue_sim.elasticity import ElasticModel
from tissue_sim.integrators import Integrator
from tissue_sim.locate import distance_to_triangles
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.mesh_io import load_tissue
from tissue_sim.stability import FrequencyBound

Floats = NDArray[np.float64]

METHODS = ('combined', 'combined_midpoint', 'subdivide', 'separate', 'delete')
GROWTH = 3.0
"""Growth of the highest frequency above which nodes get more mass, as in `TissueSimulation`."""
REPEATS = 3
"""Runs of each stroke; the fastest counts."""
_CELL = 0.005
_TISSUE = Material(3500.0, 0.45, 1060.0)


@dataclass(frozen=True)
class Stroke:
    """A mesh, and where the blade goes through it.

    Attributes:
        name: of both.
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        fixed: nodes that do not move, shape (n,).
        paths: the blade's edge, root and tip, by step [m], each shape (k, 2, 3).
    """

    name: str
    nodes: Floats
    tetrahedra: NDArray[np.int64]
    fixed: NDArray[np.uint8]
    paths: tuple[Floats, ...]


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
    """What a method left of a stroke.

    Attributes:
        mesh: after it.
        bound: of the frequency, with the ceiling that `GROWTH` sets.
        milliseconds: by batch, connectivity and physics together.
        cut_elements: tetrahedra taken out or replaced.
    """

    mesh: TetMesh
    bound: FrequencyBound
    milliseconds: list[float]
    cut_elements: int


def run_comparison(folder: Path) -> None:
    """Compares, and writes the page, the table and the picture to a folder.

    Args:
        folder: that exists.

    Raises:
        SessionError: it does not.
    """
    from session.cut_picture import write_all

    if not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, the comparison goes into it')
    console = Console(highlight=False)
    with console.status('') as line:
        rows, shown = compare(line.update)
        line.update('random planes')
        planes = random_planes()
        spreads = {
            name: spread(tuple(stroke for stroke in planes if stroke.name == name))
            for name in ('block', 'liver')
        }
        write_all(folder, rows, shown, strokes()[0], rk4_milliseconds(), spreads)
    console.print(f'{folder / "cut-methods.md"} has {len(rows)} rows')


def compare(progress: Callable[[str], None] = lambda name: None) -> tuple[list[Row], list[Cut]]:
    """Cuts all strokes by all methods.

    Args:
        progress: told what is next.

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


def strokes() -> tuple[Stroke, ...]:
    """An oblique plane, an arc and two crossing cuts in a block; a plane in the liver."""
    nodes, tetrahedra = good_block((8, 6, 6), _CELL, seed=0)
    free = np.zeros(len(nodes), np.uint8)
    middle = nodes.mean(axis=0)
    slant = drawn(_line(middle, 62.0, 0.040), (0.25, 0.15, 1.0), 0.030)
    bend = drawn(_arc(middle, 25.0, 0.040), (0.1, 0.2, 1.0), 0.030)
    across = drawn(_line(middle, -21.0, 0.040), (-0.1, 0.2, 1.0), 0.030)
    liver, inside, held = load_tissue(load_scene('liver').tissue)
    through = drawn(_line(np.array([-0.02, 0.0, 0.035]), 83.0, 0.060), (0.1, 0.0, 1.0), 0.015)
    return (
        Stroke('plane', nodes, tetrahedra, free, (slant,)),
        Stroke('arc', nodes, tetrahedra, free, (bend,)),
        Stroke('crossing', nodes, tetrahedra, free, (slant, across)),
        Stroke('liver', liver, inside.astype(np.int64), held.astype(np.uint8), (through,)),
    )


def random_planes() -> tuple[Stroke, ...]:
    """Planes of any direction through the block, 30, and through the liver, 12."""
    found: list[Stroke] = []
    liver, inside, _ = load_tissue(load_scene('liver').tissue)
    for name, count in (('block', 30), ('liver', 12)):
        for k in range(count):
            rng = np.random.default_rng(k)
            if name == 'block':
                nodes, tetrahedra = good_block((8, 6, 6), _CELL, seed=k)
            else:
                nodes, tetrahedra = liver, inside.astype(np.int64)
            low, high = nodes.min(axis=0), nodes.max(axis=0)
            through = low + (high - low) * rng.uniform(0.3, 0.7, 3)
            along, edge, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            line = through + np.linspace(-0.048, 0.048, 61)[:, None] * along
            free = np.zeros(len(nodes), np.uint8)
            path = drawn(line, (edge[0], edge[1], edge[2]), 0.048)
            found.append(Stroke(name, nodes, tetrahedra, free, (path,)))
    return tuple(found)


def spread(strokes: tuple[Stroke, ...]) -> Floats:
    """What `combined` makes of some strokes.

    Returns:
        By stroke: distance of the cut surface from the blade, root of the mean square and largest
        [h], step shrink; shape (k, 3). Strokes that miss the tissue are left out.
    """
    found = []
    for stroke in strokes:
        mesh = cut(stroke, 'combined').mesh
        if not len(lips(mesh)):
            continue
        before = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
        distance, area = distances(mesh, stroke.paths, mean_edge(before))
        shrink = _shrink(before, mesh)
        found.append((np.sqrt(area @ distance**2 / area.sum()), distance.max(), shrink))
    return np.array(found)


def _shrink(before: TetMesh, after: TetMesh) -> float:
    one, two = (highest_frequency(ElasticModel(mesh, _TISSUE)) for mesh in (before, after))
    return two / one


def good_block(
    cells: tuple[int, int, int], size: float, *, seed: int, jitter: float = 0.08
) -> tuple[Floats, NDArray[np.int64]]:
    """A block of body-centred cubes, its inner nodes displaced, its numbers shuffled.

    Args:
        cells: cubes along each axis.
        size: edge of a cube [m].
        seed: of the displacements and the numbers; negative: numbers in order.
        jitter: largest displacement along each axis, as a share of `size`.

    Returns:
        Nodes [m], shape (n, 3), and positively oriented tetrahedra, 12 by cube, shape (m, 4).
    """
    corner = np.arange(np.prod([c + 1 for c in cells])).reshape([c + 1 for c in cells])
    grid = np.argwhere(np.ones(cells)).astype(float)
    nodes = np.concatenate([np.argwhere(corner >= 0).astype(float), grid + 0.5]) * size
    heart = np.full(np.array(cells) + 2, -1)
    heart[1:-1, 1:-1, 1:-1] = corner.size + np.arange(len(grid)).reshape(cells)
    parts = []
    for axis in range(3):
        c, h = np.moveaxis(corner, axis, 0), np.moveaxis(heart, axis, 0)
        ring = np.stack([c[:, :-1, :-1], c[:, 1:, :-1], c[:, 1:, 1:], c[:, :-1, 1:]], axis=-1)
        ends = np.stack([h[:-1, 1:-1, 1:-1], h[1:, 1:-1, 1:-1]], axis=-1).reshape(-1, 2)
        ring = ring.reshape(-1, 4)
        inner = (ends >= 0).all(axis=1)
        for i in range(4):
            sides = np.stack([ring[:, i], ring[:, (i + 1) % 4]], axis=1)
            parts.append(np.concatenate([ends, sides], axis=1)[inner])
        for three in ((0, 1, 2), (0, 2, 3)):
            apex = ends.max(axis=1)[:, None]
            parts.append(np.concatenate([apex, ring[:, three]], axis=1)[~inner])
    inside = ((nodes > size / 4) & (nodes < (np.array(cells) - 0.25) * size)).all(axis=1)
    # A function of the place, so that blocks of any size agree where they overlap.
    wave = np.sin(
        nodes @ (np.array([[1.3, 2.1, 3.7], [2.9, 1.7, 0.9], [0.7, 3.1, 2.3]]) / size * 5)
    )
    nodes[inside] += jitter * size * wave[inside]
    return _shuffled(nodes, np.concatenate(parts), seed)


def _shuffled(
    nodes: Floats, tetrahedra: NDArray[np.int64], seed: int
) -> tuple[Floats, NDArray[np.int64]]:
    if seed >= 0:
        rng = np.random.default_rng(seed)
        order = rng.permutation(len(nodes))
        nodes = nodes[order]
        tetrahedra = rng.permutation(np.argsort(order)[tetrahedra])
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    negative = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) < 0
    tetrahedra[negative, 2:] = tetrahedra[negative, :1:-1]
    return nodes, tetrahedra


def _line(middle: Floats, degrees: float, length: float) -> Floats:
    angle = np.radians(degrees)
    way = np.linspace(-length, length, 61)[:, None]
    return middle + way * np.array([np.cos(angle), np.sin(angle), 0.0])


def _arc(middle: Floats, degrees: float, radius: float) -> Floats:
    angle = np.linspace(-1.0, 1.0, 61)
    bow = radius * np.stack([1 - np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turn = np.radians(degrees)
    c, s = np.cos(turn), np.sin(turn)
    return middle + (bow - [0.1 * radius, 0.0, 0.0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def drawn(line: Floats, edge: tuple[float, float, float], reach: float) -> Floats:
    """A straight blade drawn along a line.

    Args:
        line: middle of the edge by step [m], shape (k, 3).
        edge: its direction.
        reach: half its length [m].

    Returns:
        Root and tip by step [m], shape (k, 2, 3).
    """
    half = np.array(edge) / np.linalg.norm(edge) * reach
    return np.stack([line + half, line - half], axis=1)


def cut(stroke: Stroke, method: str) -> Cut:
    """Cuts a stroke by a method, with the physics following each batch."""
    mesh = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
    model = ElasticModel(mesh, _TISSUE)
    bound = FrequencyBound(model, _inverse(model), GROWTH)
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
            inverse = _inverse(model)
            start = time.thread_time()
            bound.update(touched.nodes, inverse)
            milliseconds.append(1e3 * (spent + time.thread_time() - start))
            elements += len(result.delta.removed_tetrahedra)
    return Cut(mesh, bound, milliseconds, elements)


def _inverse(model: ElasticModel) -> Floats:
    return np.repeat(np.where(model.mesh.fixed == 1, 0.0, 1.0 / model.mass), 3)


def _row(stroke: Stroke, method: str, runs: list[Cut]) -> Row:
    before = TetMesh(stroke.nodes, stroke.tetrahedra, stroke.fixed)
    mesh, bound = runs[0].mesh, runs[0].bound
    distance, area = distances(mesh, stroke.paths, mean_edge(before))
    model = ElasticModel(mesh, _TISSUE)
    batches = np.min([run.milliseconds for run in runs], axis=0)
    extra = bound.inertia(np.arange(mesh.node_count)).sum() / model.mass.sum() - 1
    return Row(
        stroke.name,
        method,
        float(np.sqrt(area @ distance**2 / area.sum())),
        float(distance.max()),
        len(before.tetrahedra),
        len(mesh.tetrahedra),
        _shrink(before, mesh),
        100 * float(extra),
        100 * float(1 - mesh.volumes().sum() / before.volumes().sum()),
        int(pieces(mesh).max()) + 1,
        len(batches),
        runs[0].cut_elements,
        float(np.median(batches)),
        float(batches.max()),
    )


def highest_frequency(model: ElasticModel) -> float:
    """Highest natural frequency with the masses that the tissue has, converged [rad/s]."""
    root = np.sqrt(_inverse(model))

    def scaled(x: Floats) -> Floats:
        return np.asarray(root * model.force((root * x.ravel()).reshape(-1, 3)).ravel())

    operator = LinearOperator((len(root), len(root)), matvec=scaled, dtype=float)
    start = np.random.default_rng(0).standard_normal(len(root))
    top = eigsh(operator, k=1, which='LA', v0=start, tol=1e-6, return_eigenvectors=False)
    return float(np.sqrt(top[0]))


def mean_edge(mesh: TetMesh) -> float:
    """Mean length of the edges [m]."""
    tets = mesh.tetrahedra
    pairs = np.concatenate([tets[:, [i, j]] for i in range(4) for j in range(i)])
    ends = mesh.rest[np.unique(np.sort(pairs, axis=1), axis=0)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())


def distances(mesh: TetMesh, paths: tuple[Floats, ...], h: float) -> tuple[Floats, Floats]:
    """How far the cut surface is from where the blade went, in units of h.

    The blade's path is continued by two h on all sides: how deep a cut ends is another question.

    Returns:
        Distances at seven points of each triangle, and the area that each stands for, shape (7 k,).
    """
    corners = lips(mesh)
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    points = np.concatenate([corners, middles, corners.mean(axis=1, keepdims=True)], axis=1)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Exact for the square of a linear function.
    share = np.array([3, 3, 3, 8, 8, 8, 27]) / 60
    area = np.linalg.norm(sides, axis=1)[:, None] / 2 * share
    sheet = np.concatenate([_continued(path, 2 * h) for path in paths])
    places, triangles = sheet.reshape(-1, 3), np.arange(3 * len(sheet)).reshape(-1, 3)
    away = [distance_to_triangles(point, places, triangles) for point in points.reshape(-1, 3)]
    return np.array(away) / h, area.ravel()


def _continued(path: Floats, by: float) -> Floats:
    """Triangles of the path, continued on all sides [m], shape (t, 3, 3)."""
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
    """What one RK4 step of about 10,000 tetrahedra takes here and now [ms]."""
    model = ElasticModel(TetMesh(*good_block((17, 7, 7), _CELL, seed=-1)), _TISSUE)
    size = 3 * model.mesh.node_count
    state = np.random.default_rng(0).standard_normal((2, size)) * 1e-9
    integrator, inverse = Integrator('rk4', 0.0, 0.0), _inverse(model)
    no_tool = Coupling().spring(model.mesh.rest)
    spent = []
    for _ in range(30):
        start = time.thread_time()
        integrator.step(
            model.operands(), inverse, model.diagonal, no_tool, state[0], state[1], 1e-5, 1
        )
        spent.append(1e3 * (time.thread_time() - start))
    return median(spent)
