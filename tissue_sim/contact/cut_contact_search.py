"""Search for cut faces that are near: nodes of cut faces, and the triangles that they meet.

A node meets the nearest triangle of a cut face whose normal is opposed to its own and on which it
has a foot. Triangles are looked through along one axis.

Two kinds of contact would keep an element inside out, so they are left out. The normals of an
element that is inside out are turned over: its triangle and its nodes meet nothing. A node that is
behind a triangle at rest, and close to it in the same tissue, is in front of it only where tissue
between them is inside out: the two do not meet.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.topology import CUT

REACH = 5e-4
"""[m] Distance up to which faces are near; more where they are fast."""
_SAME = 1e-6
"""[m] Distance up to which triangles are equally near. In a cut that has just opened, a node lies
on all triangles around its twin, and rounding would choose among them."""
_DEPTH = 0.3
"""Depth at which a node is still taken to be in front of a triangle, by the triangle's size."""
_ONE_SIDED = 0.3
"""Smallest length of the mean of the normals around a node that is on one side."""
_OPPOSED = -0.3
"""Largest cosine between the normals of a node and a triangle that meet."""
_CREASE = 0.7
"""Smallest cosine of the angle between triangles that make a smooth surface."""
_FLAT, _BENT = 0.998, 0.985
"""Cosines between the normals of a triangle and of its node: from 4 degrees on the surface is
smooth in part, from 10 degrees on in full. Smooth flat faces would flutter: their normal is not
quite that of the gap."""
_BEHIND = -0.02
"""Cosine, at rest, between the normal of a triangle and the way to a node, below which the node is
behind it. The faces of a cut are in one another at rest, but for rounding and curvature."""
_BESIDE = 0.05
"""Share of a triangle by which a node may be beside it."""


class NearFaces(NamedTuple):
    """Nodes of cut faces and the triangles that they meet, until the next search.

    Attributes:
        nodes: the node, and those of the triangle, shape (c, 4).
        rest: their rest positions [m], shape (c, 4, 3).
        smooth: unit normals of the smooth surface at the triangle's nodes, in terms of its first
            edges and its normal, shape (c, 3, 3).
    """

    nodes: np.ndarray
    rest: np.ndarray
    smooth: np.ndarray

    def among(self, move: np.ndarray) -> 'NearFaces':
        """Return those all of whose nodes move or are fixed; `move` has shape (c, 4)."""
        some = move.all(axis=1)
        return self if some.all() else NearFaces(*(values[some] for values in self))


NO_NEAR_FACES = NearFaces(np.zeros((0, 4), np.int64), np.zeros((0, 4, 3)), np.zeros((0, 3, 3)))


@inner
def foot(ax, ay, az, bx, by, bz, x, y, z):
    """Return the weights of the second and third corner at the foot of a place on a triangle.

    Args:
        ax, ay, az, bx, by, bz, x, y, z: from the first corner to the second, the third and the
            place [m].
    """
    a, b = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz
    c = bx * bx + by * by + bz * bz
    d, e = x * ax + y * ay + z * az, x * bx + y * by + z * bz
    below = max(a * c - b * b, 1e-300)
    return (c * d - b * e) / below, (a * e - b * d) / below


@kernel(error_model='numpy')
def find_contacts(links, rest, u, v, seconds):
    """Return the contacts near, and the largest speed of a node of a cut face [m/s].

    Args:
        links: see `topology.Links`.
        rest, u: rest positions and displacement [m], shape (n, 3).
        v: velocity [m/s], shape (n, 3).
        seconds: until the next search, at least.
    """
    triangles = links.triangles
    cut = np.flatnonzero(links.triangle_kind[: links.counts[1]] == CUT)
    count = len(cut)
    number, listed = np.full(len(rest), -1), np.empty(3 * count, np.int64)
    corners, normals, middles = np.empty((count, 9)), np.empty((count, 3)), np.empty((count, 3))
    sizes, radii, own = np.empty(count), np.empty(count), np.zeros((3 * count, 4))
    nodes, fastest, widest = 0, 0.0, 0.0
    for k in range(count):
        for a in range(3):
            node = triangles[cut[k], a]
            for i in range(3):
                corners[k, 3 * a + i] = rest[node, i] + u[node, i]
            if number[node] < 0:
                number[node], listed[nodes], nodes = nodes, node, nodes + 1
                fastest = max(fastest, v[node, 0] ** 2 + v[node, 1] ** 2 + v[node, 2] ** 2)
        ax, ay, az, bx, by, bz = _edges(corners, k)
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        size = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
        sizes[k] = np.sqrt(size)
        far = _opposite(links, cut[k])
        x = rest[far, 0] + u[far, 0] - corners[k, 0]
        y = rest[far, 1] + u[far, 1] - corners[k, 1]
        z = rest[far, 2] + u[far, 2] - corners[k, 2]
        turned = x * nx + y * ny + z * nz > 0.0
        if turned:
            nx = ny = nz = 0.0
        normals[k, 0], normals[k, 1], normals[k, 2] = nx / size, ny / size, nz / size
        for a in range(3):
            at = number[triangles[cut[k], a]]
            own[at, 0] += nx
            own[at, 1] += ny
            own[at, 2] += nz
            own[at, 3] += np.inf if turned else size
        radii[k] = 0.0
        for i in range(3):
            middles[k, i] = (corners[k, i] + corners[k, 3 + i] + corners[k, 6 + i]) / 3.0
        for a in range(3):
            square = 0.0
            for i in range(3):
                square += (corners[k, 3 * a + i] - middles[k, i]) ** 2
            radii[k] = max(radii[k], square)
        radii[k] = np.sqrt(radii[k])
        widest = max(widest, radii[k])
    fastest = np.sqrt(fastest)
    reach = max(REACH, 2.0 * fastest * seconds)
    axis, extent = 0, -1.0
    for i in range(3):
        length = middles[:, i].max() - middles[:, i].min()
        if length > extent:
            axis, extent = i, length
    order = np.argsort(middles[:, axis], kind='mergesort')
    keys = middles[order, axis]
    stars, smooth = _stars(triangles, cut, number, nodes), np.empty((nodes, 3, 3))
    found, shapes, contacts = np.empty((nodes, 4), np.int64), np.empty((nodes, 4, 3)), 0
    for j in range(nodes):
        node, place = listed[j], rest[listed[j], axis] + u[listed[j], axis]
        x, y, z = rest[node, 0] + u[node, 0], rest[node, 1] + u[node, 1], rest[node, 2] + u[node, 2]
        nx, ny, nz = own[j, 0], own[j, 1], own[j, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < _ONE_SIDED * own[j, 3]:
            continue  # at the front, where it is on both sides; or of an element inside out
        nearest, best = np.inf, -1
        for s in range(np.searchsorted(keys, place - widest - reach), count):
            if keys[s] > place + widest + reach:
                break
            k = order[s]
            px, py, pz = x - middles[k, 0], y - middles[k, 1], z - middles[k, 2]
            if px * px + py * py + pz * pz > (radii[k] + reach) ** 2:
                continue
            cosine = nx * normals[k, 0] + ny * normals[k, 1] + nz * normals[k, 2]
            gap = px * normals[k, 0] + py * normals[k, 1] + pz * normals[k, 2]
            distance = max(abs(gap), _SAME)
            if cosine > _OPPOSED * length or gap > reach or distance > nearest:
                continue
            if distance == nearest and k > best:
                continue
            if gap < -_DEPTH * sizes[k] or _opposite(links, cut[k]) == node:
                continue
            px, py, pz = x - corners[k, 0], y - corners[k, 1], z - corners[k, 2]
            b, c = foot(*_edges(corners, k), px, py, pz)
            beside = min(min(b, c), 1.0 - b - c) < -_BESIDE
            if not (beside or _through_tissue(links, rest, cut[k], node)):
                nearest, best = distance, k
        if best < 0:
            continue
        found[contacts, 0] = node
        for a in range(3):
            found[contacts, a + 1] = triangles[cut[best], a]
            _smooth(best, corners, normals, sizes, number[found[contacts, a + 1]], stars, smooth,
                    contacts, a)  # fmt: skip
        for a in range(4):
            for i in range(3):
                shapes[contacts, a, i] = rest[found[contacts, a], i]
        contacts += 1
    some = found[:contacts].copy(), shapes[:contacts].copy(), smooth[:contacts].copy()
    return NearFaces(*some), fastest


@inner
def _opposite(links, t):
    """Return the node of a triangle's element that is not on the triangle."""
    face = links.triangle_face[t]
    return links.tetrahedra[face // 4, face % 4]


@inner
def _through_tissue(links, rest, t, node):
    """Return whether a node is behind a triangle at rest, and close to it in the same tissue.

    Close: one element, or two with a common face, join the node with a node of the triangle.
    """
    a, b, c = links.triangles[t, 0], links.triangles[t, 1], links.triangles[t, 2]
    ax, ay, az = rest[b, 0] - rest[a, 0], rest[b, 1] - rest[a, 1], rest[b, 2] - rest[a, 2]
    bx, by, bz = rest[c, 0] - rest[a, 0], rest[c, 1] - rest[a, 1], rest[c, 2] - rest[a, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    x = rest[node, 0] - rest[a, 0] - (ax + bx) / 3.0
    y = rest[node, 1] - rest[a, 1] - (ay + by) / 3.0
    z = rest[node, 2] - rest[a, 2] - (az + bz) / 3.0
    size = np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + z * z))
    if x * nx + y * ny + z * nz >= _BEHIND * size:
        return False
    corner = links.first_corner[node]
    while corner >= 0:
        face = links.neighbors[corner // 4, corner % 4]
        beyond = links.tetrahedra[face // 4, face % 4] if face >= 0 else -1
        if beyond == a or beyond == b or beyond == c:
            return True
        for i in range(4):
            other = links.tetrahedra[corner // 4, i]
            if other == a or other == b or other == c:
                return True
        corner = links.corner_next[corner]
    return False


@inner
def _edges(corners, k):
    """Return the edges of a triangle from its first corner [m]."""
    x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
    ax, ay, az = corners[k, 3] - x, corners[k, 4] - y, corners[k, 5] - z
    return ax, ay, az, corners[k, 6] - x, corners[k, 7] - y, corners[k, 8] - z


@inner
def _stars(triangles, cut, number, nodes):
    """Return where the triangles of each node begin in a list, and the list."""
    starts = np.zeros(nodes + 1, np.int64)
    for k in range(len(cut)):
        for a in range(3):
            starts[number[triangles[cut[k], a]] + 1] += 1
    for j in range(nodes):
        starts[j + 1] += starts[j]
    filled, listed = starts.copy(), np.empty(3 * len(cut), np.int64)
    for k in range(len(cut)):
        for a in range(3):
            j = number[triangles[cut[k], a]]
            listed[filled[j]] = k
            filled[j] += 1
    return starts, listed


@inner
def _smooth(k, corners, normals, sizes, node, stars, out, c, a):
    """Write `NearFaces.smooth` of contact c at corner a of triangle k, node in the stars."""
    starts, listed = stars
    x = y = z = 0.0
    for s in range(starts[node], starts[node + 1]):
        other = listed[s]
        cosine = normals[other, 0] * normals[k, 0] + normals[other, 1] * normals[k, 1]
        if cosine + normals[other, 2] * normals[k, 2] > _CREASE:
            area = sizes[other] * sizes[other]
            x, y = x + area * normals[other, 0], y + area * normals[other, 1]
            z += area * normals[other, 2]
    size = max(np.sqrt(x * x + y * y + z * z), 1e-300)
    x, y, z = x / size, y / size, z / size
    cosine = x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2]
    part = min(max((_FLAT - cosine) / (_FLAT - _BENT), 0.0), 1.0)
    x = part * x + (1.0 - part) * normals[k, 0]
    y = part * y + (1.0 - part) * normals[k, 1]
    z = part * z + (1.0 - part) * normals[k, 2]
    out[c, a, 0], out[c, a, 1] = foot(*_edges(corners, k), x, y, z)
    out[c, a, 2] = x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2]
