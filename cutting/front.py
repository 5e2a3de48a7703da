"""The front of a cut: at the end of a stroke its nodes slide to where the blade has been.

A front follows the elements, and ends up to half an edge short of the blade's end or beyond it. Its
nodes slide in the rest shape to the nearest place on the path of the blade's end, as far as the
elements around them stay well shaped. Those between two regions of the tissue stay.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.geometry import altitude, smallest_altitudes
from cutting_trainer.cutting.local_mesh import Local, area_of, list_corners, local_elements
from cutting_trainer.cutting.swept_surface import Floats, Ints
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.locate import find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

_FARTHEST = 1.0
"""Way that a node slides at most, in edges."""
_MIN_ALTITUDE_LEFT = 0.35
"""Share of the smallest altitude around a node that a slide must leave."""
_PARTS = 4
"""A slide that goes too far is tried again, shorter by one of so many parts."""
_SWEEPS = 3
"""Times that all nodes slide: each makes room for its neighbours."""


class Opened(NamedTuple):
    """Faces that cuts have opened around a stroke.

    Attributes:
        rest: of their nodes [m], shape (j, 3).
        triangles: one of the two that lie on each other, shape (f, 3).
    """

    rest: Floats
    triangles: Ints


def slide_front(
    mesh: TetMesh,
    delta: TopologyDelta,
    nodes: Ints,
    first_new: int,
    lines: Floats,
    h: float,
    small: float,
) -> tuple[TopologyDelta, float, Opened]:
    """Let the front of a stroke slide to where the blade has been.

    Args:
        mesh: before the last batch of the stroke.
        delta: that batch.
        nodes: of the mesh, that the stroke has passed, shape (k,).
        first_new: number of the first node that the stroke has made.
        lines: the blade's edge along the stroke, root and tip, in the rest shape [m], shape
            (k, 2, 3).
        h: length of an edge [m].
        small: altitude below which no slide makes an element [m].

    Returns:
        The batch with the slides, the further area [m^2], and the faces that are open then.
    """
    local = local_elements(mesh, delta, nodes, lines[0], np.inf, 1)
    place = np.unique(local.rest, axis=0, return_inverse=True)[1].ravel()
    faces, pairs = _open_faces(local, place)
    own = local.nodes >= first_new
    own[np.searchsorted(local.nodes, np.intersect1d(nodes, local.nodes))] = True
    if len(mesh.regions):
        own &= ~_between_regions(mesh, delta, local)
    fronts = np.flatnonzero(_on_front(local, place, faces, pairs) & own)
    targets, distance = _nearest_on(_border(lines), local.rest[fronts])
    near = (distance < _FARTHEST * h) & (distance > 1e-3 * h)
    fronts, targets = fronts[near], targets[near]
    faces = faces[pairs[:, 0]]
    opened = local.corners[faces[:, None] // 4, FACE_NODES[faces % 4]]
    rest = local.rest.copy()
    _slide(rest, local.corners, fronts, targets, small)
    fronts = fronts[(rest[fronts] != local.rest[fronts]).any(axis=1)]
    found, weights = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, rest[fronts])
    lost = found < 0
    rest[fronts[lost]] = local.rest[fronts[lost]]
    fronts, found, weights = fronts[~lost], found[~lost], weights[~lost]
    if (smallest_altitudes(rest, local.corners) <= 0.0).any():
        return delta, 0.0, Opened(local.rest, opened)
    parents = mesh.tetrahedra[found].astype(np.int64)
    further = area_of(rest[opened]) - area_of(local.rest[opened])
    delta = _with_places(mesh, delta, local.nodes[fronts], parents, weights)
    return delta, further, Opened(rest, opened)


def _open_faces(local: Local, place: Ints) -> tuple[Ints, Ints]:
    """Return the faces with nothing behind them, 4 e + f, and which two of them lie on each other.

    Args:
        local: the elements.
        place: number of the place of each node, the same for copies of a node, shape (j,).
    """
    faces = np.flatnonzero(local.across.ravel() < 0)
    keys = np.sort(place[local.corners[faces[:, None] // 4, FACE_NODES[faces % 4]]], axis=1)
    order = np.lexsort(keys.T)
    same = np.flatnonzero((keys[order[1:]] == keys[order[:-1]]).all(axis=1))
    return faces, np.column_stack([order[same], order[same + 1]])


def _on_front(local: Local, place: Ints, faces: Ints, pairs: Ints) -> NDArray[np.bool_]:
    """Return which nodes end a cut inside the tissue, shape (j,).

    Both faces of the cut have such a node, it has no copy, and no other face without a neighbour.
    """
    corners = local.corners[faces[:, None] // 4, FACE_NODES[faces % 4]]
    front, outer = np.zeros(len(place), bool), np.zeros(len(place), bool)
    one, two = np.sort(corners[pairs[:, 0]], axis=1), corners[pairs[:, 1]]
    front[one[(one[:, :, None] == two[:, None]).any(axis=2)]] = True
    single = np.ones(len(faces), bool)
    single[pairs.ravel()] = False
    outer[corners[single]] = True
    return front & ~outer & (np.bincount(place)[place] == 1)


def _between_regions(mesh: TetMesh, delta: TopologyDelta, local: Local) -> NDArray[np.bool_]:
    """Return which nodes have elements of several regions, shape (j,)."""
    region = np.empty(len(local.corners), np.uint8)
    old = local.number >= 0
    region[old] = mesh.regions[local.number[old]]
    region[~old] = delta.regions[-1 - local.number[~old]]
    least, most = np.full(len(local.nodes), 255), np.zeros(len(local.nodes), int)
    np.minimum.at(least, local.corners, region[:, None])
    np.maximum.at(most, local.corners, region[:, None])
    return np.asarray(least < most)


def _border(lines: Floats) -> Floats:
    """Return the path of the blade's end, with the edge at both ends of the stroke, (k, 3)."""
    return np.concatenate([lines[0, :1], lines[:, 1], lines[-1, :1]])


def _nearest_on(path: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return the nearest point of a path, shape (k, 3), and its distance [m], by place."""
    begin, ways = path[:-1], np.diff(path, axis=0)
    square = np.maximum((ways**2).sum(axis=1), 1e-300)
    share = ((places[:, None] - begin) * ways).sum(axis=2) / square
    points = begin + share.clip(0.0, 1.0)[:, :, None] * ways
    distance = np.linalg.norm(points - places[:, None], axis=2)
    best = distance.argmin(axis=1)
    rows = np.arange(len(places))
    return points[rows, best], distance[rows, best]


@kernel
def _slide(rest, corners, fronts, targets, small):
    """Move nodes towards their targets, as far as the elements around them stay well shaped.

    Args:
        rest: of the nodes [m]; changed, shape (j, 3).
        corners: of the elements, shape (k, 4).
        fronts: the nodes, shape (f,).
        targets: [m], shape (f, 3).
        small: altitude below which no element gets [m].
    """
    first, following = list_corners(corners, len(rest))
    least = np.full(len(fronts), -1.0)
    for _ in range(_SWEEPS):
        for k in range(len(fronts)):
            node = fronts[k]
            start = rest[node].copy()
            if least[k] < 0.0:
                before = _smallest(rest, corners, first, following, node)
                least[k] = max(_MIN_ALTITUDE_LEFT * before, min(before, small))
            for part in range(_PARTS, 0, -1):
                for i in range(3):
                    rest[node, i] = start[i] + part / _PARTS * (targets[k, i] - start[i])
                if _smallest(rest, corners, first, following, node) >= least[k]:
                    break
                rest[node] = start


@inner
def _smallest(rest, corners, first, following, node):
    """Return the smallest altitude of the elements around a node [m]."""
    smallest, corner = np.inf, first[node]
    while corner >= 0:
        e = corner // 4
        a, b, c, d = corners[e, 0], corners[e, 1], corners[e, 2], corners[e, 3]
        smallest = min(smallest, altitude(rest[a], rest[b], rest[c], rest[d]))
        corner = following[corner]
    return smallest


def _with_places(
    mesh: TetMesh, delta: TopologyDelta, nodes: Ints, parents: Ints, weights: Floats
) -> TopologyDelta:
    """Return a batch after which some nodes lie elsewhere.

    Args:
        mesh: before the batch.
        delta: the batch.
        nodes: which lie elsewhere; new ones count on from the mesh's, shape (k,).
        parents, weights: their places among the nodes before the batch, each shape (k, 4).
    """
    new = nodes >= mesh.node_count
    node_parents, node_weights = delta.node_parents.copy(), delta.node_weights.copy()
    node_parents[nodes[new] - mesh.node_count] = parents[new]
    node_weights[nodes[new] - mesh.node_count] = weights[new]
    stays = ~np.isin(delta.moved_nodes, nodes[~new])
    return replace(
        delta,
        node_parents=node_parents,
        node_weights=node_weights,
        moved_nodes=np.concatenate([delta.moved_nodes[stays], nodes[~new]]),
        moved_parents=np.concatenate([delta.moved_parents[stays], parents[~new]]),
        moved_weights=np.concatenate([delta.moved_weights[stays], weights[~new]]),
    )
