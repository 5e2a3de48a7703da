"""Bridges: tissue that hangs on across the surface that a stroke has swept.

An element whose nodes are all on the cut, though not all of them on the swept surface, is given a
side by itself; the faces between such elements need not close the cut. At the end of a stroke, the
tissue that still connects its two sides is parted by a least cut. Tissue that a blade has swept
without opening it is parted, too: an earlier motion has put nodes on the wrong side there.
"""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.coverage import GAP, uncovered_points
from cutting_trainer.cutting.front import Opened
from cutting_trainer.cutting.local_mesh import Local, centres_of, local_elements
from cutting_trainer.cutting.lookup import MINUS, NODES, PLUS, Tables
from cutting_trainer.cutting.parting import judged_heights, least_faces, open_faces
from cutting_trainer.cutting.swept_surface import Floats, Surface, nearest_points
from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta

Mask = NDArray[np.bool_]

_TUBE = 1.0
"""Height above the surface up to which an element is looked at, in edges."""
_CLEAR = 0.35
"""Height above the surface from which an element is on one side, in edges."""
_MARGIN = 1.0
"""Width of the strip along a free border of the surface that is not judged, in edges."""
_AROUND = 1.0
"""Distance from a place that is not opened up to which the tissue is parted, in edges."""
_UNCOVERED_MARGIN = 0.5
"""The margin for places that are not opened, in edges."""
_SHEET = 0.4
"""Distance from the tangent plane up to which another place is of the same sheet, in edges."""
_STEP = 0.2
_TRIES = 2
_LAYERS = 2
"""Layers of elements around those of the stroke through which tissue may hang on."""


def part_bridges(
    mesh: TetMesh, delta: TopologyDelta, tables: Tables, first_new: int, lines: Floats, h: float
) -> tuple[TopologyDelta, float, Floats]:
    """Part the tissue that connects the two sides of a stroke.

    Args:
        mesh: before the last batch of the stroke.
        delta: that batch.
        tables: of the stroke.
        first_new: number of the first node that the stroke has made.
        lines: the blade's edge along the stroke, root and tip, in the rest shape [m], shape
            (k, 2, 3).
        h: length of an edge [m].

    Returns:
        The batch with the parting, the further area [m^2], and the places at rest [m], shape
        (j, 3), where tissue could not be parted.
    """
    surface = _judged_surface(lines, h, _MARGIN * h)
    area, places = 0.0, np.zeros((0, 3))
    if not len(surface.points):
        return delta, area, places
    nodes = tables.node_id[: tables.counts[NODES]]
    for attempt in range(1 + _TRIES):
        local = local_elements(mesh, delta, nodes, lines[0], np.inf, 1)
        plus, minus = _sides(local, tables, first_new)
        height = judged_heights(local, surface, np.ones(len(plus), bool), h)
        height *= np.sign(np.nansum(height[plus]) - np.nansum(height[minus]))
        plus, minus = plus & (height > _CLEAR * h), minus & (height < -_CLEAR * h)
        faces = least_faces(local, surface, np.abs(height) < _TUBE * h, plus, minus, h)
        places = centres_of(local)[faces // 4]
        if not len(faces) or attempt == _TRIES:
            break
        delta, more = open_faces(mesh, delta, local, faces)
        area += more
    return delta, area, places


def part_uncovered(
    mesh: TetMesh,
    delta: TopologyDelta,
    tables: Tables,
    opened: Opened,
    lines: Floats,
    h: float,
) -> tuple[TopologyDelta, float]:
    """Part the tissue where a blade has swept without opening it.

    Elements have the side of the surface on which they lie, whatever the stroke says of their
    nodes.

    Args:
        mesh, delta, tables, lines, h: as of `part_bridges`.
        opened: faces opened around the stroke.

    Returns:
        The batch with the parting, and the further area [m^2].
    """
    surface = _judged_surface(lines, h, _UNCOVERED_MARGIN * h)
    places = uncovered_points(mesh, surface, opened, h)
    if not len(places):
        return delta, 0.0
    _, away = nearest_points(Surface(places, places), surface.points)
    around = away < _AROUND * h
    surface = Surface(surface.points[around], surface.normals[around])
    nodes = tables.node_id[: tables.counts[NODES]]
    local = local_elements(mesh, delta, nodes, lines[0], np.inf, _LAYERS)
    height = judged_heights(local, surface, np.ones(len(local.corners), bool), h)
    judged = np.abs(height) < _TUBE * h
    faces = least_faces(local, surface, judged, height > _CLEAR * h, height < -_CLEAR * h, h)
    return open_faces(mesh, delta, local, faces) if len(faces) else (delta, 0.0)


def _sides(local: Local, tables: Tables, first_new: int) -> tuple[Mask, Mask]:
    """Return which elements lie on each side of a stroke by their nodes, each shape (k,)."""
    side = np.zeros(len(local.nodes), np.int8)
    old = local.nodes < first_new
    rows = tables.node_row[local.nodes[old]]
    side[old] = np.where(rows >= 0, tables.node_side[rows], 0)
    plus = (side[local.corners] == PLUS).any(axis=1)
    minus = (side[local.corners] == MINUS).any(axis=1)
    return plus & ~minus, minus & ~plus


def _judged_surface(lines: Floats, h: float, margin: float) -> Surface:
    """Return the surface that a stroke has swept, away from its borders and its other sheets.

    Args:
        lines: as of `part_bridges`.
        h: length of an edge [m].
        margin: width of the strip along a border that is left out [m].
    """
    steps = np.linalg.norm(np.diff(lines, axis=0), axis=2).mean(axis=1)
    runs = np.split(lines, np.flatnonzero(steps > GAP * h) + 1)
    runs = [_filled(run, h) for run in runs if len(run) > 1]
    if not runs:
        return Surface(np.zeros((0, 3)), np.zeros((0, 3)))
    longest = max(np.linalg.norm(run[:, 1] - run[:, 0], axis=1).max() for run in runs)
    across = np.linspace(0, 1, int(np.ceil(longest / (_STEP * h))) + 1)
    points, normals, judged, ways = [], [], [], []
    before = 0.0
    for run in runs:
        edges = run[:, 1] - run[:, 0]
        at = run[:, :1] + across[:, None] * edges[:, None]
        normal = np.cross(np.gradient(at, axis=0), edges[:, None])
        normal /= np.linalg.norm(normal, axis=2, keepdims=True).clip(1e-300)
        way = _way(run)
        deep = across * np.linalg.norm(edges, axis=1)[:, None]
        inner = np.minimum(way, way[-1] - way) > margin
        points.append(at)
        normals.append(normal)
        judged.append(inner[:, None] & (deep > margin) & (deep[:, -1:] - deep > margin))
        ways.append(before + way)
        before += way[-1] + 10 * h
    point, normal, way = np.concatenate(points), np.concatenate(normals), np.concatenate(ways)
    middle = len(across) // 2
    alone = _alone(point[:, middle].copy(), normal[:, middle].copy(), way, h)
    keep = np.concatenate(judged) & alone[:, None] & (normal != 0.0).any(axis=2)
    return Surface(point[keep], normal[keep])


def _way(run: Floats) -> Floats:
    """Return the way of the blade's middle along a run [m], shape (k,)."""
    steps = np.linalg.norm(np.diff(run.mean(axis=1), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _filled(run: Floats, h: float) -> Floats:
    """Return a run at equal steps, shape (k, 2, 3)."""
    way = _way(run)
    at = np.linspace(0.0, way[-1], int(np.ceil(way[-1] / (_STEP * h))) + 2)
    columns = [np.interp(at, way, column) for column in run.reshape(-1, 6).T]
    return np.stack(columns, axis=1).reshape(-1, 2, 3)


@kernel
def _alone(middle, normal, way, h):
    """Return whether no other sheet is near, by place along a stroke, shape (k,).

    Args:
        middle: of the edge [m], shape (k, 3).
        normal: of the surface there, unit, shape (k, 3).
        way: of the blade before [m], shape (k,).
        h: length of an edge [m].
    """
    alone = np.ones(len(way), np.bool_)
    far, near = 1.5 * np.pi * _TUBE * h, 3 * _TUBE * h  # two tubes, and an element
    for k in range(len(way)):
        for j in range(k):
            if way[k] - way[j] <= far:
                break
            square = above = below = 0.0
            for i in range(3):
                gap = middle[k, i] - middle[j, i]
                square += gap * gap
                above += gap * normal[k, i]
                below += gap * normal[j, i]
            if square < near * near and max(abs(above), abs(below)) > _SHEET * h:
                alone[k] = alone[j] = False
    return alone
