"""Bounds checks of the untrusted tables of a stroke."""

from typing import Any

import numpy as np

from cutting_trainer.cutting.lookup import EDGES, NODES, PARENTS
from cutting_trainer.cutting.subdivision_cases import INSIDE, MAX_CHILDREN, NAMES
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.serialisation import StateError
from cutting_trainer.tissue_sim.simulation.state_checks import has_room, within


def check_combined(method: Any, mesh: TetMesh) -> None:
    """Refuse the state of a method whose kernels would leave its arrays.

    Args:
        method: the combined method, rebuilt.
        mesh: its mesh, checked.

    Raises:
        StateError: the first error.
    """
    t, n, m = method._tables, mesh.node_count, len(mesh.tetrahedra)
    has_room('counts', t.counts, 3)
    within('the counts of the tables', t.counts, 1 << 31)
    a, b, c = (int(t.counts[i]) for i in (NODES, EDGES, PARENTS))
    for name, rows, *columns in (
        ('node_id', a),
        ('node_side', a),
        ('node_state', a),
        ('node_plane', a, 4),
        ('node_near', a),
        ('rest_plane', a, 4),
        ('slide_to', a, 4),
        ('slide', a, 4),
        ('edge_nodes', b, 2),
        ('edge_share', b),
        ('edge_state', b),
        ('edge_normal', b, 3),
        ('parent_nodes', c, 4),
        ('parent_outer', c),
        ('parent_state', c),
        ('parent_area', c),
        ('children', c, MAX_CHILDREN),
        ('child_count', c),
        ('label', len(t.owner), 4),
        ('origin', len(t.node_row)),
        ('hash_row', len(t.hash_key)),
    ):
        has_room(name, getattr(t, name), rows, *columns)
    for name, numbers, limit, least in (
        ('node_row', t.node_row, a, -1),
        ('origin', t.origin[:n], n, -1),
        ('owner', t.owner[:m], c, -1),
        ('label', t.label, INSIDE + 1, 0),
        ('node_id', t.node_id[:a], n, 0),
        ('slide_to', t.slide_to[:a], n, 0),
        ('edge_nodes', t.edge_nodes[:b], n, 0),
        ('parent_nodes', t.parent_nodes[:c], n, 0),
        ('parent_state', t.parent_state[:c], len(NAMES), -1),
        ('child_count', t.child_count[:c], MAX_CHILDREN + 1, 0),
        ('hash_row', t.hash_row[t.hash_key != -1], b, 0),
        ('_active', method._active, n, 0),
        ('_first_new', [method._first_new], n + 1, 0),
    ):
        within(name, numbers, limit, least)
    listed = np.arange(MAX_CHILDREN) < t.child_count[:c, None]
    within('children', t.children[:c][listed], m)
    has_room('_active', method._active, 0, 4)
    has_room('_direction', method._direction, 3)
    has_room('_last', method._last, 4, 3)
    has_room('_lines', method._lines, 0, 2, 3)
    for strip in method._strips:
        has_room('_strips', strip, 2, 2, 3)
    size = len(t.hash_key)
    if size < 2 or size & (size - 1) or not (t.hash_key == -1).any():
        raise StateError('hash_key is no table with room')
    for corners in method._queue:
        has_room('_queue', corners, 4, 3)
