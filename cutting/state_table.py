"""The state table (thesis 5.3.4): parents of the stroke, their crossings, and the tetrahedra
they consist of now.
"""

import numpy as np
from numba import njit

from cutting.contact import segment_meets
from cutting.geometry import EDGE_NODES
from cutting.lookup import (
    BLOCKED,
    DONE,
    EDGES,
    NODES,
    PARENTS,
    PENDING,
    base_nodes,
    edge_key,
    find_edge,
    on_cut,
    origin_of,
)
from tissue_sim.topology import OUTER


@njit(cache=True)
def active_list(root, tip, links, tables, positions, met):
    """Tetrahedra of the stroke's beginning that the blade is in now, by their nodes (thesis 5.4).

    Args:
        root, tip: the blade's edge [m], shape (3,).
        links, tables: mesh and stroke.
        positions: current nodes [m], shape (n, 3).
        met: tetrahedra that the sweep met, shape (t,).

    Returns:
        Shape (a, 4).
    """
    active = np.empty((len(met), 4), np.int64)
    count = 0
    seen = {np.int64(-1)}
    for tet in met:
        owner = np.int64(tables.owner[tet])
        if owner >= 0:
            if owner in seen:
                continue
            seen.add(owner)
        base_nodes(tables, links, tet, active[count])
        if segment_meets(root, tip, positions, active[count]):
            count += 1
    return active[:count]


@njit(cache=True)
def non_active_crossings(active, tables):
    """Marks the crossings that the blade has left as belonging to the mesh.

    Args:
        active: nodes of the tetrahedra that the blade is in, shape (a, 4).
        tables: of the stroke.

    Returns:
        Rows of the edges, and of the nodes, that go from PENDING to DONE.
    """
    held = {np.int64(-1)}
    for k in range(len(active)):
        for pair in range(6):
            held.add(edge_key(active[k, EDGE_NODES[pair, 0]], active[k, EDGE_NODES[pair, 1]]))
        for i in range(4):
            held.add(edge_key(active[k, i], active[k, i]))
    edges = [np.int64(0) for _ in range(0)]
    nodes = [np.int64(0) for _ in range(0)]
    for row in range(tables.counts[EDGES]):
        key = edge_key(tables.edge_nodes[row, 0], tables.edge_nodes[row, 1])
        if tables.edge_state[row] == PENDING and key not in held:
            tables.edge_state[row] = DONE
            edges.append(np.int64(row))
    for row in range(tables.counts[NODES]):
        key = edge_key(tables.node_id[row], tables.node_id[row])
        if tables.node_state[row] == PENDING and key not in held:
            tables.node_state[row] = DONE
            nodes.append(np.int64(row))
    return np.array(edges), np.array(nodes)


@njit(cache=True)
def pending(tables):
    """How many crossings the mesh does not have yet."""
    count = 0
    for row in range(tables.counts[EDGES]):
        count += tables.edge_state[row] == PENDING
    for row in range(tables.counts[NODES]):
        count += tables.node_state[row] == PENDING
    return count


@njit(cache=True)
def ring_members(links, tables, edges):
    """Tetrahedra around some edges that have no parent yet.

    Args:
        links, tables: mesh and stroke.
        edges: rows, shape (k,).

    Returns:
        Shape (t,).
    """
    found = [np.int64(0) for _ in range(0)]
    seen = {np.int64(-1)}
    for row in edges:
        a, b = tables.edge_nodes[row, 0], tables.edge_nodes[row, 1]
        corner = links.first_corner[a]
        while corner >= 0:
            tet = np.int64(corner // 4)
            if tables.owner[tet] < 0 and tet not in seen:
                for i in range(4):
                    if links.tetrahedra[tet, i] == b:
                        seen.add(tet)
                        found.append(tet)
            corner = links.corner_next[corner]
    return np.array(found)


@njit(cache=True)
def adopt(links, tables, members):
    """Enters tetrahedra in the state table, each as the only child of itself.

    Args:
        links, tables: mesh and stroke, with room for as many parents.
        members: without repeats, shape (t,).
    """
    for tet in members:
        row = tables.counts[PARENTS]
        tables.counts[PARENTS] = row + 1
        base_nodes(tables, links, tet, tables.parent_nodes[row])
        tables.owner[tet] = row
        tables.parent_outer[row] = outer_bits(links, tet)
        tables.parent_state[row] = -1
        tables.parent_area[row] = 0.0
        tables.children[row, 0] = tet
        tables.child_count[row] = 1
        for i in range(4):
            tables.label[tet, i] = i


@njit(cache=True)
def outer_bits(links, tet):
    """Bit f: the face opposite node f lies on the original surface."""
    bits = 0
    for face in range(4):
        k = links.face_triangle[tet, face]
        if k >= 0 and links.triangle_kind[k] == OUTER:
            bits |= 1 << face
    return bits


@njit(cache=True)
def outer_bits_of(links, tetrahedra):
    """The same for several, shape (t,)."""
    bits = np.empty(len(tetrahedra), np.uint8)
    for k in range(len(tetrahedra)):
        bits[k] = outer_bits(links, tetrahedra[k])
    return bits


@njit(cache=True)
def parents_concerned(links, tables, edges, nodes):
    """Rows of the parents that some new crossings belong to, each once."""
    found = [np.int64(0) for _ in range(0)]
    seen = {np.int64(-1)}
    for row in edges:
        a, b = tables.edge_nodes[row, 0], tables.edge_nodes[row, 1]
        corner = links.first_corner[a]
        while corner >= 0:
            owner = np.int64(tables.owner[corner // 4])
            if owner >= 0 and owner not in seen and (tables.parent_nodes[owner] == b).any():
                seen.add(owner)
                found.append(owner)
            corner = links.corner_next[corner]
    for row in nodes:
        corner = links.first_corner[tables.node_id[row]]
        while corner >= 0:
            owner = np.int64(tables.owner[corner // 4])
            if owner >= 0 and owner not in seen:
                seen.add(owner)
                found.append(owner)
            corner = links.corner_next[corner]
    return np.array(found)


@njit(cache=True)
def crossings_of(tables, parent):
    """Bits of the cut edges and of the nodes on the cut of a parent, as the mesh has them or is
    to have them.
    """
    edges = nodes = 0
    base = tables.parent_nodes[parent]
    for pair in range(6):
        row = find_edge(tables, base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]])
        if row >= 0 and tables.edge_state[row] == DONE:
            edges |= 1 << pair
    for i in range(4):
        if on_cut(tables, base[i]):
            nodes |= 1 << i
    return edges, nodes


@njit(cache=True)
def block(tables, parent, fresh):
    """Gives up the new crossings of a parent's edges; returns how many."""
    count = 0
    base = tables.parent_nodes[parent]
    for pair in range(6):
        row = find_edge(tables, base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]])
        if row >= 0 and tables.edge_state[row] == DONE and (fresh == row).any():
            tables.edge_state[row] = BLOCKED
            count += 1
    return count


@njit(cache=True)
def _forget_child(tables, parent, tet):
    last = tables.child_count[parent] - 1
    for k in range(last + 1):
        if tables.children[parent, k] == tet:
            tables.children[parent, k] = tables.children[parent, last]
            tables.child_count[parent] = last
            return


@njit(cache=True)
def settle(tables, count, removed, owners, labels):
    """Follows `TetMesh.apply`: tetrahedra go, the last one fills each gap, then new ones come.

    Args:
        tables: with room for the tetrahedra to come.
        count: tetrahedra before.
        removed: without repeats, largest first, shape (r,).
        owners: parent of each new one, or -1, shape (c,).
        labels: its corners, shape (c, 4).
    """
    for tet in removed:
        if tables.owner[tet] >= 0:
            _forget_child(tables, tables.owner[tet], tet)
    for tet in removed:
        count -= 1
        owner = tables.owner[count]
        if tet != count:
            tables.owner[tet] = owner
            tables.label[tet] = tables.label[count]
            if owner >= 0:
                for k in range(tables.child_count[owner]):
                    if tables.children[owner, k] == count:
                        tables.children[owner, k] = tet
        tables.owner[count] = -1
    for k in range(len(owners)):
        owner = owners[k]
        tables.owner[count] = owner
        tables.label[count] = labels[k]
        if owner >= 0:
            tables.children[owner, tables.child_count[owner]] = count
            tables.child_count[owner] += 1
        count += 1


@njit(cache=True)
def settle_nodes(tables, count, orphans, copied):
    """Follows `TetMesh.apply`: nodes come, and the last one takes the number of each that goes.

    Args:
        tables: with room for the nodes to come.
        count: nodes before.
        orphans: nodes that no tetrahedron uses afterwards, largest first, shape (k,).
        copied: node that each new one is a copy of, or -1, shape (a,).
    """
    for k in range(len(copied)):
        tables.origin[count + k] = origin_of(tables, copied[k]) if copied[k] >= 0 else -1
    count += len(copied)
    for node in orphans:
        count -= 1
        if node != count:
            tables.origin[node] = tables.origin[count]
        tables.origin[count] = -1
