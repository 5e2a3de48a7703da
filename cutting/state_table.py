"""State table (thesis 5.3.4): parents of the stroke, their crossings, and their present
tetrahedra.
"""

import numpy as np

from cutting_trainer.cutting.crossings import segment_within
from cutting_trainer.cutting.geometry import EDGE_NODES
from cutting_trainer.cutting.lookup import (
    BLOCKED,
    DONE,
    EDGES,
    NODES,
    PARENTS,
    PENDING,
    SNAPPED,
    WAITS_PLUS,
    base_nodes,
    edge_key,
    find_edge,
    on_cut,
    origin_of,
)
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.topology import OUTER


@kernel
def active_list(root, tip, links, tables, positions, met):
    """Return the stroke's original tetrahedra around the blade (thesis 5.4).

    Args:
        root, tip: the blade's edge [m], shape (3,).
        links, tables: mesh and stroke.
        positions: current nodes [m], shape (n, 3).
        met: tetrahedra met by the sweep, shape (t,).

    Returns:
        Their nodes, shape (a, 4), and the length of the edge in them [m].
    """
    inside = 0.0
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
        low, high = segment_within(root, tip, positions, active[count])
        if low <= high:
            inside += high - low
            count += 1
    return active[:count], inside * np.sqrt(((tip - root) ** 2).sum())


@kernel
def non_active_crossings(active, tables):
    """Mark the crossings that the blade has left as part of the mesh.

    Args:
        active: nodes of the tetrahedra around the blade, shape (a, 4).
        tables: of the stroke.

    Returns:
        Rows of the edges, and of the nodes, that change from PENDING to DONE.
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
    return np.array(edges, np.int64), np.array(nodes, np.int64)


@kernel
def pending(tables):
    """Return the number of crossings that are not in the mesh yet."""
    count = 0
    for row in range(tables.counts[EDGES]):
        count += tables.edge_state[row] == PENDING
    for row in range(tables.counts[NODES]):
        count += tables.node_state[row] == PENDING
    return count


@kernel
def ring_members(links, tables, edges):
    """Return the tetrahedra around some edges that have no parent yet.

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
    return np.array(found, np.int64)


@kernel
def adopt(links, tables, members):
    """Add tetrahedra to the state table, each as the only child of itself.

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


@inner
def outer_bits(links, tet):
    """Return bits of the faces on the original surface; bit f: the face opposite node f."""
    bits = 0
    for face in range(4):
        k = links.face_triangle[tet, face]
        if k >= 0 and links.triangle_kind[k] == OUTER:
            bits |= 1 << face
    return bits


@kernel
def outer_bits_of(links, tetrahedra):
    """Return the bits of several tetrahedra, shape (t,)."""
    bits = np.empty(len(tetrahedra), np.uint8)
    for k in range(len(tetrahedra)):
        bits[k] = outer_bits(links, tetrahedra[k])
    return bits


@kernel
def parents_concerned(links, tables, edges, nodes):
    """Return the rows of the parents of some new crossings, each once."""
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
    return np.array(found, np.int64)


@inner
def crossings_of(tables, parent):
    """Return bits of the cut edges and of the nodes on the cut of a parent, present and new."""
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


@kernel
def block(tables, parent, fresh):
    """Block the new crossings of a parent's edges; return their number."""
    count = 0
    base = tables.parent_nodes[parent]
    for pair in range(6):
        row = find_edge(tables, base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]])
        if row >= 0 and tables.edge_state[row] == DONE and (fresh == row).any():
            tables.edge_state[row] = BLOCKED
            count += 1
    return count


@inner
def _all_fresh(tables, node, fresh):
    """Return whether no edge of a node was cut in an earlier batch."""
    for row in range(tables.counts[EDGES]):
        a, b = tables.edge_nodes[row, 0], tables.edge_nodes[row, 1]
        if tables.edge_state[row] == DONE and node in (a, b) and not (fresh == row).any():
            return False
    return True


@kernel
def put_on_cut(tables, parent, fresh, positions):
    """Put ends of a parent's new crossings on the cut: the parent is too flat to be divided.

    Args:
        tables: of the stroke; the crossings of such a node wait.
        parent: row.
        fresh: rows of the edges that are new in the batch, shape (k,).
        positions: current nodes [m], shape (n, 3).

    Returns:
        Rows of these nodes, shape (j,).
    """
    found = [np.int64(0) for _ in range(0)]
    base = tables.parent_nodes[parent]
    for pair in range(6):
        edge = find_edge(tables, base[EDGE_NODES[pair, 0]], base[EDGE_NODES[pair, 1]])
        if edge < 0 or tables.edge_state[edge] != DONE or not (fresh == edge).any():
            continue
        share = tables.edge_share[edge]
        for end in (0, 1) if share <= 0.5 else (1, 0):
            node = tables.edge_nodes[edge, end]
            if not _all_fresh(tables, node, fresh):
                continue
            row = np.int64(tables.node_row[node])
            other = tables.edge_nodes[edge, 1 - end]
            part = share if end == 0 else 1.0 - share
            for i in range(3):
                tables.node_plane[row, i] = tables.edge_normal[edge, i]
                gap = positions[other, i] - positions[node, i]
                tables.node_plane[row, 3] -= part * gap * tables.edge_normal[edge, i]
            for k in range(tables.counts[EDGES]):
                # Also of an edge that the blade has not left yet: it ends on the cut now.
                crossed = tables.edge_state[k] == DONE or tables.edge_state[k] == PENDING
                if crossed and node in (tables.edge_nodes[k, 0], tables.edge_nodes[k, 1]):
                    tables.edge_state[k] = WAITS_PLUS
            tables.node_side[row], tables.node_state[row] = SNAPPED, DONE
            found.append(row)
            break
    return np.array(found, np.int64)


@inner
def _forget_child(tables, parent, tet):
    last = tables.child_count[parent] - 1
    for k in range(last + 1):
        if tables.children[parent, k] == tet:
            tables.children[parent, k] = tables.children[parent, last]
            tables.child_count[parent] = last
            return


@kernel
def settle(tables, count, removed, owners, labels):
    """Follow `TetMesh.apply`: tetrahedra are removed, the last one fills each gap, new ones are
    appended.

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
            for i in range(4):
                tables.label[tet, i] = tables.label[count, i]
            if owner >= 0:
                for k in range(tables.child_count[owner]):
                    if tables.children[owner, k] == count:
                        tables.children[owner, k] = tet
        tables.owner[count] = -1
    for k in range(len(owners)):
        owner = owners[k]
        tables.owner[count] = owner
        for i in range(4):
            tables.label[count, i] = labels[k, i]
        if owner >= 0:
            tables.children[owner, tables.child_count[owner]] = count
            tables.child_count[owner] += 1
        count += 1


@kernel
def settle_nodes(tables, count, orphans, copied):
    """Follow `TetMesh.apply`: nodes are appended, and the last one gets the number of each removed
    one.

    Args:
        tables: with room for the nodes to come.
        count: nodes before.
        orphans: nodes without a tetrahedron afterwards, largest first, shape (k,).
        copied: original of each new node, or -1, shape (a,).
    """
    for k in range(len(copied)):
        tables.origin[count + k] = origin_of(tables, copied[k]) if copied[k] >= 0 else -1
    count += len(copied)
    for node in orphans:
        count -= 1
        if node != count:
            tables.origin[node] = tables.origin[count]
        tables.origin[count] = -1
