"""Curved cuts through meshes of known size: circles, arcs, S-curves, spirals, loops and lines."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from bench.cuts.strokes import CELL_M, good_block
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import load_tissue

Floats = NDArray[np.float64]

STEP = 0.12
"""Way of the blade in one sweep, as a share of an edge of the mesh."""
OVERLAP = 0.1
"""Share of a closed circle that the blade passes twice."""


@dataclass(frozen=True)
class Organ:
    """A mesh to be cut.

    Attributes:
        name: of the mesh.
        nodes: [m], shape (n, 3).
        tetrahedra: shape (m, 4).
        h: median length of an edge [m].
    """

    name: str
    nodes: Floats
    tetrahedra: NDArray[np.int64]
    h: float

    @property
    def middle(self) -> Floats:
        """Return the middle of the box around the mesh [m], shape (3,)."""
        middle: Floats = (self.nodes.min(axis=0) + self.nodes.max(axis=0)) / 2
        return middle


def organ_of(name: str, nodes: Floats, tetrahedra: NDArray[np.int64]) -> Organ:
    """Return a mesh with the median length of its edges."""
    pairs = np.concatenate([tetrahedra[:, [i, j]] for i in range(4) for j in range(i)])
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    lengths = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    return Organ(name, nodes, tetrahedra, float(np.median(lengths)))


def slab(cells: tuple[int, int, int] = (16, 16, 3)) -> Organ:
    """Return a well-shaped slab."""
    return organ_of('slab', *good_block(cells, CELL_M, seed=0))


def liver() -> Organ:
    """Return the shipped liver."""
    nodes, tetrahedra, *_ = load_tissue(load_scene('liver').tissue)
    return organ_of('liver', nodes, tetrahedra.astype(np.int64))


def _apart(nodes: Floats, candidates: Floats, distance: float) -> Floats:
    """Return the nodes with each further candidate that is apart from all before it [m]."""
    far = np.ones(len(candidates), bool)
    if len(nodes):
        far = cKDTree(nodes).query(candidates)[0] > distance
    candidates = candidates[far]
    near = cKDTree(candidates).query_ball_point(candidates, distance)
    kept = np.zeros(len(candidates), bool)
    for k, others in enumerate(near):
        kept[k] = not kept[others].any()
    return np.concatenate([nodes, candidates[kept]])


def scattered() -> Organ:
    """Return a flat ellipsoid, the Delaunay mesh of scattered points: some elements are slivers."""
    rng = np.random.default_rng(77)
    axes = np.array([0.045, 0.045, 0.014])
    distance = 0.0044
    nodes = np.empty((0, 3))
    for radius, tries in ((1.0, 30000), (None, 60000)):
        directions = rng.normal(size=(tries, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        size = 1.0 if radius else rng.uniform(0, 1, (tries, 1)) ** (1 / 3) * 0.9
        nodes = _apart(nodes, directions * size * axes, distance)
    tetrahedra = Delaunay(nodes).simplices.astype(np.int64)
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    volume = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a)
    tetrahedra[volume < 0, 2:] = tetrahedra[volume < 0, :1:-1]
    tetrahedra = tetrahedra[np.abs(volume) > 2e-3 * distance**3]
    used = np.unique(tetrahedra)
    return organ_of('scattered', nodes[used], np.searchsorted(used, tetrahedra))


@dataclass(frozen=True)
class Cut:
    """A stroke, or some, through a mesh.

    Attributes:
        paths: the blade's edge, root and tip, by step [m], each shape (k, 2, 3).
        closed: the cut closes on itself: its ends are not free.
        inside: point of the plug that has to come free [m], shape (3,); None without one.
        radius: of the circle in the plug [m].
        beyond: of the circle around it [m].
    """

    paths: tuple[Floats, ...]
    closed: bool = False
    inside: Floats | None = None
    radius: float = 0.0
    beyond: float = 0.0


def _upright(organ: Organ, line: Floats, depth: float | None, tilt: Floats) -> Floats:
    """Return the path of a blade whose edge stands on a line, from above, shape (k, 2, 3).

    Args:
        organ: mesh.
        line: way of the blade in the plane [m], shape (k, 2).
        depth: of the tip below the top [m]; None: through all of it.
        tilt: horizontal part of the edge's direction, shape (2,).
    """
    low, high = organ.nodes[:, 2].min(), organ.nodes[:, 2].max()
    top, bottom = high + organ.h, low - organ.h if depth is None else high - depth
    middle = (low + high) / 2
    ends = []
    for z in (top, bottom):
        at = line + (z - middle) * tilt
        ends.append(np.column_stack([at, np.full(len(at), z)]))
    return np.stack(ends, axis=1)


def _resampled(line: Floats, step: float) -> Floats:
    """Return points of a polyline at equal distances of about `step` [m]."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], max(2, int(np.ceil(way[-1] / step)) + 1))
    return np.column_stack([np.interp(at, way, line[:, i]) for i in range(2)])


def circle(organ: Organ, ratio: float, rng: np.random.Generator) -> Cut:
    """Return a full circle through the thickness, of radius `ratio` h, at a random centre."""
    radius = ratio * organ.h
    centre = organ.middle[:2] + rng.uniform(-1, 1, 2) * organ.h
    start = rng.uniform(0, 2 * np.pi)
    turn = np.linspace(start, start + 2 * np.pi * (1 + OVERLAP), 2000)
    line = centre + radius * np.column_stack([np.cos(turn), np.sin(turn)])
    path = _upright(organ, _resampled(line, STEP * organ.h), None, np.zeros(2))
    return Cut((path,), True, np.append(centre, organ.middle[2]), radius, radius)


def four_arcs(organ: Organ, ratio: float, rng: np.random.Generator) -> Cut:
    """Return a circle cut by four strokes, each a tenth longer than its quarter at both ends."""
    radius = ratio * organ.h
    centre = organ.middle[:2] + rng.uniform(-1, 1, 2) * organ.h
    start = rng.uniform(0, 2 * np.pi)
    paths = []
    for k in range(4):
        half = np.pi / 4 * (1 + 2 * OVERLAP)
        turn = start + k * np.pi / 2 + np.linspace(-half, half, 500)
        line = centre + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        paths.append(_upright(organ, _resampled(line, STEP * organ.h), None, np.zeros(2)))
    return Cut(tuple(paths), True, np.append(centre, organ.middle[2]), radius, radius)


def four_lines(organ: Organ, ratio: float, rng: np.random.Generator) -> Cut:
    """Return a square cut by four straight strokes that cross at its corners."""
    radius = ratio * organ.h
    centre = organ.middle[:2] + rng.uniform(-1, 1, 2) * organ.h
    start = rng.uniform(0, 2 * np.pi)
    paths = []
    for k in range(4):
        out = np.array([np.cos(start + k * np.pi / 2), np.sin(start + k * np.pi / 2)])
        along = np.array([-out[1], out[0]])
        way = np.array([-1.0, 1.0])[:, None] * (radius + 0.7 * organ.h)
        line = centre + radius * out + way * along
        paths.append(_upright(organ, _resampled(line, STEP * organ.h), None, np.zeros(2)))
    inside = np.append(centre, organ.middle[2])
    return Cut(tuple(paths), True, inside, radius, np.sqrt(2) * radius)


def _turned(line: Floats, organ: Organ, rng: np.random.Generator) -> Floats:
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    turned: Floats = (line - line.mean(axis=0)) @ np.array([[c, s], [-s, c]])
    return turned + organ.middle[:2] + rng.uniform(-1, 1, 2) * organ.h


def _arc(rng: np.random.Generator) -> Floats:
    turn = np.linspace(0, rng.uniform(0.5, 4.5), 300)
    return rng.uniform(1.5, 8.0) * np.column_stack([np.cos(turn), np.sin(turn)])


def _wave(rng: np.random.Generator) -> Floats:
    x = np.linspace(-6, 6, 400)
    length = rng.uniform(4.0, 10.0)
    # The least radius is (length / 2 pi)^2 / height.
    height = (length / (2 * np.pi)) ** 2 / rng.uniform(1.5, 4.0)
    return np.column_stack([x, height * np.sin(2 * np.pi * x / length + rng.uniform(0, 6))])


def _spiral(rng: np.random.Generator) -> Floats:
    turn = np.linspace(0, rng.uniform(6.5, 11.0), 900)
    radius = rng.uniform(1.5, 2.0) + rng.uniform(2.5, 3.0) * turn / (2 * np.pi)
    return radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])


def _loop(rng: np.random.Generator) -> Floats:
    radius = rng.uniform(2.0, 4.0)
    turn = np.linspace(-0.5 * np.pi, 1.5 * np.pi, 600)
    ring = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    way = np.linspace(0, rng.uniform(2.0, 5.0), 60)[1:]
    before = np.column_stack([-way[::-1], np.full(len(way), -radius)])
    after = np.column_stack([way, np.full(len(way), -radius)])
    return np.concatenate([before, ring, after])


SHAPES: dict[str, Callable[[np.random.Generator], Floats]] = {
    'arc': _arc,
    'wave': _wave,
    'spiral': _spiral,
    'loop': _loop,
}


def curved(organ: Organ, shape: str, rng: np.random.Generator, *, through: bool = True) -> Cut:
    """Return a random curved stroke; its sizes are in edges of the mesh.

    Args:
        organ: mesh.
        shape: key of `SHAPES`.
        rng: source of it all.
        through: through all the thickness; else to a random depth, tilted.
    """
    line = _turned(SHAPES[shape](rng) * organ.h, organ, rng)
    depth, tilt = None, np.zeros(2)
    if not through:
        depth = float(rng.uniform(0.7, 1.0) * np.ptp(organ.nodes[:, 2]))
        tilt = rng.uniform(-0.4, 0.4, 2)
    return Cut((_upright(organ, _resampled(line, STEP * organ.h), depth, tilt),))
