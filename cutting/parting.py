"""Parting of tissue along faces of the mesh near a surface, by a least cut."""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.state_table import outer_bits_of
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, interpolated
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_REGION = 2.2
"""Distance from a line within which the tissue is looked at, in edges."""
_CLEAR = 0.35
"""Height above the surface from which an element is on one side, in edges."""
_ASIDE = 0.25
"""Distance aside of the surface up to which an element is judged, in edges."""
_ADJACENT = 5
"""Times that the elements beside the region are added to it."""


class Surface(NamedTuple):
    """Points of a swept surface [m] and unit normals, each shape (p, 3)."""

    points: Floats
    normals: Floats


class _Local(NamedTuple):
    """Elements near a junction as they are after the batch.

    Attributes:
        corners: nodes; new ones count on from the mesh's, shape (k, 4).
        number: in the mesh, or -1 - number in the batch, shape (k,).
        rest: of all nodes [m], shape (n + a, 3).
        across: element behind each face, or -1, shape (k, 4).
    """

    corners: Ints
    number: Ints
    rest: Floats
    across: Ints


def nearest_points(surface: Surface, places: Floats) -> tuple[Ints, Floats]:
    """Return the nearest point of a surface, and its distance [m], by place."""
    squares = (places**2).sum(axis=1)[:, None] + (surface.points**2).sum(axis=1)
    squares -= 2 * places @ surface.points.T
    nearest = squares.argmin(axis=1)
    return nearest, np.linalg.norm(places - surface.points[nearest], axis=1)


def _local(mesh: TetMesh, delta: TopologyDelta, seeds: Ints, line: Floats, h: float) -> _Local:
    """Return the elements near a line, as they are after a batch."""
    new = interpolated(mesh.rest, delta.node_parents, delta.node_weights)
    rest = np.concatenate([mesh.rest, new])
    rest[delta.moved_nodes] = interpolated(mesh.rest, delta.moved_parents, delta.moved_weights)
    near = _distance_to(line, mesh.rest[seeds]) < _REGION * h
    gone = set(np.asarray(delta.removed_tetrahedra).tolist())
    links = mesh.links
    nodes = set(seeds[near].tolist())
    found: set[int] = set()
    for _ in range(_ADJACENT):
        fresh: list[int] = []
        for node in nodes:
            corner = int(links.first_corner[node])
            while corner >= 0:
                if corner // 4 not in found:
                    found.add(corner // 4)
                    fresh.append(corner // 4)
                corner = int(links.corner_next[corner])
        inside = links.tetrahedra[fresh] if fresh else np.zeros((0, 4), np.int64)
        inside = inside[_distance_to(line, mesh.rest[inside].mean(axis=1)) < _REGION * h]
        nodes = set(inside.ravel().tolist())
    old = np.array(sorted(found - gone), np.int64)
    corners = np.concatenate([links.tetrahedra[old], delta.tetrahedra]).astype(np.int64)
    number = np.concatenate([old, -1 - np.arange(len(delta.tetrahedra))])
    return _Local(corners, number, rest, _across(corners))


def _distance_to(line: Floats, places: Floats) -> Floats:
    """Return distances from a segment [m], shape (k,)."""
    way = line[1] - line[0]
    share = ((places - line[0]) @ way / max(float(way @ way), 1e-300)).clip(0.0, 1.0)
    distance: Floats = np.linalg.norm(places - line[0] - share[:, None] * way, axis=1)
    return distance


def _across(corners: Ints) -> Ints:
    faces = np.sort(corners[:, FACE_NODES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    across = np.full(len(faces), -1)
    one, two = order[:-1][same], order[1:][same]
    across[one], across[two] = two // 4, one // 4
    return across.reshape(-1, 4)


def part_along(
    mesh: TetMesh,
    delta: TopologyDelta,
    nodes: Ints,
    surface: Surface,
    lines: Floats,
    h: float,
) -> tuple[TopologyDelta, float]:
    """Part the tissue along a surface where faces connect its sides, near some lines.

    Args:
        mesh: before a batch.
        delta: that batch.
        nodes: of the mesh, where the search begins, shape (k,).
        surface: along which to part.
        lines: segments at rest [m], shape (e, 2, 3).
        h: length of an edge [m].

    Returns:
        The batch with the parting, and the further area [m^2].
    """
    area = 0.0
    for line in lines:
        local = _local(mesh, delta, nodes, line, h)
        faces = _least_cut(local, surface, line, h)
        if len(faces):
            delta, more = _open(mesh, delta, local, faces)
            area += more
    return delta, area


def _least_cut(local: _Local, surface: Surface, line: Floats, h: float) -> Ints:
    """Return the faces to be opened, as element and face, shape (f, 2)."""
    centres = local.rest[local.corners].mean(axis=1)
    nearest, distance = nearest_points(surface, centres)
    height = ((centres - surface.points[nearest]) * surface.normals[nearest]).sum(axis=1)
    aside = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    judged = (aside < _ASIDE * h) & (np.abs(height) < 1.5 * h)
    judged &= _distance_to(line, centres) < _REGION * h
    sources = np.flatnonzero(judged & (height > _CLEAR * h))
    sinks = set(np.flatnonzero(judged & (height < -_CLEAR * h)).tolist())
    across = np.where(judged[local.across] & (local.across >= 0), local.across, -1)
    across[~judged] = -1
    if not len(sources) or _way(across, sources.tolist(), sinks, {}) is None:
        return np.zeros((0, 2), np.int64)
    elements, face = np.nonzero(across >= 0)
    middle = local.rest[local.corners[elements[:, None], FACE_NODES[face]]].mean(axis=1)
    nearest, _ = nearest_points(surface, middle)
    off = np.abs(((middle - surface.points[nearest]) * surface.normals[nearest]).sum(axis=1)) / h
    cost = 1 + np.round(40.0 * off**2).astype(np.int64)
    return _flow(across, sources.tolist(), sinks, elements, face, cost)


def _flow(
    across: Ints, sources: list[int], sinks: set[int], elements: Ints, face: Ints, cost: Ints
) -> Ints:
    """Return the faces of a least cut (Edmonds and Karp), shape (f, 2)."""
    pairs = zip(elements.tolist(), face.tolist(), strict=True)
    ends = [(e, int(across[e, f])) for e, f in pairs]
    room = dict(zip(ends, cost.tolist(), strict=True))
    for _ in range(10 * len(room)):
        way = _way(across, sources, sinks, room)
        if way is None:
            break
        least = min(room[step] for step in way)
        for a, b in way:
            room[a, b] -= least
            room[b, a] += least
    reached = _reached(across, sources, room)
    return np.array(
        [
            (e, f)
            for (e, to), f in zip(ends, face.tolist(), strict=True)
            if e in reached and to not in reached
        ],
        np.int64,
    ).reshape(-1, 2)


def _reached(across: Ints, sources: list[int], room: dict[tuple[int, int], int]) -> dict[int, int]:
    """Return the element before each one that can be reached."""
    before = dict.fromkeys(sources, -1)
    queue = deque(sources)
    while queue:
        at = queue.popleft()
        for to in across[at].tolist():
            if to >= 0 and to not in before and room.get((at, to), 1) > 0:
                before[to] = at
                queue.append(to)
    return before


def _way(
    across: Ints, sources: list[int], sinks: set[int], room: dict[tuple[int, int], int]
) -> list[tuple[int, int]] | None:
    """Return the steps of a shortest way from the sources to the sinks, if there is one."""
    before = _reached(across, sources, room)
    at = next((element for element in before if element in sinks), None)
    if at is None:
        return None
    way = []
    while before[at] >= 0:
        way.append((before[at], at))
        at = before[at]
    return way


def _open(
    mesh: TetMesh, delta: TopologyDelta, local: _Local, faces: Ints
) -> tuple[TopologyDelta, float]:
    """Open faces, and give a node to each part of the elements around a node that they part."""
    corners, across = local.corners.copy(), local.across.copy()
    for element, face in faces.tolist():
        other = across[element, face]
        across[other, across[other] == element] = -1
        across[element, face] = -1
    nodes = np.unique(local.corners[faces[:, :1], FACE_NODES[faces[:, 1]]])
    volume = _volumes(local)
    copies: list[int] = []
    first = len(local.rest)
    for node in nodes.tolist():
        if not _is_whole(mesh, delta, local, node):
            continue
        parts = _parts(local.corners, across, node)
        parts.sort(key=lambda part: -volume[part].sum())
        for part in parts[1:]:
            rows = np.array(part)
            corners[rows[:, None], np.arange(4)] = np.where(
                local.corners[rows] == node, first + len(copies), corners[rows]
            )
            copies.append(node)
    if not copies:
        return delta, 0.0
    area = 0.0
    for element, face in faces.tolist():
        other = local.across[element, face]
        own, its = corners[element, FACE_NODES[face]], corners[other]
        if not np.isin(own, its).all():
            a, b, c = local.rest[local.corners[element, FACE_NODES[face]]]
            area += float(np.linalg.norm(np.cross(b - a, c - a))) / 2
    return _with_copies(mesh, delta, local, corners, np.array(copies)), area


def _volumes(local: _Local) -> Floats:
    a, b, c, d = (local.rest[local.corners[:, i]] for i in range(4))
    volumes: Floats = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a)
    return volumes


def _is_whole(mesh: TetMesh, delta: TopologyDelta, local: _Local, node: int) -> bool:
    """Return whether all elements around a node are at hand."""
    if node >= mesh.node_count:
        return True
    around = set()
    corner = int(mesh.links.first_corner[node])
    while corner >= 0:
        around.add(corner // 4)
        corner = int(mesh.links.corner_next[corner])
    around -= set(np.asarray(delta.removed_tetrahedra).tolist())
    return around <= set(local.number[(local.corners == node).any(axis=1)].tolist())


def _parts(corners: Ints, across: Ints, node: int) -> list[list[int]]:
    """Return the parts of the elements around a node that faces with the node connect."""
    left = set(np.flatnonzero((corners == node).any(axis=1)).tolist())
    parts = []
    while left:
        queue = [min(left)]
        left.discard(queue[0])
        for at in queue:
            for face in range(4):
                to = int(across[at, face])
                if corners[at, face] != node and to in left:
                    left.discard(to)
                    queue.append(to)
        parts.append(queue)
    return parts


def _with_copies(
    mesh: TetMesh, delta: TopologyDelta, local: _Local, corners: Ints, copies: Ints
) -> TopologyDelta:
    """Return a batch with further copies of nodes."""
    n = mesh.node_count
    parents = np.repeat(copies[:, None], 4, axis=1)
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(copies), 1))
    new = copies >= n
    parents[new], weights[new] = (
        delta.node_parents[copies[new] - n],
        delta.node_weights[copies[new] - n],
    )
    row, slid = np.nonzero(copies[:, None] == np.asarray(delta.moved_nodes))
    parents[row], weights[row] = delta.moved_parents[slid], delta.moved_weights[slid]
    changed = (corners != local.corners).any(axis=1)
    old = changed & (local.number >= 0)
    stayed = local.number[old]
    tetrahedra = delta.tetrahedra.copy()
    mine = changed & (local.number < 0)
    tetrahedra[-1 - local.number[mine]] = corners[mine]
    return TopologyDelta(
        node_parents=np.concatenate([delta.node_parents, parents]),
        node_weights=np.concatenate([delta.node_weights, weights]),
        moved_nodes=delta.moved_nodes,
        moved_parents=delta.moved_parents,
        moved_weights=delta.moved_weights,
        removed_tetrahedra=np.sort(np.concatenate([delta.removed_tetrahedra, stayed]))[::-1],
        tetrahedra=np.concatenate([tetrahedra, corners[old]]),
        outer_faces=np.concatenate([delta.outer_faces, outer_bits_of(mesh.links, stayed)]),
    )
