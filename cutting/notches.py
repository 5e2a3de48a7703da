"""Notches: the last elements that a stroke has swept in part, opened at its end.

Where the blade's tip ends within an element, it may cross none of its edges. The edge behind which
the cut would end is then divided where the swept surface, continued, meets it: the faces from there
to the cut lie on the surface and are opened. The front slides back to the path of the tip after it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.cutting.geometry import altitude
from cutting_trainer.cutting.lookup import DONE, NODES, SNAPPED, Tables, edge_key
from cutting_trainer.cutting.parting import (
    Floats,
    Ints,
    Local,
    list_corners,
    local_elements,
    match_faces,
    open_faces,
    whole_nodes,
)
from cutting_trainer.cutting.state_table import outer_bits_of
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

_REGION = 1.6
"""Distance from the border of the swept surface up to which tissue is looked at, in edges."""
_MIN_SINE = 0.05
"""Smallest sine between the blade and its way in a step that sweeps an area."""
_MIN_SHARE = 0.2
"""Share of a face that the blade must have swept for it to be opened."""
_MIN_DIVISION = 0.15
"""Least share of an edge on either side of a new node."""
_OFF = 0.2
"""Largest difference of heights above the surface within a face on it, in edges."""
_WITHIN = 0.9
"""Distance within the border from which on tissue is no notch, in edges."""
_SHEET = 2.5
"""Way of the tip between nodes of an element from which on they are of two sheets, in edges."""
_ROUNDS = 3
_SAMPLES = 6


class _Divided(NamedTuple):
    """Elements after some edges were divided.

    Attributes:
        corners: of all, the further ones last, shape (k, 4).
        outer: bits of their faces on the original surface, shape (k,).
        parents: of each further one, the element whose part it is, shape (f,).
        ends: nodes of the edge on which each new node lies, shape (c, 2).
        shares: where it lies between them, shape (c,).
    """

    corners: Ints
    outer: NDArray[np.uint8]
    parents: Ints
    ends: Ints
    shares: Floats


def open_notches(
    mesh: TetMesh,
    delta: TopologyDelta,
    tables: Tables,
    first_new: int,
    lines: Floats,
    h: float,
    small: float,
) -> tuple[TopologyDelta, float]:
    """Open the elements at the border of a swept surface that the blade has swept in part.

    Args:
        mesh: before the last batch of the stroke.
        delta: that batch.
        tables: of the stroke.
        first_new: number of the first node that the stroke has made.
        lines: the blade's edge along the stroke, root and tip, in the rest shape [m], shape
            (k, 2, 3).
        h: length of an edge [m].
        small: altitude below which no element is made [m].

    Returns:
        The batch with the notches, and the further area [m^2].
    """
    nodes = tables.node_id[: tables.counts[NODES]]
    frames = _frames(lines)
    if not len(frames) or not len(nodes):
        return delta, 0.0
    near = np.isfinite(_place(frames, mesh.rest[nodes], _REGION * h)[:, 0])
    if not near.any():
        return delta, 0.0
    local = local_elements(mesh, delta, np.sort(nodes[near]), lines[0], np.inf, 2)
    at = _place(frames, local.rest, _REGION * h)
    removed = np.ascontiguousarray(delta.removed_tetrahedra)
    whole = whole_nodes(local.nodes, local.corners, local.number, mesh.links, removed)
    on = _on_surface(local.nodes, tables, first_new)
    outer = _outer_bits(mesh, delta, local.number)
    divided, at, on, whole = _divide(
        local.corners, local.across, outer, local.rest, at, on, whole, h, small
    )
    delta, local = _with_divided(mesh, delta, local, divided)
    faces = _swept_faces(local.corners, local.across, at, on & whole, h)
    if not len(faces):
        return delta, 0.0
    return open_faces(mesh, delta, local, faces)


def _on_surface(nodes: Ints, tables: Tables, first_new: int) -> NDArray[np.bool_]:
    """Return which nodes lie on the surface of a stroke, shape (j,)."""
    on = nodes >= first_new
    rows = tables.node_row[nodes[~on]]
    snapped = (tables.node_side[rows] == SNAPPED) & (tables.node_state[rows] == DONE)
    on[~on] = (rows >= 0) & snapped
    return on


def _outer_bits(mesh: TetMesh, delta: TopologyDelta, number: Ints) -> NDArray[np.uint8]:
    """Return bits of the faces of elements on the original surface, by their numbers in `Local`."""
    bits = np.empty(len(number), np.uint8)
    old = number >= 0
    bits[old] = outer_bits_of(mesh.links, number[old])
    bits[~old] = delta.outer_faces[-1 - number[~old]]
    return bits


def _frames(lines: Floats) -> Floats:
    """Return the steps of a stroke that sweep an area, shape (k, 5, 3).

    They are where the tip begins, its way, the blade from root to tip, and the unit normal of the
    surface; then the length of the way before and of this one.
    """
    begin, ways = lines[:-1, 1], np.diff(lines[:, 1], axis=0)
    edges = lines[:, 1] - lines[:, 0]
    edges = (edges[1:] + edges[:-1]) / 2
    normals = np.cross(ways, edges)
    sizes = np.linalg.norm(normals, axis=1)
    least = np.linalg.norm(ways, axis=1) * np.linalg.norm(edges, axis=1)
    keep = sizes > np.maximum(_MIN_SINE * least, 1e-300)
    normals = normals[keep] / sizes[keep, None]
    # A blade that turns back goes on with the same side.
    turns = np.where((normals[1:] * normals[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    normals[1:] *= np.cumprod(turns)[:, None]
    lengths = np.linalg.norm(ways, axis=1)
    marks = np.stack([np.cumsum(lengths) - lengths, lengths, 0.0 * lengths], axis=1)
    return np.stack([begin[keep], ways[keep], edges[keep], normals, marks[keep]], axis=1)


@kernel
def _place(frames, places, region):
    """Return where places lie by a swept surface.

    Args:
        frames: as from `_frames`, shape (k, 5, 3).
        places: [m], shape (n, 3).
        region: largest distance from the surface and from its border [m].

    Returns:
        Height above the surface, distance beyond its border, negative within, and way of the tip up
        to there [m]; NaN farther away; shape (n, 3).
    """
    found = np.full((len(places), 3), np.nan)
    count = len(frames)
    for k in range(len(places)):
        best = np.inf
        for j in range(count):
            begin, way, edge, normal, marks = frames[j]
            x, y, z = places[k, 0] - begin[0], places[k, 1] - begin[1], places[k, 2] - begin[2]
            height = x * normal[0] + y * normal[1] + z * normal[2]
            if abs(height) > region or height * height >= best:
                continue
            by_way = x * way[0] + y * way[1] + z * way[2]
            by_edge = x * edge[0] + y * edge[1] + z * edge[2]
            square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
            length = edge[0] * edge[0] + edge[1] * edge[1] + edge[2] * edge[2]
            both = way[0] * edge[0] + way[1] * edge[1] + way[2] * edge[2]
            size = square * length - both * both
            along = (by_way * length - both * by_edge) / size
            deeper = (by_edge * square - both * by_way) / size
            across, length = np.sqrt(size / length), np.sqrt(length)
            beyond = max(deeper, -1.0 - deeper) * length
            before, after = -along * across, (along - 1.0) * across
            aside = max(before, after, 0.0)
            off = height * height
            if (j == 0 and before > 0.0) or (j == count - 1 and after > 0.0):
                beyond = max(beyond, aside)
            else:
                off += aside * aside
            if abs(beyond) <= region and off < best and off <= region * region:
                best = off
                found[k, 0], found[k, 1] = height, beyond
                found[k, 2] = marks[0] + min(max(along, 0.0), 1.0) * marks[1]
    return found


@inner
def _is_notch(a, b, c, h):
    """Return whether enough of a triangle lies within the border, but not all of it far within.

    Args:
        a, b, c: distances of its corners beyond the border [m].
        h: length of an edge [m].
    """
    within = total = 0
    for i in range(_SAMPLES):
        for j in range(_SAMPLES - i):
            p, q = (i + 1 / 3) / _SAMPLES, (j + 1 / 3) / _SAMPLES
            within += (1.0 - p - q) * a + p * b + q * c < 0.0
            total += 1
    return within >= _MIN_SHARE * total and max(a, b, c) > -_WITHIN * h


@inner
def _is_torn(corners, at, h):
    """Return whether some nodes are far away, or by different sheets of the surface."""
    low, high = np.inf, -np.inf
    for node in corners:
        if np.isnan(at[node, 0]):
            return True
        low, high = min(low, at[node, 2]), max(high, at[node, 2])
    return high - low > _SHEET * h


@inner
def _ring(corners, first, following, a, b):
    """Return the elements around the edge a b."""
    found = [np.int64(0) for _ in range(0)]
    corner = first[a]
    while corner >= 0:
        e = corner // 4
        for i in range(4):
            if corners[e, i] == b:
                found.append(np.int64(e))
        corner = following[corner]
    return found


@inner
def _stays_sound(corners, rest, ring, a, b, x, small):
    """Return whether no element around the edge a b gets flatter than `small` [m] when it is
    divided at x.
    """
    place = np.empty((4, 3))
    for e in ring:
        for end in (a, b):
            for i in range(4):
                node = corners[e, i]
                place[i] = x if node == end else rest[node]
            if altitude(place[0], place[1], place[2], place[3]) < small:
                return False
    return True


@inner
def _wanted(corners, at, on, e, h):
    """Return the two ends of an edge to be divided in an element and where, or -1.

    One or two nodes are on the surface, and the surface, continued, passes between the others.
    """
    nothing = (np.int64(-1), np.int64(-1), 0.0)
    held, above, below = np.empty(4, np.int64), np.empty(4, np.int64), np.empty(4, np.int64)
    count = over = under = 0
    middle = 0.0
    for i in range(4):
        node = corners[e, i]
        if on[node]:
            held[count] = node
            middle += at[node, 0]
            count += 1
    if count == 0 or count > 2 or _is_torn(corners[e], at, h):
        return nothing
    middle /= count
    for i in range(4):
        node = corners[e, i]
        if on[node]:
            if abs(at[node, 0] - middle) > 0.5 * _OFF * h:
                return nothing
        elif at[node, 0] > middle:
            above[over] = node
            over += 1
        else:
            below[under] = node
            under += 1
    if over == 0 or under == 0:
        return nothing
    # The first edge between the sides, and the second one, if there are two.
    a, b = above[0], below[0]
    share, beyond = _crossing(at, a, b, middle)
    if count == 2:
        last = at[held[1], 1]
    else:
        _, last = _crossing(at, above[over - 1], below[under - 1], middle)
    if not _is_notch(at[held[0], 1], last, beyond, h):
        return nothing
    return a, b, share


@inner
def _crossing(at, a, b, middle):
    """Return the share of the way from a to b where it is as high as `middle`, away from the ends,
    and the distance beyond the border there.
    """
    one, two = at[a, 0] - middle, at[b, 0] - middle
    share = min(max(one / (one - two), _MIN_DIVISION), 1.0 - _MIN_DIVISION)
    return share, (1.0 - share) * at[a, 1] + share * at[b, 1]


@kernel
def _divide(corners, across, outer, rest, at, on, whole, h, small):
    """Divide the edges behind which a cut would end.

    Args:
        corners: of the elements, shape (k, 4).
        across: face behind each face, or -1, shape (k, 4).
        outer: bits of the faces on the original surface, shape (k,).
        rest: of the nodes [m], shape (j, 3).
        at: see `_place`, shape (j, 3).
        on: nodes on the surface, shape (j,).
        whole: nodes all of whose elements are at hand, shape (j,).
        h: length of an edge [m].
        small: altitude below which no element is made [m].

    Returns:
        The elements; then `at`, `on` and `whole` with the new nodes.
    """
    k, j = len(corners), len(rest)
    room = 4 * k + 64
    out, parents = np.empty((room, 4), np.int64), np.empty(room, np.int64)
    bits = np.zeros(room, np.uint8)
    out[:k], bits[:k] = corners, outer
    places, where = np.empty((j + k, 3)), np.empty((j + k, 3))
    flags, complete = np.ones(j + k, np.bool_), np.ones(j + k, np.bool_)
    places[:j], where[:j], flags[:j], complete[:j] = rest, at, on, whole
    kept = _edges_of_cuts(corners, across, outer)
    first = np.full(j + k, -1, np.int64)
    following = np.full(4 * room, -1, np.int64)
    heads, links = list_corners(corners, j)
    first[:j], following[: 4 * k] = heads, links
    ends, shares = np.empty((k, 2), np.int64), np.empty(k)
    count, nodes = k, j
    x = np.empty(3)
    for _ in range(_ROUNDS):
        last = count
        for e in range(last):
            a, b, share = _wanted(out, where, flags, e, h)
            if a < 0 or not (whole[a] or whole[b]) or edge_key(a, b) in kept:
                continue
            ring = _ring(out, first, following, a, b)
            for i in range(3):
                x[i] = (1.0 - share) * places[a, i] + share * places[b, i]
            if nodes == len(places) or count + len(ring) > room:
                continue
            if not _stays_sound(out, places, ring, a, b, x, small):
                continue
            places[nodes] = x
            for i in range(3):
                where[nodes, i] = (1.0 - share) * at[a, i] + share * at[b, i]
            ends[nodes - j, 0], ends[nodes - j, 1], shares[nodes - j] = a, b, share
            for one in ring:
                parents[count] = one if one < k else parents[one]
                bits[count] = bits[one]
                for i in range(4):
                    node = out[one, i]
                    out[count, i] = nodes if node == a else node
                    # The face between both parts is new: opposite to b in one, to a in the other.
                    if node == a:
                        bits[one] &= ~np.uint8(1 << i)
                    elif node == b:
                        bits[count] &= ~np.uint8(1 << i)
                        _unlist(first, following, b, 4 * one + i)
                        out[one, i] = nodes
                        following[4 * one + i] = first[nodes]
                        first[nodes] = 4 * one + i
                for i in range(4):
                    node = out[count, i]
                    following[4 * count + i] = first[node]
                    first[node] = 4 * count + i
                count += 1
            nodes += 1
        if count == last:
            break
    made = nodes - j
    return (
        _Divided(out[:count], bits[:count], parents[k:count], ends[:made], shares[:made]),
        where[:nodes],
        flags[:nodes],
        complete[:nodes],
    )


@inner
def _edges_of_cuts(corners, across, outer):
    """Return the keys of edges in faces that a cut has opened: both sides keep the same nodes."""
    found = {np.int64(-1)}
    for e in range(len(corners)):
        for f in range(4):
            if across[e, f] < 0 and not outer[e] >> f & 1:
                for i in range(3):
                    a, b = FACE_NODES[f, i], FACE_NODES[f, (i + 1) % 3]
                    found.add(np.int64(edge_key(corners[e, a], corners[e, b])))
    return found


@inner
def _unlist(first, following, node, corner):
    """Take a corner out of the list of those at a node."""
    if first[node] == corner:
        first[node] = following[corner]
        return
    before = first[node]
    while following[before] != corner:
        before = following[before]
    following[before] = following[corner]


@kernel
def _swept_faces(corners, across, at, on, h):
    """Return the closed faces on a surface that the blade has swept, 4 e + f, shape (f,).

    Args:
        corners: of the elements, shape (k, 4).
        across: face behind each face, or -1, shape (k, 4).
        at: see `_divide`.
        on: nodes on the surface all of whose elements are at hand, shape (j,).
        h: length of an edge [m].
    """
    found = [np.int64(0) for _ in range(0)]
    for e in range(len(corners)):
        for f in range(4):
            behind = across[e, f]
            if behind < 4 * e + f:
                continue
            a, b = corners[e, FACE_NODES[f, 0]], corners[e, FACE_NODES[f, 1]]
            c, one = corners[e, FACE_NODES[f, 2]], corners[e, f]
            two = corners[behind // 4, behind % 4]
            if not (on[a] and on[b] and on[c]):
                continue
            if _is_torn(corners[e], at, h) or _is_torn(corners[behind // 4], at, h):
                continue
            p, q, r = at[a, 0], at[b, 0], at[c, 0]
            if max(p, q, r) - min(p, q, r) > _OFF * h:
                continue
            middle = (p + q + r) / 3
            if (at[one, 0] - middle) * (at[two, 0] - middle) < 0.0 and _is_notch(
                at[a, 1], at[b, 1], at[c, 1], h
            ):
                found.append(np.int64(4 * e + f))
    return np.array(found, np.int64)


def _with_divided(
    mesh: TetMesh, delta: TopologyDelta, local: Local, divided: _Divided
) -> tuple[TopologyDelta, Local]:
    """Return a batch with divided elements, and the elements near as they are after it.

    Args:
        mesh: before the batch.
        delta: the batch.
        local: the elements before they were divided.
        divided: the elements.
    """
    corners, bits, parents, ends, shares = divided
    if not len(ends):
        return delta, local
    count, first = len(local.corners), mesh.node_count + len(delta.node_parents)
    nodes = np.concatenate([local.nodes, first + np.arange(len(ends))])
    a, b = local.rest[ends[:, 0]], local.rest[ends[:, 1]]
    rest = np.concatenate([local.rest, a + shares[:, None] * (b - a)])
    weights = np.zeros((len(ends), 4))
    weights[:, 0], weights[:, 1] = 1.0 - shares, shares
    changed = np.flatnonzero((corners[:count] != local.corners).any(axis=1))
    old = local.number[changed] >= 0
    stayed, slots = local.number[changed[old]], -1 - local.number[changed[~old]]
    tetrahedra, outer = delta.tetrahedra.copy(), delta.outer_faces.copy()
    tetrahedra[slots], outer[slots] = nodes[corners[changed[~old]]], bits[changed[~old]]
    further = np.concatenate([changed[old], np.arange(count, len(corners))])
    number = np.concatenate([local.number, np.zeros(len(parents), np.int64)])
    sources = number[np.concatenate([changed[old], parents])]
    number[further] = -1 - len(tetrahedra) - np.arange(len(further))
    regions = delta.regions
    if len(mesh.regions):
        own = np.where(sources >= 0, mesh.regions[sources], 0)
        own[sources < 0] = regions[-1 - sources[sources < 0]]
        regions = np.concatenate([regions, own])
    delta = replace(
        delta,
        node_parents=np.concatenate([delta.node_parents, local.nodes[ends[:, [0, 1, 0, 0]]]]),
        node_weights=np.concatenate([delta.node_weights, weights]),
        removed_tetrahedra=np.sort(np.concatenate([delta.removed_tetrahedra, stayed]))[::-1],
        tetrahedra=np.concatenate([tetrahedra, nodes[corners[further]]]),
        outer_faces=np.concatenate([outer, bits[further]]),
        regions=regions,
    )
    return delta, Local(nodes, rest, corners, number, match_faces(corners, len(nodes)))
