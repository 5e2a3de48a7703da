"""Node splitting (docs/cutting.md): a node is duplicated when its tetrahedra are disconnected."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.geometry import orientation
from cutting_trainer.cutting.lookup import SNAPPED, is_on_cut, on_cut_bits, origin_of
from cutting_trainer.cutting.subdivision_cases import FRONT, LABEL_FACES
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import area_vector, norm
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES


class Patch(NamedTuple):
    """Children of a batch and the tetrahedra around them, with their connections.

    Attributes:
        corners: shape (l, 4); pieces of the batch first, then tetrahedra that stay.
        tetrahedra: number in the mesh, -1 for a child, shape (l,).
        across: face (4 e + f) on the other side of each face within the patch, else -1, shape (l,
            4).
        opened: the two faces (4 e + f) of each face along the cut, shape (s, 2).
    """

    corners: np.ndarray
    tetrahedra: np.ndarray
    across: np.ndarray
    opened: np.ndarray


@inner
def _side(corners, tables, positions):
    """Return the side of a whole tetrahedron: of a node, else of its node beyond the face on the
    cut, else of its centre above its nodes' planes.
    """
    x = y = z = 0.0
    beyond = -1
    unknown = 0
    for i in range(4):
        row = tables.node_row[origin_of(tables, corners[i])]
        if row >= 0 and tables.node_side[row] != SNAPPED:
            return np.int64(tables.node_side[row])
        if row < 0:
            beyond = corners[i]
            unknown += 1
        x += 0.25 * positions[corners[i], 0]
        y += 0.25 * positions[corners[i], 1]
        z += 0.25 * positions[corners[i], 2]
    # The cut goes through the face itself, also where its nodes lie off the swept surface.
    single = unknown == 1
    if single:
        x, y, z = positions[beyond, 0], positions[beyond, 1], positions[beyond, 2]
    height = 0.0
    for i in range(4):
        row = tables.node_row[origin_of(tables, corners[i])]
        if row >= 0:
            at = corners[i]
            height += tables.node_plane[row, 0] * (x - positions[at, 0])
            height += tables.node_plane[row, 1] * (y - positions[at, 1])
            height += tables.node_plane[row, 2] * (z - positions[at, 2])
            if not single:
                height += tables.node_plane[row, 3]
    return np.int64(1) if height >= 0.0 else np.int64(-1)


@kernel
def nodes_concerned(pieces, links, tables, positions, fresh, first_new):
    """Return the nodes that a batch may split.

    Args:
        pieces: children of the batch.
        links, tables: mesh and stroke.
        positions: current nodes [m], shape (n, 3).
        fresh: rows of nodes newly on the cut, shape (k,).
        first_new: number of the first new node.

    Returns:
        Shape (a,).
    """
    tetrahedra, corner_next, neighbors = links.tetrahedra, links.corner_next, links.neighbors
    origin, node_row = tables.origin, tables.node_row
    side, state = tables.node_side, tables.node_state
    corners, labels, owners = pieces.corners, pieces.labels, pieces.owners
    parent_nodes = tables.parent_nodes
    found = {np.int64(-1)}
    for k in range(len(corners)):
        for i in range(4):
            node, code = corners[k, i], labels[k, i]
            if code < 4:
                if is_on_cut(node_row, side, state, parent_nodes[owners[k], code]):
                    found.add(node)
            elif code < FRONT and node >= first_new:
                found.add(node)
    for row in fresh:
        found.add(tables.node_id[row])
    queue = [node for node in found if 0 <= node < first_new]
    while len(queue) > 0:
        node = queue.pop()
        corner = links.first_corner[node]
        while corner >= 0:
            tet, local = corner // 4, corner % 4
            bits = on_cut_bits(tetrahedra[tet], first_new, origin, node_row, side, state)
            for face in range(4):
                across = neighbors[tet, face]
                if face == local or bits | 1 << face != 15 or across < 0:
                    continue
                # A closed face along the cut: it ends at the front, so far.
                here = _side(tetrahedra[tet], tables, positions)
                if here != _side(tetrahedra[across // 4], tables, positions):
                    for i in range(3):
                        other = np.int64(tetrahedra[tet, FACE_NODES[face, i]])
                        if other not in found:
                            found.add(other)
                            queue.append(other)
            corner = corner_next[corner]
    found.remove(np.int64(-1))
    return np.sort(np.array(list(found), np.int64))


@kernel
def lay_patch(pieces, concerned, links, tables, positions, first_new):
    """Arrange the children, and the tetrahedra around them and around the nodes concerned, in a
    patch.

    Args:
        pieces: children of the batch.
        concerned: as from `nodes_concerned`, shape (a,).
        links, tables: mesh and stroke.
        positions: current nodes [m], shape (n, 3).
        first_new: number of the first new node.
    """
    gone = set(pieces.removed)
    gone.add(np.int64(-1))
    stay = [np.int64(0) for _ in range(0)]
    seen = {np.int64(-1)}
    for node in concerned:
        if node < first_new:
            corner = links.first_corner[node]
            while corner >= 0:
                tet = np.int64(corner // 4)
                if tet not in gone and tet not in seen:
                    seen.add(tet)
                    stay.append(tet)
                corner = links.corner_next[corner]
    for tet in pieces.removed:
        for face in links.neighbors[tet]:
            if face >= 0 and np.int64(face // 4) not in gone and np.int64(face // 4) not in seen:
                seen.add(np.int64(face // 4))
                stay.append(np.int64(face // 4))
    count, size = len(pieces.corners), len(pieces.corners) + len(stay)
    corners, tetrahedra = np.empty((size, 4), np.int64), np.full(size, -1, np.int64)
    for k in range(count):
        for i in range(4):
            corners[k, i] = pieces.corners[k, i]
    for k in range(len(stay)):
        tetrahedra[count + k] = stay[k]
        for i in range(4):
            corners[count + k, i] = links.tetrahedra[stay[k], i]
    across = np.full((size, 4), -1, np.int64)
    opened = _match(corners, tables, positions, first_new, across)
    return Patch(corners, tetrahedra, across, opened)


@inner
def _match(corners, tables, positions, first_new, across):
    """Fill `across`; return the pairs of faces along the cut."""
    opened = np.empty((4 * len(corners), 2), np.int64)
    number = 0
    by_nodes = {}
    origin, node_row = tables.origin, tables.node_row
    side, state = tables.node_side, tables.node_state
    for e in range(len(corners)):
        bits = on_cut_bits(corners[e], first_new, origin, node_row, side, state)
        for f in range(4):
            a, b, c = (
                corners[e, FACE_NODES[f, 0]],
                corners[e, FACE_NODES[f, 1]],
                corners[e, FACE_NODES[f, 2]],
            )
            low, high = min(a, b, c), max(a, b, c)
            key = (low, a + b + c - low - high, high)
            if key not in by_nodes:
                by_nodes[key] = 4 * e + f
                continue
            other = by_nodes[key]
            if bits | 1 << f == 15:
                here = _side(corners[e], tables, positions)
                if here != _side(corners[other // 4], tables, positions):
                    opened[number, 0], opened[number, 1] = other, 4 * e + f
                    number += 1
                    continue
            across[e, f] = other
            across[other // 4, other % 4] = 4 * e + f
    return opened[:number]


@inner
def _root(parent, k):
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@inner
def _corner_groups(patch):
    """Return a number for all corners at a node connected by faces with that node, shape (4 l,)."""
    corners, across = patch.corners, patch.across
    group = np.arange(4 * len(corners))
    for e in range(len(corners)):
        for f in range(4):
            face = across[e, f]
            if face > 4 * e + f:
                other = face // 4
                for i in range(4):
                    if i != f:
                        for j in range(4):
                            if corners[other, j] == corners[e, i]:
                                one, two = _root(group, 4 * e + i), _root(group, 4 * other + j)
                                group[max(one, two)] = min(one, two)
    for k in range(len(group)):
        group[k] = _root(group, k)
    return group


@kernel
def split_nodes(patch, concerned, rest, new_rest):
    """Give each disconnected part a node of its own; the part with most rest volume keeps the
    number.

    Args:
        patch: its corners are renumbered in place.
        concerned: nodes to test, shape (a,).
        rest: of the mesh's nodes [m], shape (n, 3).
        new_rest: of the batch's new nodes [m], shape (v, 3).

    Returns:
        The original of each further new node, shape (k,).
    """
    corners = patch.corners
    group = _corner_groups(patch)
    looked_at = set(concerned)
    volume = np.zeros(len(group))
    x = np.empty((4, 3))
    for e in range(len(corners)):
        for i in range(4):
            node = corners[e, i]
            x[i] = rest[node] if node < len(rest) else new_rest[node - len(rest)]
        size = orientation(x[0], x[1], x[2], x[3])
        for i in range(4):
            volume[group[4 * e + i]] += size
    keeps: dict[int, int] = {}
    for k in range(len(group)):
        node = corners[k // 4, k % 4]
        first = group[k] == k and node in looked_at
        if first and (node not in keeps or volume[k] > volume[keeps[node]]):
            keeps[node] = k
    copies = [np.int64(0) for _ in range(0)]
    number = {}
    first_copy = len(rest) + len(new_rest)
    for k in range(len(group)):
        node = corners[k // 4, k % 4]
        if node in keeps and keeps[node] != group[k]:
            if group[k] not in number:
                number[group[k]] = first_copy + len(copies)
                copies.append(node)
            corners[k // 4, k % 4] = number[group[k]]
    return np.array(copies, np.int64)


@inner
def _face_area(x, face):
    a, b, c = x[FACE_NODES[face, 0]], x[FACE_NODES[face, 1]], x[FACE_NODES[face, 2]]
    normal = np.empty(3)
    area_vector(a, b, c, normal)
    return 0.5 * norm(normal)


@inner
def _place(node, rest, new_rest, at, where):
    if node >= len(rest):
        return new_rest[node - len(rest)]
    return where[at[node]] if node in at else rest[node]


@kernel
def cut_area(patch, pieces, tables, before, rest, new_rest, moved, where):
    """Return the new cut area of a batch, one side; record the area of each parent.

    Faces of the cut that end at the front on all sides stay closed, and are joined again in the
    patch.

    Args:
        patch: with its corners renumbered.
        pieces, tables: of the batch and the stroke.
        before: corners of the patch before they were renumbered, shape (l, 4).
        rest, new_rest: [m], shape (n, 3), (v, 3).
        moved, where: rows of nodes that slide, shape (j,), and where to [m], (j, 3).

    Returns:
        Area [m^2], and the number of faces that were separated.
    """
    area = 0.0
    at: dict[int, int] = {}
    at[-1] = 0
    for k in range(len(moved)):
        at[tables.node_id[moved[k]]] = k
    x = np.empty((4, 3))
    last = -1
    for e in range(len(pieces.corners)):
        owner = pieces.owners[e]
        if owner != last:
            area -= tables.parent_area[owner]
            tables.parent_area[owner] = 0.0
            last = owner
        for i in range(4):
            x[i] = _place(before[e, i], rest, new_rest, at, where)
        for f in range(4):
            common = np.uint8(15)
            for i in range(4):
                if i != f:
                    common &= LABEL_FACES[pieces.labels[e, i]]
            if common == 0 and patch.across[e, f] < 0:
                half = 0.5 * _face_area(x, f)
                area += half
                tables.parent_area[owner] += half
    separated = 0
    for k in range(len(patch.opened)):
        one, two = patch.opened[k, 0], patch.opened[k, 1]
        same = 0
        for i in range(4):
            for j in range(4):
                if i != one % 4 and j != two % 4:
                    same += patch.corners[one // 4, i] == patch.corners[two // 4, j]
        if same == 3:
            patch.across[one // 4, one % 4] = two
            patch.across[two // 4, two % 4] = one
        else:
            separated += 1
            for i in range(4):
                x[i] = _place(before[one // 4, i], rest, new_rest, at, where)
            area += _face_area(x, one % 4)
    return area, separated
