"""State table and look-up tables of a stroke (thesis 5.3.4), as arrays for compiled kernels.

Edges and nodes are identified by the node numbers at the start of the stroke; later copies by the
number of their origin. Rows are only added, and all are dropped at the end of the stroke.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.subdivision_cases import MAX_CHILDREN
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown

MINUS, PLUS, SNAPPED = -1, 1, 2
"""Side of a node, or the node itself is on the cut."""
PENDING, DONE, BLOCKED = 1, 2, 3
"""State of a crossing: reached by the blade, in the mesh, or given up because of the altitude
floor."""
WAITS_PLUS, WAITS_MINUS = 4, 5
"""An edge crossed at a snapped node that is not on the cut yet; the side of its lower node."""
NODES, EDGES, PARENTS = 0, 1, 2


class Tables(NamedTuple):
    """Memory of a stroke between its steps; `counts` has the number of used rows.

    Attributes:
        counts: [nodes, edges, parents], shape (3,).
        node_row: row of a node in the look-up table of nodes, or -1, shape (n,).
        origin: original node of a copy, or -1, shape (n,).
        owner: row in the state table of the parent of a tetrahedron, or -1, shape (m,).
        label: corners of a child in terms of its parent, see `cases`, shape (m, 4).
        node_id: shape (a,).
        node_side: MINUS, PLUS or SNAPPED, shape (a,).
        node_state: of a snapped node: 0, PENDING or DONE, shape (a,).
        node_plane: normal of the swept surface and height of the node above it [m], shape (a, 4).
        node_near: length from a snapped node to the nearest crossing of its edges [m], shape (a,).
        rest_plane: the same surface in the rest shape: normal, height of the node above it [m],
            shape (a, 4).
        slide_to, slide: nodes and weights of where a snapped node slides to, shape (a, 4).
        hash_key, hash_row: open addressing, low << 32 | high to row, shape (power of two,).
        edge_nodes: low, high, shape (b, 2).
        edge_share: crossing of the blade, from low to high, shape (b,).
        edge_state: PENDING, DONE, BLOCKED, WAITS_PLUS or WAITS_MINUS, shape (b,).
        edge_normal: of the swept surface, shape (b, 3).
        parent_nodes: shape (c, 4).
        parent_outer: bits of the faces on the original surface, shape (c,).
        parent_state: state of `cases`, -1 while whole, shape (c,).
        parent_area: cut surface in it, one side [m^2], shape (c,).
        children, child_count: tetrahedra that it consists of, shape (c, 16), (c,).
    """

    counts: np.ndarray
    node_row: np.ndarray
    origin: np.ndarray
    owner: np.ndarray
    label: np.ndarray
    node_id: np.ndarray
    node_side: np.ndarray
    node_state: np.ndarray
    node_plane: np.ndarray
    node_near: np.ndarray
    rest_plane: np.ndarray
    slide_to: np.ndarray
    slide: np.ndarray
    hash_key: np.ndarray
    hash_row: np.ndarray
    edge_nodes: np.ndarray
    edge_share: np.ndarray
    edge_state: np.ndarray
    edge_normal: np.ndarray
    parent_nodes: np.ndarray
    parent_outer: np.ndarray
    parent_state: np.ndarray
    parent_area: np.ndarray
    children: np.ndarray
    child_count: np.ndarray


def empty_tables() -> Tables:
    """Return the tables of a stroke that has not begun."""
    return Tables(
        counts=np.zeros(3, np.int64),
        node_row=np.zeros(0, np.int32),
        origin=np.zeros(0, np.int32),
        owner=np.zeros(0, np.int32),
        label=np.zeros((0, 4), np.int8),
        node_id=np.zeros(64, np.int64),
        node_side=np.zeros(64, np.int8),
        node_state=np.zeros(64, np.int8),
        node_plane=np.zeros((64, 4)),
        node_near=np.zeros(64),
        rest_plane=np.zeros((64, 4)),
        slide_to=np.zeros((64, 4), np.int64),
        slide=np.zeros((64, 4)),
        hash_key=np.full(256, -1, np.int64),
        hash_row=np.zeros(256, np.int64),
        edge_nodes=np.zeros((64, 2), np.int64),
        edge_share=np.zeros(64),
        edge_state=np.zeros(64, np.int8),
        edge_normal=np.zeros((64, 3)),
        parent_nodes=np.zeros((64, 4), np.int64),
        parent_outer=np.zeros(64, np.uint8),
        parent_state=np.zeros(64, np.int16),
        parent_area=np.zeros(64),
        children=np.zeros((64, MAX_CHILDREN), np.int64),
        child_count=np.zeros(64, np.int8),
    )


def with_room(
    tables: Tables, *, mesh_nodes: int, tetrahedra: int, nodes: int, edges: int, parents: int
) -> Tables:
    """Return the tables with room for a mesh of that size and for some further rows."""
    a, b, c = (int(tables.counts[i]) + more for i, more in enumerate((nodes, edges, parents)))
    room: dict[str, np.ndarray] = {}
    for name in ('node_row', 'origin'):
        room[name] = grown(getattr(tables, name), mesh_nodes, fill=-1)
    room['owner'] = grown(tables.owner, tetrahedra, fill=-1)
    room['label'] = grown(tables.label, tetrahedra)
    for name in (
        'node_id',
        'node_side',
        'node_state',
        'node_plane',
        'node_near',
        'rest_plane',
        'slide_to',
        'slide',
    ):
        room[name] = grown(getattr(tables, name), a)
    for name in ('edge_nodes', 'edge_share', 'edge_state', 'edge_normal'):
        room[name] = grown(getattr(tables, name), b)
    for name in ('nodes', 'outer', 'state', 'area'):
        room['parent_' + name] = grown(getattr(tables, 'parent_' + name), c)
    for name in ('children', 'child_count'):
        room[name] = grown(getattr(tables, name), c)
    larger = tables._replace(**room)
    size = len(tables.hash_key)
    if 2 * b <= size:
        return larger
    while 2 * b > size:
        size *= 2
    larger = larger._replace(
        hash_key=np.full(size, -1, np.int64), hash_row=np.zeros(size, np.int64)
    )
    _rehash(larger)
    return larger


@kernel
def edge_key(a, b):
    """Return a number for an edge."""
    return min(a, b) << 32 | max(a, b)


# The most frequent kernels take arrays, not `Tables`: numba counts references for every array taken
# out of a tuple, which costs more than the computation.


@inner
def edge_slot(hash_key, key):
    """Return the slot of an edge in the table, used or free."""
    mask = len(hash_key) - 1
    slot = (int(key) * 0x9E3779B97F4A7C1 >> 17) & mask
    while hash_key[slot] != -1 and hash_key[slot] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
def _rehash(tables):
    for row in range(tables.counts[EDGES]):
        key = edge_key(tables.edge_nodes[row, 0], tables.edge_nodes[row, 1])
        slot = edge_slot(tables.hash_key, key)
        tables.hash_key[slot] = key
        tables.hash_row[slot] = row


@kernel
def find_edge(tables, a, b):
    """Return the row of an edge, or -1."""
    slot = edge_slot(tables.hash_key, edge_key(a, b))
    return tables.hash_row[slot] if tables.hash_key[slot] != -1 else -1


@inner
def add_edge(tables, a, b, share, normal, state):
    """Add an edge crossed by the blade at `share` of the path from a to b, in a state; return its
    row.
    """
    row = tables.counts[EDGES]
    tables.counts[EDGES] = row + 1
    key = edge_key(a, b)
    slot = edge_slot(tables.hash_key, key)
    tables.hash_key[slot] = key
    tables.hash_row[slot] = row
    tables.edge_nodes[row, 0] = min(a, b)
    tables.edge_nodes[row, 1] = max(a, b)
    tables.edge_share[row] = share if a < b else 1.0 - share
    tables.edge_state[row] = state
    for i in range(3):
        tables.edge_normal[row, i] = normal[i]
    return row


@inner
def add_node(tables, node, side):
    """Add a node with its side; return its row."""
    row = tables.counts[NODES]
    tables.counts[NODES] = row + 1
    tables.node_row[node] = row
    tables.node_id[row] = node
    tables.node_side[row] = side
    tables.node_state[row] = 0
    tables.node_near[row] = np.inf
    for i in range(4):
        tables.node_plane[row, i] = 0.0
        tables.rest_plane[row, i] = 0.0
    return row


@inner
def origin_of(tables, node):
    """Return the node's number at the start of the stroke, or that of its origin."""
    return np.int64(tables.origin[node]) if tables.origin[node] >= 0 else np.int64(node)


@inner
def side_of(tables, node):
    """Return MINUS, PLUS, SNAPPED, or 0 while unknown, of a node by its origin's number."""
    row = tables.node_row[node]
    return np.int64(tables.node_side[row]) if row >= 0 else np.int64(0)


@inner
def is_on_cut(node_row, node_side, node_state, node):
    """Return whether a node, by its origin's number, is snapped and its crossing is in the mesh."""
    row = node_row[node]
    return row >= 0 and node_side[row] == SNAPPED and node_state[row] == DONE


@inner
def on_cut(tables, node):
    """Return whether a node is snapped and its crossing is in the mesh, for `Tables`."""
    return is_on_cut(tables.node_row, tables.node_side, tables.node_state, node)


@inner
def on_cut_bits(corners, known, origin, node_row, node_side, node_state):
    """Return bits of the nodes on the cut; nodes from `known` on cannot be."""
    bits = 0
    for i in range(4):
        node = corners[i]
        if node < known:
            node = origin[node] if origin[node] >= 0 else node
            if is_on_cut(node_row, node_side, node_state, node):
                bits |= 1 << i
    return bits


@inner
def base_of(tetrahedra, origin, owner, parent_nodes, tet, out):
    """Write the nodes, by origin, of the parent of a tetrahedron, or of itself without one; shape
    (4,).
    """
    parent = owner[tet]
    for i in range(4):
        if parent >= 0:
            out[i] = parent_nodes[parent, i]
        else:
            node = tetrahedra[tet, i]
            out[i] = origin[node] if origin[node] >= 0 else node


@inner
def base_nodes(tables, links, tet, out):
    """Write the same from tables and links."""
    base_of(links.tetrahedra, tables.origin, tables.owner, tables.parent_nodes, tet, out)


@kernel
def clear(tables, first_new, node_count):
    """Clear all rows; nodes from `first_new` on were created by this stroke."""
    for row in range(tables.counts[NODES]):
        tables.node_row[tables.node_id[row]] = -1
    for node in range(first_new, min(node_count, len(tables.origin))):
        tables.origin[node] = -1
    for row in range(tables.counts[PARENTS]):
        for k in range(tables.child_count[row]):
            tables.owner[tables.children[row, k]] = -1
    tables.hash_key[:] = -1
    tables.counts[:] = 0
