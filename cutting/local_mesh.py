"""Part of a mesh around a stroke, as it is after a batch that is not yet applied."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.swept_surface import Floats, Ints
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, interpolated
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES


class Local(NamedTuple):
    """Elements near a place as they are after a batch.

    Attributes:
        nodes: in the mesh; new ones count on from it; sorted, shape (j,).
        rest: of these nodes [m], shape (j, 3).
        corners: rows of nodes, shape (k, 4).
        number: in the mesh, or -1 - number in the batch, shape (k,).
        across: face 4 e + f behind each face, or -1, shape (k, 4).
    """

    nodes: Ints
    rest: Floats
    corners: Ints
    number: Ints
    across: Ints


@inner
def _from_line(line, place):
    """Return the distance of a place from a segment [m]."""
    along = length = square = 0.0
    for i in range(3):
        way = line[1, i] - line[0, i]
        along += way * (place[i] - line[0, i])
        length += way * way
    share = min(max(along / max(length, 1e-300), 0.0), 1.0)
    for i in range(3):
        square += (place[i] - line[0, i] - share * (line[1, i] - line[0, i])) ** 2
    return np.sqrt(square)


@kernel
def distances_from_line(line, places):
    """Return distances from a segment [m], shape (k,)."""
    found = np.empty(len(places))
    for k in range(len(places)):
        found[k] = _from_line(line, places[k])
    return found


@kernel
def _gather(links, rest, seeds, removed, line, region, rings):
    """Return the numbers of the elements around some nodes near a segment, sorted.

    Args:
        links: connectivity of the mesh.
        rest: of its nodes [m], shape (n, 3).
        seeds: nodes where the search begins, shape (k,).
        removed: elements to be left out, shape (r,).
        line: the segment [m], shape (2, 3).
        region: largest distance from it of a seed, and of an element beyond which the search goes
            on [m].
        rings: steps of the search, from element to element.
    """
    known, nodes = {np.int64(-1)}, {np.int64(-1)}
    found = [np.int64(0) for _ in range(0)]
    queue = [np.int64(0) for _ in range(0)]
    for tet in removed:
        known.add(np.int64(tet))
    for k in range(len(seeds)):
        node = np.int64(seeds[k])
        if node not in nodes and _from_line(line, rest[node]) < region:
            nodes.add(node)
            queue.append(node)
    middle = np.empty(3)
    begin = 0
    for _ in range(rings):
        end = len(queue)
        for k in range(begin, end):
            corner = links.first_corner[queue[k]]
            while corner >= 0:
                tet = np.int64(corner // 4)
                corner = links.corner_next[corner]
                if tet in known:
                    continue
                known.add(tet)
                found.append(tet)
                middle[:] = 0.0
                for i in range(4):
                    middle += rest[links.tetrahedra[tet, i]] / 4
                if _from_line(line, middle) >= region:
                    continue
                for i in range(4):
                    node = np.int64(links.tetrahedra[tet, i])
                    if node not in nodes:
                        nodes.add(node)
                        queue.append(node)
        begin = end
    return np.sort(np.array(found, np.int64))


@kernel
def _match(corners, count):
    """Return the face behind each face, or -1, shape (k, 4).

    Args:
        corners: of elements, numbers below `count`, shape (k, 4).
        count: number of nodes.
    """
    across = np.full((len(corners), 4), -1, np.int64)
    first, following = np.full(count, -1, np.int64), np.full(4 * len(corners), -1, np.int64)
    ends = np.empty((4 * len(corners), 3), np.int64)
    for face in range(4 * len(corners)):
        e, f = face // 4, face % 4
        a, b = corners[e, FACE_NODES[f, 0]], corners[e, FACE_NODES[f, 1]]
        c = corners[e, FACE_NODES[f, 2]]
        low, high = min(a, b, c), max(a, b, c)
        ends[face, 0], ends[face, 1], ends[face, 2] = low, a + b + c - low - high, high
        other, before = first[low], np.int64(-1)
        while other >= 0 and not (
            ends[other, 1] == ends[face, 1] and ends[other, 2] == ends[face, 2]
        ):
            before, other = other, following[other]
        if other < 0:
            following[face] = first[low]
            first[low] = face
            continue
        across[e, f], across[other // 4, other % 4] = other, face
        if before < 0:
            first[low] = following[other]
        else:
            following[before] = following[other]
    return across


def local_elements(
    mesh: TetMesh, delta: TopologyDelta, seeds: Ints, line: Floats, region: float, rings: int
) -> Local:
    """Return the elements near a segment as they are after a batch, and all that it has made."""
    removed = np.ascontiguousarray(delta.removed_tetrahedra)
    old = _gather(mesh.links, mesh.rest, seeds, removed, line, region, rings)
    number = np.concatenate([old, -1 - np.arange(len(delta.tetrahedra))])
    corners = np.concatenate([mesh.links.tetrahedra[old], delta.tetrahedra])
    nodes, rows = np.unique(corners, return_inverse=True)
    corners = np.ascontiguousarray(rows.reshape(-1, 4), np.int64)
    rest = np.empty((len(nodes), 3))
    first_new = int(np.searchsorted(nodes, mesh.node_count))
    rest[:first_new] = mesh.rest[nodes[:first_new]]
    new = nodes[first_new:] - mesh.node_count
    rest[first_new:] = interpolated(mesh.rest, delta.node_parents[new], delta.node_weights[new])
    _, at, here = np.intersect1d(nodes, delta.moved_nodes, return_indices=True)
    rest[at] = interpolated(mesh.rest, delta.moved_parents[here], delta.moved_weights[here])
    return Local(nodes, rest, corners, number, _match(corners, len(nodes)))


def centres_of(local: Local) -> Floats:
    """Return the centres of elements at rest [m], shape (k, 3)."""
    centres: Floats = local.rest[local.corners].mean(axis=1)
    return centres


@inner
def list_corners(corners, count):
    """Return the first corner at each node, shape (count,), and the next one at the same node.

    Args:
        corners: of elements, numbers below `count`, shape (k, 4).
        count: number of nodes.

    Returns:
        Corners 4 e + i, ascending at each node, then -1.
    """
    first, following = np.full(count, -1, np.int64), np.empty(4 * len(corners), np.int64)
    for corner in range(4 * len(corners) - 1, -1, -1):
        node = corners[corner // 4, corner % 4]
        following[corner] = first[node]
        first[node] = corner
    return first, following


def area_of(triangles: Floats) -> float:
    """Return the area of some triangles by their corners [m], shape (k, 3, 3), in m^2."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
