"""Opened tissue against the targets of an exercise: coverage, deviation, depth, zones, pieces.

All geometry is that of the tissue at rest, so that neither the motion of the tissue nor the
opening of a wound changes a measure. Depth is along -z, from the height of the target.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from cutting_trainer.exercises.scene_schema import BallSettings, TargetSettings, ZoneSettings
from cutting_trainer.tissue_sim.mesh import pieces
from cutting_trainer.tissue_sim.mesh.checks import EDGES
from cutting_trainer.tissue_sim.mesh.pieces import free_parts

Floats = NDArray[np.float64]

SPACING_M = 0.0005
"""[m] between samples of a curve, and at most between those of a cut face."""
_MAX_ORDER = 40


class Tissue(pieces.Tissue, Protocol):
    """Mesh of a simulation or its replica, with its surface."""

    @property
    def triangles(self) -> NDArray[Any]:
        """Corners of the surface, shape (k, 3)."""

    @property
    def triangle_kind(self) -> NDArray[Any]:
        """1 for a cut face, 0 outside, shape (k,)."""


@dataclass(frozen=True)
class Opened:
    """Samples of the cut faces.

    Attributes:
        points: [m], shape (p, 3).
        areas: share of each sample in the area of one side of the cut [m^2], shape (p,).
    """

    points: Floats
    areas: Floats


@dataclass(frozen=True)
class Coverage:
    """Opened tissue along one target.

    Attributes:
        opened: share of the curve under which tissue is opened within the margin.
        depth_error: mean distance of the depth from the band, over the opened part [m]; NaN where
            nothing is opened.
        depth: mean depth of the opened part [m]; NaN where nothing is opened.
        near: whether each sample of the cut faces is within margin and largest depth, shape (p,).
    """

    opened: float
    depth_error: float
    depth: float
    near: NDArray[np.bool_]


def cut_faces(tissue: Tissue) -> Opened:
    """Return samples of the cut faces at rest, each face as often as its longest edge asks for.

    A cut has two sides: each counts half.
    """
    faces = np.asarray(tissue.triangles)[np.asarray(tissue.triangle_kind) == 1]
    corners = np.asarray(tissue.rest, float)[faces]
    if not len(corners):
        return Opened(np.zeros((0, 3)), np.zeros(0))
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.25 * np.linalg.norm(np.cross(first, second), axis=1)  # half, for one side
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    order = np.clip(np.ceil(longest / SPACING_M).astype(int), 1, _MAX_ORDER)
    points, shares = [], []
    for n in np.unique(order):
        of = order == n
        weights = _barycentric(int(n))
        points.append(np.einsum('qk,fkd->fqd', weights, corners[of]).reshape(-1, 3))
        shares.append(np.repeat(areas[of] / len(weights), len(weights)))
    return Opened(np.concatenate(points), np.concatenate(shares))


def _barycentric(order: int) -> Floats:
    """Return the centres of the n^2 equal parts of a triangle, as weights, shape (n^2, 3)."""
    i, j = np.divmod(np.arange(order * order), order)
    upward, downward = i + j <= order - 1, i + j <= order - 2
    up = np.column_stack([i, j])[upward] + 1 / 3
    down = np.column_stack([i, j])[downward] + 2 / 3
    places = np.concatenate([up, down]) / order
    return np.column_stack([1 - places.sum(axis=1), places])


def along(corners: Floats) -> Floats:
    """Return samples of a curve at even spacing, ends included [m], shape (s, 3)."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, reached[-1], max(int(np.ceil(reached[-1] / SPACING_M)), 1) + 1)
    return np.column_stack([np.interp(at, reached, corners[:, axis]) for axis in range(3)])


class Curve:
    """A target, ready for measurements.

    Args:
        target: its settings.

    Attributes:
        length: [m].
    """

    def __init__(self, target: TargetSettings) -> None:
        self._target = target
        corners = target.corners()
        self._samples = along(corners)
        self.length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
        self.target_area = self.length * float(np.mean(target.depth))

    def coverage(self, opened: Opened) -> Coverage:
        """Return the opened tissue along the target."""
        target, samples = self._target, self._samples
        nearest, off = _nearest(opened.points[:, :2], samples[:, :2])
        depth = samples[nearest, 2] - opened.points[:, 2]
        within = off <= target.margin
        deepest = np.full(len(samples), -np.inf)
        np.maximum.at(deepest, nearest[within], depth[within])
        # Faces are sampled as finely as the curve: a gap of one sample is between two points.
        spread = np.maximum(deepest, np.maximum(_shift(deepest, 1), _shift(deepest, -1)))
        covered = spread > 0.0
        if not covered.any():
            nothing = float('nan')
            return Coverage(0.0, nothing, nothing, within & (depth <= target.depth[1]))
        reached = spread[covered]
        low, high = target.depth
        error = np.maximum(np.maximum(low - reached, reached - high), 0.0)
        return Coverage(
            opened=float(covered.mean()),
            depth_error=float(error.mean()),
            depth=float(reached.mean()),
            near=within & (depth <= high),
        )


def _shift(values: Floats, by: int) -> Floats:
    out = np.full_like(values, -np.inf)
    if by > 0:
        out[by:] = values[:-by]
    else:
        out[:by] = values[-by:]
    return out


def _nearest(points: Floats, samples: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the nearest sample of each point, and its distance [m]."""
    if not len(points):
        return np.zeros(0, np.int64), np.zeros(0)
    distances, nearest = cKDTree(samples).query(points)
    return np.asarray(nearest, np.int64), np.asarray(distances)


def distance_to_line(points: Floats, corners: Floats) -> Floats:
    """Return the distance of each point to the nearest segment of a line [m], shape (p,).

    Args:
        points: [m], shape (p, d), d 2 or 3.
        corners: of the line [m], shape (k, d).
    """
    begins, ways = corners[:-1], np.diff(corners, axis=0)
    square = np.maximum((ways**2).sum(axis=1), 1e-300)
    nearest = np.full(len(points), np.inf)
    for begin, way, size in zip(begins, ways, square, strict=True):
        share = np.clip((points - begin) @ way / size, 0.0, 1.0)
        off = np.linalg.norm(points - begin - share[:, None] * way, axis=1)
        nearest = np.minimum(nearest, off)
    return nearest


def zones_touched(opened: Opened, zones: Sequence[ZoneSettings]) -> list[str]:
    """Return the names of the zones that a cut face reaches into."""
    return [
        zone.name
        for zone in zones
        if (distance_to_line(opened.points, np.array(zone.points, float)) < zone.radius).any()
    ]


def free_pieces(tissue: Tissue) -> int:
    """Return the number of pieces that nothing connects with a fixed node."""
    return int(free_parts(tissue).max(initial=0))


def lesion_margin(tissue: Tissue, lesion: BallSettings) -> float:
    """Return the least thickness of tissue around a lesion in the piece that came off [m].

    It is the least distance from the lesion's surface to a cut face of the piece that contains its
    centre: negative where the cut goes into it, NaN while the lesion is not off.
    """
    part = free_parts(tissue)
    rest = np.asarray(tissue.rest, float)
    own = int(part[_node_in(tissue, lesion)])
    if not own:
        return math.nan
    triangles = np.asarray(tissue.triangles)
    faces = (np.asarray(tissue.triangle_kind) == 1) & (part[triangles[:, 0]] == own)
    cut = _Faces(rest, triangles[faces], np.ones(faces.sum(), int))
    points = cut_faces(cut).points
    if not len(points):
        return math.nan
    off = np.linalg.norm(points - np.array(lesion.centre), axis=1)
    return float(off.min()) - lesion.radius


def _node_in(tissue: Tissue, lesion: BallSettings) -> int:
    """Return a node of the element that contains the centre of a lesion, at rest."""
    rest, tetrahedra = np.asarray(tissue.rest, float), np.asarray(tissue.tetrahedra)
    corners = rest[tetrahedra]
    frame = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    usable = np.abs(np.linalg.det(frame)) > 1e-300
    places = np.full((len(tetrahedra), 3), -1.0)
    right = (np.array(lesion.centre) - corners[usable, 0])[..., None]
    places[usable] = np.linalg.solve(frame[usable], right)[..., 0]
    least = np.minimum(places.min(axis=1), 1 - places.sum(axis=1))
    return int(tetrahedra[int(least.argmax()), 0])


def bridge(
    tissue: Tissue, lesion: BallSettings, targets: Sequence[TargetSettings]
) -> tuple[int, int] | None:
    """Return the edge by which tissue still holds a lesion: two nodes; None where it is off.

    The shortest way through the tissue from the lesion to a fixed node leads over a bridge; the
    edge is that of the way whose middle is nearest to a target, as seen along z at rest.
    """
    rest, tetrahedra = np.asarray(tissue.rest, float), np.asarray(tissue.tetrahedra)
    start, count = _node_in(tissue, lesion), len(rest)
    links = np.unique(np.sort(tetrahedra[:, EDGES].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(rest[links[:, 0]] - rest[links[:, 1]], axis=1)
    graph = csr_array((np.maximum(lengths, 1e-12), tuple(links.T)), (count, count))
    away, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    away[np.asarray(tissue.fixed) != 1] = np.inf
    node = int(away.argmin())
    if not np.isfinite(away[node]) or node == start:
        return None
    way = [node]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    middles = 0.5 * (rest[way[1:]] + rest[way[:-1]])[:, :2]
    off = np.min([distance_to_line(middles, t.corners()[:, :2]) for t in targets], axis=0)
    k = int(off.argmin())
    return way[k + 1], way[k]


@dataclass(frozen=True)
class _Faces:
    """The cut faces of one piece."""

    rest: Floats
    triangles: NDArray[Any]
    triangle_kind: NDArray[Any]
    tetrahedra: NDArray[Any] = None  # type: ignore[assignment]
    fixed: NDArray[np.uint8] = None  # type: ignore[assignment]
