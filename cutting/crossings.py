"""Edges and nodes crossed by a sweep, in the deformed tissue (thesis 5.4.3; docs/cutting.md)."""

import math

import numpy as np

from cutting_trainer.cutting.geometry import EDGE_NODES, height, orientation
from cutting_trainer.cutting.lookup import base_of, edge_key, edge_slot, is_on_cut
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import area_vector, norm
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

_EXACT = 1e-6
"""Distance from the swept surface, as a share of an edge, below which a node is on it."""
_MIN_NORMAL = 1e-14
HAIR = 2e-5
"""Overlap of a sweep with the previous one [m]: tissue moves in between."""


def lengthened(corners: np.ndarray, before: float, after: float, *, back: float) -> np.ndarray:
    """Return the corners of a sweep whose blade is longer at the tip.

    Args:
        corners: root before, tip before, tip after, root after [m], shape (4, 3).
        before, after: added to the blade before and after the step [m].
        back: added to the way, before its beginning [m].
    """
    longer = corners.copy()
    for root, tip, more in ((0, 1, before), (3, 2, after)):
        edge = corners[tip] - corners[root]
        longer[tip] += edge * (more / max(math.sqrt(edge @ edge), 1e-12))
    if back > 0.0:
        way = (corners[2] + corners[3] - corners[0] - corners[1]) / 2
        longer[:2] -= way * (back / max(math.sqrt(way @ way), 1e-12))
    return longer


def surfaces(corners: np.ndarray) -> np.ndarray:
    """Return the two triangles of a sweep, extended backwards by `HAIR`.

    Args:
        corners: root before, tip before, tip after, root after [m], shape (4, 3).

    Returns:
        Shape (2, 3, 3); one of them may be flat, if the blade rotates about an end.
    """
    a, b, c, d = corners
    back = []
    for start, end in ((a, d), (b, c)):
        length = np.linalg.norm(end - start)
        back.append(start - (end - start) * (HAIR / length) if length > HAIR / 100 else start)
    return np.array([[back[0], back[1], c], [back[0], c, d]])


@inner
def _normals(triangles):
    """Return unit normals of triangles (k, 3, 3), and twice their areas [m^2]."""
    normals = np.empty((len(triangles), 3))
    sizes = np.empty(len(triangles))
    for k in range(len(triangles)):
        area_vector(triangles[k, 0], triangles[k, 1], triangles[k, 2], normals[k])
        sizes[k] = norm(normals[k])
        for c in range(3):
            normals[k, c] /= max(sizes[k], _MIN_NORMAL)
    return normals, sizes


@inner
def _inside(triangle, n, x, slack):
    """Return whether a point of the triangle's plane is inside it, or within `slack` of its border
    [m].
    """
    for i in range(3):
        a, b = triangle[i], triangle[(i + 1) % 3]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        px, py, pz = x[0] - a[0], x[1] - a[1], x[2] - a[2]
        side = n[0] * (ey * pz - ez * py) + n[1] * (ez * px - ex * pz) + n[2] * (ex * py - ey * px)
        if side < -slack * np.sqrt(ex * ex + ey * ey + ez * ez):
            return False
    return True


@inner
def _near(triangle, n, slack, positions, corners):
    """Return whether a tetrahedron lies on both sides of the triangle's plane, within its bounding
    box.
    """
    above = below = False
    for k in range(4):
        node = corners[k]
        at = (
            n[0] * (positions[node, 0] - triangle[0, 0])
            + n[1] * (positions[node, 1] - triangle[0, 1])
            + n[2] * (positions[node, 2] - triangle[0, 2])
        )
        above |= at >= -slack
        below |= at <= slack
    if not (above and below):
        return False
    for i in range(3):
        a, b = positions[corners[0], i], positions[corners[1], i]
        c, d = positions[corners[2], i], positions[corners[3], i]
        if min(triangle[0, i], triangle[1, i], triangle[2, i]) > max(a, b, c, d) + slack:
            return False
        if max(triangle[0, i], triangle[1, i], triangle[2, i]) < min(a, b, c, d) - slack:
            return False
    return True


@inner
def _in_reach(triangles, normals, sizes, slack, positions, corners):
    """Return whether a sweep may cross a tetrahedron."""
    for k in range(len(triangles)):
        if sizes[k] > _MIN_NORMAL and _near(triangles[k], normals[k], slack, positions, corners):
            return True
    return False


@inner
def _box(triangles, slack):
    """Return the lower and upper corner of the bounding box of triangles [m], shape (2, 3)."""
    box = np.empty((2, 3))
    for c in range(3):
        low, high = np.inf, -np.inf
        for k in range(len(triangles)):
            for i in range(3):
                low, high = min(low, triangles[k, i, c]), max(high, triangles[k, i, c])
        box[0, c], box[1, c] = low - slack, high + slack
    return box


@inner
def _surface_seeds(triangles, slack, links, positions, seeds, seen, mark):
    """Add the tetrahedra under surface triangles whose box meets that of the sweep."""
    box = _box(triangles, slack)
    nodes, face = links.triangles, links.triangle_face
    for k in range(links.counts[1]):
        a, b, c = nodes[k, 0], nodes[k, 1], nodes[k, 2]
        apart = False
        for i in range(3):
            x, y, z = positions[a, i], positions[b, i], positions[c, i]
            if min(x, y, z) > box[1, i] or max(x, y, z) < box[0, i]:
                apart = True
                break
        tet = np.int64(face[k] // 4)
        if not apart and seen[tet] != mark:
            seen[tet] = mark
            seeds.append(tet)


@inner
def _all_seeds(triangles, slack, links, positions, seeds, seen, mark):
    """Add the tetrahedra whose box meets that of the sweep, by the sides of their nodes."""
    box = _box(triangles, slack)
    beyond = np.zeros(len(positions), np.uint8)
    for node in range(len(positions)):
        for i in range(3):
            if positions[node, i] < box[0, i]:
                beyond[node] |= np.uint8(1 << i)
            elif positions[node, i] > box[1, i]:
                beyond[node] |= np.uint8(8 << i)
    nodes = links.tetrahedra
    for tet in range(links.counts[0]):
        a, b, c, d = nodes[tet, 0], nodes[tet, 1], nodes[tet, 2], nodes[tet, 3]
        if beyond[a] & beyond[b] & beyond[c] & beyond[d] == 0:
            seen[tet] = mark
            seeds.append(np.int64(tet))


@inner
def _star_seeds(corner, corner_next, seeds, seen, mark):
    """Add the unmarked tetrahedra around a node, by the head of its list of corners."""
    while corner >= 0:
        tet = np.int64(corner // 4)
        if seen[tet] != mark:
            seen[tet] = mark
            seeds.append(tet)
        corner = corner_next[corner]


@kernel
def met_tetrahedra(triangles, links, positions, near_nodes, everywhere, seen, mark):
    """Return the tetrahedra that a sweep may cross: a superset.

    The search starts from the previous position of the blade and from the surface, and goes from
    neighbour to neighbour.

    Args:
        triangles: of the sweep [m], shape (2, 3, 3).
        links: connectivity.
        positions: current nodes [m], shape (n, 3).
        near_nodes: nodes at the previous position of the blade, shape (k,).
        everywhere: start from all tetrahedra.
        seen, mark: scratch, shape (>= m,), and a number that is nowhere in it.

    Returns:
        Shape (t,).
    """
    normals, sizes = _normals(triangles)
    slack, box = 0.0, _box(triangles, 0.0)
    for c in range(3):
        slack = max(slack, 1e-6 * (box[1, c] - box[0, c]))
    tetrahedra, first_corner, corner_next = links.tetrahedra, links.first_corner, links.corner_next
    queue = [np.int64(0) for _ in range(0)]
    if everywhere:
        _all_seeds(triangles, slack, links, positions, queue, seen, mark)
    else:
        _surface_seeds(triangles, slack, links, positions, queue, seen, mark)
        for node in near_nodes:
            _star_seeds(first_corner[node], corner_next, queue, seen, mark)
    met = [np.int64(0) for _ in range(0)]
    while len(queue) > 0:
        at = queue.pop()
        if not _in_reach(triangles, normals, sizes, slack, positions, tetrahedra[at]):
            continue
        met.append(at)
        for i in range(4):
            _star_seeds(first_corner[tetrahedra[at, i]], corner_next, queue, seen, mark)
    return np.array(met) if len(met) else np.zeros(0, np.int64)


@kernel
def find_hits(triangles, links, tables, positions, met):
    """Return the edges that cross the sweep, and the nodes on it; each edge is tested once.

    Edges already in the table, and edges of nodes on the cut, are left out.

    Args:
        triangles: of the sweep [m], shape (2, 3, 3).
        links, tables: mesh and stroke.
        positions: current nodes [m], shape (n, 3).
        met: tetrahedra to test, shape (t,).

    Returns:
        Nodes a, b, with b = -1 for a node on the surface, shape (k, 2); and by row the share of the
        way from
        a to b, the normal of the triangle, the crossing point [m], shape (k, 7).
    """
    nodes = np.empty((10 * len(met), 2), np.int64)
    data = np.empty((10 * len(met), 7))
    count = 0
    seen = {np.int64(-1)}
    base = np.empty(4, np.int64)
    x = np.empty(3)
    normals, sizes = _normals(triangles)
    extents = np.empty(2)
    for k in range(2):
        box = _box(triangles[k : k + 1], 0.0)
        extents[k] = max(box[1, 0], box[1, 1], box[1, 2]) - min(box[0, 0], box[0, 1], box[0, 2])
    tetrahedra, origin, owner = links.tetrahedra, tables.origin, tables.owner
    parent_nodes, hash_key = tables.parent_nodes, tables.hash_key
    row, side, state = tables.node_row, tables.node_side, tables.node_state
    above = np.empty((2, 4))
    for tet in met:
        base_of(tetrahedra, origin, owner, parent_nodes, tet, base)
        reach = 0.0
        for i in range(4):
            for axis in range(3):
                reach += abs(positions[base[i], axis] - positions[base[0], axis])
            for k in range(2):
                above[k, i] = height(normals[k], triangles[k, 0], positions[base[i]])
        for pair in range(10):
            i, j = (EDGE_NODES[pair, 0], EDGE_NODES[pair, 1]) if pair < 6 else (pair - 6, pair - 6)
            if pair < 6:
                apart = above[0, i] * above[0, j] >= 0.0 and above[1, i] * above[1, j] >= 0.0
            else:
                apart = min(abs(above[0, i]), abs(above[1, i])) > _EXACT * reach
            if apart:
                continue
            a, b = min(base[i], base[j]), max(base[i], base[j])
            key = edge_key(a, b)
            if key in seen:
                continue
            seen.add(key)
            if is_on_cut(row, side, state, a) or is_on_cut(row, side, state, b):
                continue
            if hash_key[edge_slot(hash_key, key)] != -1:
                continue
            for k in range(2):
                if sizes[k] <= _MIN_NORMAL:
                    continue
                share = _crossing(
                    triangles[k], normals[k], extents[k], positions, a, b, base[(i + 1) % 4], x
                )
                if share >= 0.0:
                    nodes[count, 0] = a
                    nodes[count, 1] = b if a != b else -1
                    data[count, 0] = share
                    for axis in range(3):
                        data[count, 1 + axis] = normals[k, axis]
                        data[count, 4 + axis] = x[axis]
                    count += 1
                    break
    return nodes[:count], data[:count]


@inner
def _crossing(triangle, n, extent, positions, a, b, near, x):
    """Return the share of the path from a to b where the edge crosses the triangle, else -1; a node
    has b = a.

    The tolerance for a node is a share of its edge to `near`.
    """
    p, q = positions[a], positions[b if b != a else near]
    slack = 1e-6 * extent
    above, below = height(n, triangle[0], p), height(n, triangle[0], q)
    length = np.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2)
    if a == b:
        x[0], x[1], x[2] = p[0], p[1], p[2]
        on_it = abs(above) <= _EXACT * length and _inside(triangle, n, x, slack)
        return 0.0 if on_it else -1.0
    if above * below >= 0.0 or min(abs(above), abs(below)) <= _EXACT * length:
        return -1.0
    share = above / (above - below)
    for i in range(3):
        x[i] = p[i] + share * (q[i] - p[i])
    return share if _inside(triangle, n, x, slack) else -1.0


@inner
def segment_within(p, q, positions, corners):
    """Return the ends of the part of the segment p q in a tetrahedron, as shares of it.

    The first is larger than the last if none of it is.

    Args:
        p, q: ends [m], shape (3,).
        positions: current nodes [m], shape (n, 3).
        corners: nodes of the tetrahedron, shape (4,).
    """
    low, high = 0.0, 1.0
    for face in range(4):
        a = positions[corners[FACE_NODES[face, 0]]]
        b = positions[corners[FACE_NODES[face, 1]]]
        c = positions[corners[FACE_NODES[face, 2]]]
        # Outside where the volume with the outward face is positive; clip the segment.
        s, e = orientation(a, b, c, p), orientation(a, b, c, q)
        if s > 0.0 and e > 0.0:
            return 1.0, 0.0
        if s > 0.0:
            low = max(low, s / (s - e))
        elif e > 0.0:
            high = min(high, s / (s - e))
    return low, high
