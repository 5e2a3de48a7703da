"""Subdivision: new children of the parents in a batch, by the tables of cases (thesis 5.3.1)."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.geometry import EDGE_NODES, altitude, height
from cutting_trainer.cutting.lookup import DONE, PENDING, SNAPPED, edge_key, find_edge, side_of
from cutting_trainer.cutting.state_table import crossings_of
from cutting_trainer.cutting.subdivision_cases import (
    CHILDREN,
    FRONT,
    INSIDE,
    LABEL_FACES,
    MID,
    NUMBER,
    ORDER,
    STATE,
)
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES


class Pieces(NamedTuple):
    """New elements of a batch before nodes are duplicated. New nodes are numbered after the mesh's
    nodes.

    Attributes:
        corners: shape (k, 4).
        labels: corners in terms of the parent, shape (k, 4).
        owners: row of the parent, shape (k,).
        outer: bits of the faces on the original surface, shape (k,).
        states: by parent of the batch, shape (p,).
        removed: removed tetrahedra, unsorted, shape (r,).
        new_parents, new_weights: of the new nodes, shape (v, 4).
        new_rest: their rest positions [m], shape (v, 3).
        orphans: removed nodes, unsorted, shape (o,).
    """

    corners: np.ndarray
    labels: np.ndarray
    owners: np.ndarray
    outer: np.ndarray
    states: np.ndarray
    removed: np.ndarray
    new_parents: np.ndarray
    new_weights: np.ndarray
    new_rest: np.ndarray
    orphans: np.ndarray


@inner
def id_order(base):
    """Return the number of the order, of 24, of four node numbers."""
    rank = np.zeros(4, np.int64)
    for i in range(4):
        for j in range(4):
            rank[i] += base[j] < base[i]
    return ORDER[rank[0], rank[1], rank[2], rank[3]]


@inner
def _front_point(tables, positions, a, b, o, row, tau, centred, weights):
    """Compute weights of a, b, o for the end of the slit in their face, where only edge a b is cut.

    It lies on the line from the crossing of a b to the point where the surface leaves the face, as
    far from the face's edges as possible: small elements at the front shorten the stable step as
    long as they last.
    """
    share = tables.edge_share[row] if a < b else 1.0 - tables.edge_share[row]
    if centred:
        weights[:3] = 1.0 / 3.0
        return
    if side_of(tables, o) == SNAPPED:
        weights[0], weights[1], weights[2] = 2 * (1.0 - share) / 3, 2 * share / 3, 1.0 / 3.0
        return
    normal = tables.edge_normal[row]
    mid = (1.0 - share) * positions[a] + share * positions[b]
    at_a, at_b = height(normal, mid, positions[a]), height(normal, mid, positions[b])
    at_o = height(normal, mid, positions[o])
    side = side_of(tables, o)
    with_a = side == side_of(tables, a) if side != 0 else at_o * at_a > 0.0
    # The surface separates one node, the corner, from two; it enters and leaves at its edges.
    corner, above, enters = (b, at_b, 1.0 - share) if with_a else (a, at_a, share)
    leaves = above / (above - at_o) if above * at_o < 0.0 else 0.5
    crossing = find_edge(tables, corner, o)
    if crossing >= 0 and tables.edge_state[crossing] == PENDING:
        leaves = tables.edge_share[crossing] if corner < o else 1.0 - tables.edge_share[crossing]
    leaves = min(max(leaves, tau), 1.0 - tau)
    far = enters * leaves / (enters + leaves)
    weights[0], weights[1], weights[2] = far, far, far
    weights[1 if with_a else 0] = 1.0 - 2 * far


@inner
def _weigh(tables, positions, parent, code, tau, plain, rows, weights):
    """Compute parents (as nodes) and weights of the new point of a label."""
    base = tables.parent_nodes[parent]
    for i in range(4):
        rows[i] = base[0]
        weights[i] = 0.0
    if code < FRONT:
        pair = (code - MID) // 2
        a, b = base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]]
        share = tables.edge_share[find_edge(tables, a, b)]
        rows[0], rows[1] = min(a, b), max(a, b)
        rows[2] = rows[3] = rows[0]
        weights[0], weights[1] = 1.0 - share, share
    elif code == INSIDE:
        for i in range(4):
            rows[i], weights[i] = base[i], 0.25
    else:
        face = np.sort(base[FACE_NODES[code - FRONT]])
        for k in range(3):
            o, a, b = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            row = find_edge(tables, a, b)
            if row >= 0 and tables.edge_state[row] == DONE:
                rows[0], rows[1], rows[2], rows[3] = a, b, o, a
                centred = tau >= 0.5 or (plain == edge_key(a, b)).any()
                _front_point(tables, positions, a, b, o, row, tau, centred, weights)
                return


@inner
def _identity(tables, parent, code):
    """Return the key of a point that is shared by several parents."""
    base = tables.parent_nodes[parent]
    if code < FRONT:
        pair = (code - MID) // 2
        a, b = base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]]
        stays = EDGE_NODES[pair, (code - MID) % 2]
        return np.int64(0), edge_key(a, b), base[stays]
    if code == INSIDE:
        return np.int64(1), np.int64(parent), np.int64(0)
    face = np.sort(base[FACE_NODES[code - FRONT]])
    return np.int64(2), edge_key(face[0], face[1]), face[2]


@kernel
def subdivide(parents, links, tables, positions, rest, tau, plain):
    """Return the children of some parents for the crossings that are DONE.

    Args:
        parents: rows, shape (p,).
        links, tables: mesh and stroke.
        positions, rest: nodes now and at rest [m], shape (n, 3).
        tau: smallest distance of points on the front from nodes, as a share of an edge; 0.5: face
            centroids.
        plain: keys of edges, shape (k,), next to which the front uses face centroids.

    Returns:
        The pieces, and the first parent in an unknown state or -1.
    """
    most = 16 * len(parents)
    corners, labels = np.empty((most, 4), np.int64), np.empty((most, 4), np.int8)
    owners, outer = np.empty(most, np.int64), np.empty(most, np.uint8)
    states = np.empty(len(parents), np.int64)
    removed = [np.int64(0) for _ in range(0)]
    new_parents = np.empty((most, 4), np.int64)
    new_weights = np.empty((most, 4))
    known = {}
    kept: dict[int, bool] = {}
    count = np.int64(0)  # of a literal, Numba would compile `_gathered` once more
    first_new = len(rest)
    new, unknown = np.int64(0), np.int64(-1)
    ids = np.empty(INSIDE + 1, np.int64)
    for p in range(len(parents)):
        parent = parents[p]
        edges, nodes = crossings_of(tables, parent)
        state = STATE[edges, nodes] if edges else -1
        states[p] = state
        if edges and state < 0:
            unknown, count, new = np.int64(parent), np.int64(0), np.int64(0)
            break
        ids[:] = -1
        for k in range(tables.child_count[parent]):
            tet = tables.children[parent, k]
            removed.append(np.int64(tet))
            for i in range(4):
                code = tables.label[tet, i]
                ids[code] = links.tetrahedra[tet, i]
                if code >= FRONT and ids[code] not in kept:
                    kept[ids[code]] = False
        order = id_order(tables.parent_nodes[parent])
        for k in range(NUMBER[state, order] if state >= 0 else 1):
            for i in range(4):
                code = np.int64(CHILDREN[state, order, k, i]) if state >= 0 else i
                if ids[code] < 0:
                    name = _identity(tables, parent, code)
                    if name not in known:
                        known[name] = first_new + new
                        _weigh(
                            tables,
                            positions,
                            parent,
                            code,
                            tau,
                            plain,
                            new_parents[new],
                            new_weights[new],
                        )
                        new += 1
                    ids[code] = known[name]
                elif code >= FRONT:
                    kept[ids[code]] = True
                corners[count, i] = ids[code]
                labels[count, i] = code
            outer[count] = _outer(labels[count], tables.parent_outer[parent])
            owners[count] = parent
            count += 1
    return _gathered(
        corners,
        labels,
        owners,
        outer,
        states,
        removed,
        new_parents,
        new_weights,
        rest,
        kept,
        count,
        new,
    ), unknown


@inner
def _outer(label, parent_outer):
    """Return bits of a child's faces in faces of its parent on the original surface."""
    bits = 0
    for face in range(4):
        common = np.uint8(15)
        for i in range(4):
            if i != face:
                common &= LABEL_FACES[label[i]]
        if common & parent_outer:
            bits |= 1 << face
    return bits


@inner
def _gathered(
    corners,
    labels,
    owners,
    outer,
    states,
    removed,
    new_parents,
    new_weights,
    rest,
    kept,
    count,
    new,
):
    new_rest = np.zeros((new, 3))
    for v in range(new):
        for i in range(4):
            for axis in range(3):
                new_rest[v, axis] += new_weights[v, i] * rest[new_parents[v, i], axis]
    orphans = [np.int64(0) for _ in range(0)]
    for node, used in kept.items():
        if not used and node < len(rest):
            orphans.append(node)
    return Pieces(
        corners[:count],
        labels[:count],
        owners[:count],
        outer[:count],
        states,
        np.array(removed, np.int64),
        new_parents[:new],
        new_weights[:new],
        new_rest,
        np.array(orphans, np.int64),
    )


@kernel
def spoiled(pieces, tables, rest, moved, where, floor):
    """Return the parents with a child below the altitude floor.

    Args:
        pieces: children of a batch.
        tables: of the stroke.
        rest: [m], shape (n, 3).
        moved, where: rows of nodes that slide, and where to [m], shape (j,), (j, 3).
        floor: [m].

    Returns:
        Rows, each once, shape (b,), and the smallest altitude of all children [m].
    """
    at: dict[int, int] = {}
    for k in range(len(moved)):
        at[tables.node_id[moved[k]]] = k
    at[-1] = 0
    found = [np.int64(0) for _ in range(0)]
    worst = np.inf
    x = np.empty((4, 3))
    for k in range(len(pieces.corners)):
        for i in range(4):
            node = pieces.corners[k, i]
            for axis in range(3):
                if node >= len(rest):
                    x[i, axis] = pieces.new_rest[node - len(rest), axis]
                elif node in at:
                    x[i, axis] = where[at[node], axis]
                else:
                    x[i, axis] = rest[node, axis]
        low = altitude(x[0], x[1], x[2], x[3])
        worst = min(worst, low)
        if low < floor and (len(found) == 0 or found[-1] != pieces.owners[k]):
            found.append(pieces.owners[k])
    return np.array(found, np.int64), worst
