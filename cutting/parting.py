"""Parting of tissue along faces of the mesh near a surface, by a least cut."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.geometry import orientation
from cutting_trainer.cutting.least_cut import connected, least_cut
from cutting_trainer.cutting.local_mesh import (
    Local,
    area_of,
    centres_of,
    distances_from_line,
    list_corners,
    local_elements,
)
from cutting_trainer.cutting.state_table import outer_bits_of
from cutting_trainer.cutting.swept_surface import Floats, Ints, Surface, heights
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

_REGION = 2.2
"""Distance from a line within which the tissue is looked at, in edges."""
_CLEAR = 0.35
"""Height above the surface from which an element is on one side, in edges."""
_ASIDE = 0.25
"""Distance aside of the surface up to which an element is judged, in edges."""
_ADJACENT = 5
"""Times that the elements beside the region are added to it."""


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
        local = local_elements(mesh, delta, nodes, line, _REGION * h, _ADJACENT)
        near = distances_from_line(line, centres_of(local)) < _REGION * h
        height = judged_heights(local, surface, near, h)
        judged = np.abs(height) < 1.5 * h
        faces = least_faces(local, surface, judged, height > _CLEAR * h, height < -_CLEAR * h, h)
        if len(faces):
            delta, more = open_faces(mesh, delta, local, faces)
            area += more
    return delta, area


def judged_heights(local: Local, surface: Surface, near: NDArray[np.bool_], h: float) -> Floats:
    """Return the heights of elements above a surface [m], NaN aside of it, shape (k,).

    Args:
        local: the elements.
        surface: points and normals.
        near: elements that are looked at, shape (k,).
        h: length of an edge [m].
    """
    height = np.full(len(near), np.nan)
    above, aside = heights(surface, centres_of(local)[near])
    height[near] = np.where(aside < _ASIDE * h, above, np.nan)
    return height


def least_faces(
    local: Local,
    surface: Surface,
    judged: NDArray[np.bool_],
    sources: NDArray[np.bool_],
    sinks: NDArray[np.bool_],
    h: float,
) -> Ints:
    """Return the faces that part some elements from others, as near to a surface as may be.

    Args:
        local: all elements.
        surface: near which to part them.
        judged: elements through which they may be connected, shape (k,).
        sources, sinks: those to be parted, where judged, shape (k,).
        h: length of an edge [m].

    Returns:
        4 e + f, shape (f,).
    """
    sources, sinks = sources & judged, sinks & judged
    across = np.where(judged[local.across // 4] & (local.across >= 0), local.across, -1)
    across[~judged] = -1
    if not connected(across, sources, sinks):
        return np.zeros(0, np.int64)
    cost = np.ones((len(across), 4), np.int64)
    one = np.flatnonzero(across.ravel() > np.arange(across.size))
    other = across.ravel()[one]
    middle = local.rest[local.corners[one[:, None] // 4, FACE_NODES[one % 4]]].mean(axis=1)
    off = np.abs(heights(surface, middle)[0]) / h
    cost.ravel()[one] = cost.ravel()[other] = 1 + np.round(40.0 * off**2).astype(np.int64)
    kept = least_cut(across, cost, sources, sinks)
    behind = (across >= 0) & ~kept[across // 4]
    faces: Ints = np.flatnonzero(kept[:, None] & behind)
    return faces


@kernel
def _split(faces, across, corners, volumes, whole):
    """Give a node of its own to each part of the elements around a node that some faces part.

    Args:
        faces: that are opened, 4 e + f, shape (f,).
        across, corners: of the elements, shape (k, 4); both are changed.
        volumes: of the elements, shape (k,).
        whole: nodes all of whose elements are at hand, shape (j,).

    Returns:
        The node of which each further node, from j on, is a copy.
    """
    count = len(whole)
    concerned = np.zeros(count, np.bool_)
    for face in faces:
        other = across[face // 4, face % 4]
        across[face // 4, face % 4] = across[other // 4, other % 4] = -1
        for i in range(3):
            concerned[corners[face // 4, FACE_NODES[face % 4, i]]] = True
    first, following = list_corners(corners, count)
    part = np.full(4 * len(corners), -1, np.int64)
    copies = [np.int64(0) for _ in range(0)]
    for node in range(count):
        if not (concerned[node] and whole[node]):
            continue
        sizes = [0.0 for _ in range(0)]
        start = first[node]
        while start >= 0:
            if part[start] < 0:
                sizes.append(_flood(start, len(sizes), node, across, corners, volumes, part))
            start = following[start]
        order = np.argsort(-np.array(sizes), kind='mergesort')
        number = np.empty(len(order), np.int64)
        for k in range(len(order)):
            number[order[k]] = node if k == 0 else count + len(copies)
            if k > 0:
                copies.append(np.int64(node))
        corner = first[node]
        while corner >= 0:
            corners[corner // 4, corner % 4] = number[part[corner]]
            corner = following[corner]
    return np.array(copies, np.int64)


@inner
def _flood(start, number, node, across, corners, volumes, part):
    """Number the corners at a node that faces with the node connect with one; return the volume
    of their elements [m^3].
    """
    queue = [start]
    part[start] = number
    volume = 0.0
    while len(queue) > 0:
        corner = queue.pop()
        element = corner // 4
        volume += volumes[element]
        for face in range(4):
            other = across[element, face] // 4
            if face == corner % 4 or other < 0:
                continue
            for i in range(4):
                if corners[other, i] == node and part[4 * other + i] < 0:
                    part[4 * other + i] = number
                    queue.append(4 * other + i)
    return volume


@kernel
def _whole(nodes, corners, number, links, removed):
    """Return which nodes have all their elements at hand, shape (j,)."""
    missing = np.zeros(len(nodes), np.int64)
    for e in range(len(corners)):
        if number[e] >= 0:
            for i in range(4):
                missing[corners[e, i]] -= 1
    gone = {np.int64(-1)}
    for tet in removed:
        gone.add(np.int64(tet))
    for k in range(len(nodes)):
        if nodes[k] < len(links.first_corner):
            corner = links.first_corner[nodes[k]]
            while corner >= 0:
                missing[k] += np.int64(corner // 4) not in gone
                corner = links.corner_next[corner]
    return missing == 0


@kernel
def _volumes(rest, corners):
    """Return six times the volumes of some elements [m^3], shape (k,)."""
    volumes = np.empty(len(corners))
    for k in range(len(corners)):
        a, b, c, d = corners[k]
        volumes[k] = orientation(rest[a], rest[b], rest[c], rest[d])
    return volumes


def open_faces(
    mesh: TetMesh, delta: TopologyDelta, local: Local, faces: Ints
) -> tuple[TopologyDelta, float]:
    """Open faces, and give a node to each part of the elements around a node that they part."""
    corners = local.corners.copy()
    volumes = _volumes(local.rest, local.corners)
    removed = np.ascontiguousarray(delta.removed_tetrahedra)
    whole = _whole(local.nodes, local.corners, local.number, mesh.links, removed)
    copies = _split(faces, local.across.copy(), corners, volumes, whole)
    if not len(copies):
        return delta, 0.0
    own = corners[faces[:, None] // 4, FACE_NODES[faces % 4]]
    its = corners[local.across.ravel()[faces] // 4]
    opened = faces[~(own[:, :, None] == its[:, None]).any(axis=2).all(axis=1)]
    area = area_of(local.rest[local.corners[opened[:, None] // 4, FACE_NODES[opened % 4]]])
    first = mesh.node_count + len(delta.node_parents)
    numbers = np.concatenate([local.nodes, np.arange(first, first + len(copies))])
    changed = (corners != local.corners).any(axis=1)
    delta = _with_copies(
        mesh, delta, local.number[changed], numbers[corners[changed]], local.nodes[copies]
    )
    return delta, area


def _with_copies(
    mesh: TetMesh, delta: TopologyDelta, number: Ints, corners: Ints, copies: Ints
) -> TopologyDelta:
    """Return a batch with further copies of nodes.

    Args:
        mesh: before the batch.
        delta: the batch.
        number: of the elements that use them, see `Local`, shape (k,).
        corners: of these elements, shape (k, 4).
        copies: the originals, shape (c,).
    """
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
    old = number >= 0
    tetrahedra = delta.tetrahedra.copy()
    tetrahedra[-1 - number[~old]] = corners[~old]
    stayed = number[old]
    return replace(
        delta,
        node_parents=np.concatenate([delta.node_parents, parents]),
        node_weights=np.concatenate([delta.node_weights, weights]),
        removed_tetrahedra=np.sort(np.concatenate([delta.removed_tetrahedra, stayed]))[::-1],
        tetrahedra=np.concatenate([tetrahedra, corners[old]]),
        outer_faces=np.concatenate([delta.outer_faces, outer_bits_of(mesh.links, stayed)]),
        regions=np.concatenate([delta.regions, mesh.regions_at(stayed)]),
    )
