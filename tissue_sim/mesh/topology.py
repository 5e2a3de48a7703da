"""Incremental connectivity of a tetrahedral mesh, by compiled kernels on plain arrays.

A corner is one node of one tetrahedron, numbered 4 t + i; a face is numbered 4 t + i too, i being
the node opposite. Faces are listed outward counter-clockwise for positively oriented tetrahedra.
The cost of every kernel follows the change, not the size of the mesh.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel

OUTER = 0
CUT = 1
FACE_NODES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Local nodes of the face opposite each node, outward counter-clockwise."""


class Links(NamedTuple):
    """The arrays of connectivity, with spare room behind `counts`.

    Attributes:
        counts: [tetrahedra, triangles, log entries], shape (3,).
        tetrahedra: node indices, shape (m, 4).
        neighbors: face on the other side of each face, -1 at the boundary, shape (m, 4).
        face_triangle: surface triangle of each boundary face, else -1, shape (m, 4).
        corner_next, corner_prev: doubly linked lists of the corners of a node, shape (4 m,).
        first_corner: head of the list of each node, -1 when no tetrahedron uses it, shape (n,).
        triangles: nodes of the surface triangles, shape (k, 3).
        triangle_face: face of each surface triangle, shape (k,).
        triangle_kind: OUTER or CUT, shape (k,).
        log: slots written: tetrahedron t as 2 t, triangle k as 2 k + 1.
        region: row of the table of materials by tetrahedron, shape (m,); (0,): one material.
    """

    counts: np.ndarray
    tetrahedra: np.ndarray
    neighbors: np.ndarray
    face_triangle: np.ndarray
    corner_next: np.ndarray
    corner_prev: np.ndarray
    first_corner: np.ndarray
    triangles: np.ndarray
    triangle_face: np.ndarray
    triangle_kind: np.ndarray
    log: np.ndarray
    region: np.ndarray


@inner
def of_region(links, tet, values):
    """Return the value of a tetrahedron's region, of values by region."""
    return values[links.region[tet]] if links.region.shape[0] > 0 else values[0]


@inner
def _note(links, entry):
    links.log[links.counts[2]] = entry
    links.counts[2] += 1


@inner
def _add_triangle(links, face, kind):
    k = links.counts[1]
    links.counts[1] = k + 1
    tet, local = face // 4, face % 4
    for i in range(3):
        links.triangles[k, i] = links.tetrahedra[tet, FACE_NODES[local, i]]
    links.triangle_face[k] = face
    links.triangle_kind[k] = kind
    links.face_triangle[tet, local] = k
    _note(links, 2 * k + 1)


@inner
def _remove_triangle(links, k):
    face = links.triangle_face[k]
    links.face_triangle[face // 4, face % 4] = -1
    last = links.counts[1] - 1
    links.counts[1] = last
    if k != last:
        face = links.triangle_face[last]
        for i in range(3):
            links.triangles[k, i] = links.triangles[last, i]
        links.triangle_face[k] = face
        links.triangle_kind[k] = links.triangle_kind[last]
        links.face_triangle[face // 4, face % 4] = k
        _note(links, 2 * k + 1)


@inner
def _add_corner(links, corner):
    node = links.tetrahedra[corner // 4, corner % 4]
    head = links.first_corner[node]
    links.corner_next[corner] = head
    links.corner_prev[corner] = -1
    if head >= 0:
        links.corner_prev[head] = corner
    links.first_corner[node] = corner


@inner
def _remove_corner(links, corner):
    before, after = links.corner_prev[corner], links.corner_next[corner]
    if before >= 0:
        links.corner_next[before] = after
    else:
        links.first_corner[links.tetrahedra[corner // 4, corner % 4]] = after
    if after >= 0:
        links.corner_prev[after] = before


@inner
def _matching_face(links, tet, local):
    """Return the face of another tetrahedron with the same nodes, -1 (none) or -2 (a third one)."""
    a = links.tetrahedra[tet, FACE_NODES[local, 0]]
    b = links.tetrahedra[tet, FACE_NODES[local, 1]]
    c = links.tetrahedra[tet, FACE_NODES[local, 2]]
    corner = links.first_corner[a]
    while corner >= 0:
        other = corner // 4
        if other != tet:
            found = 0
            opposite = -1
            for i in range(4):
                node = links.tetrahedra[other, i]
                if node == a or node == b or node == c:
                    found += 1
                else:
                    opposite = i
            if found == 3:
                if links.neighbors[other, opposite] != -1:
                    return -2
                return 4 * other + opposite
        corner = links.corner_next[corner]
    return -1


@inner
def _link(links, tet, outer_faces):
    for i in range(4):
        links.neighbors[tet, i] = -1
        links.face_triangle[tet, i] = -1
        _add_corner(links, 4 * tet + i)
    for local in range(4):
        face = _matching_face(links, tet, local)
        if face == -2:
            return False
        if face >= 0:
            links.neighbors[tet, local] = face
            links.neighbors[face // 4, face % 4] = 4 * tet + local
            _remove_triangle(links, links.face_triangle[face // 4, face % 4])
        else:
            _add_triangle(links, 4 * tet + local, OUTER if outer_faces >> local & 1 else CUT)
    return True


@inner
def _unlink(links, tet):
    for local in range(4):
        face = links.neighbors[tet, local]
        if face >= 0:
            links.neighbors[face // 4, face % 4] = -1
            _add_triangle(links, face, CUT)
        else:
            _remove_triangle(links, links.face_triangle[tet, local])
        _remove_corner(links, 4 * tet + local)


@inner
def _move(links, source, target):
    if links.region.shape[0] > 0:
        links.region[target] = links.region[source]
    for i in range(4):
        links.tetrahedra[target, i] = links.tetrahedra[source, i]
        links.neighbors[target, i] = links.neighbors[source, i]
        links.face_triangle[target, i] = links.face_triangle[source, i]
        face = links.neighbors[source, i]
        if face >= 0:
            links.neighbors[face // 4, face % 4] = 4 * target + i
        else:
            links.triangle_face[links.face_triangle[source, i]] = 4 * target + i
        old, new = 4 * source + i, 4 * target + i
        before, after = links.corner_prev[old], links.corner_next[old]
        links.corner_prev[new] = before
        links.corner_next[new] = after
        if before >= 0:
            links.corner_next[before] = new
        else:
            links.first_corner[links.tetrahedra[source, i]] = new
        if after >= 0:
            links.corner_prev[after] = new


@kernel
def remove_tetrahedra(links, descending):
    """Remove tetrahedra; the last one fills each gap.

    Args:
        links: connectivity.
        descending: indices without repeats, largest first, shape (r,).
    """
    for tet in descending:
        _unlink(links, tet)
        last = links.counts[0] - 1
        if tet != last:
            _move(links, last, tet)
        links.counts[0] = last
        _note(links, 2 * tet)


@kernel
def append_tetrahedra(links, added, outer_faces, regions):
    """Append tetrahedra.

    Args:
        links: connectivity, with room for them.
        added: node indices, positively oriented, shape (a, 4).
        outer_faces: bit f set: the face opposite node f, where free, is OUTER, shape (a,).
        regions: of each, shape (a,); not read where there is one material.

    Returns:
        Index into `added` of the first one that would be the third on a face, or -1.
    """
    for a in range(len(added)):
        tet = links.counts[0]
        links.counts[0] = tet + 1
        for i in range(4):
            links.tetrahedra[tet, i] = added[a, i]
        if links.region.shape[0] > 0:
            links.region[tet] = regions[a]
        _note(links, 2 * tet)
        if not _link(links, tet, outer_faces[a]):
            return a
    return -1


@kernel
def renumber_node(links, source, target):
    """Renumber node `source` in its tetrahedra and triangles to the unused number `target`."""
    corner = links.first_corner[source]
    links.first_corner[target] = corner
    links.first_corner[source] = -1
    while corner >= 0:
        tet = corner // 4
        links.tetrahedra[tet, corner % 4] = target
        _note(links, 2 * tet)
        for local in range(4):
            k = links.face_triangle[tet, local]
            if k >= 0 and local != corner % 4:
                for i in range(3):
                    if links.triangles[k, i] == source:
                        links.triangles[k, i] = target
                        _note(links, 2 * k + 1)
        corner = links.corner_next[corner]


@kernel
def adjacent_nodes(tetrahedra, first_corner, corner_next, nodes):
    """Return the nodes of the tetrahedra around some nodes, with repeats, shape (s,)."""
    found = [np.int64(0) for _ in range(0)]
    for node in nodes:
        corner = first_corner[node]
        while corner >= 0:
            for i in range(4):
                found.append(np.int64(tetrahedra[corner // 4, i]))
            corner = corner_next[corner]
    return np.array(found, np.int64)
