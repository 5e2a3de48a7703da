"""Build a batch: crossings that the blade has left become a change of connectivity."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cutting_trainer.cutting.fragments import small_pieces
from cutting_trainer.cutting.lookup import (
    BLOCKED,
    DONE,
    EDGES,
    PENDING,
    Tables,
    edge_key,
    find_edge,
    with_room,
)
from cutting_trainer.cutting.method_interface import CASES, CutReport
from cutting_trainer.cutting.node_splitting import (
    Patch,
    cut_area,
    lay_patch,
    nodes_concerned,
    split_nodes,
)
from cutting_trainer.cutting.sliding import slides
from cutting_trainer.cutting.snapping import SnapLimits
from cutting_trainer.cutting.state_table import (
    adopt,
    block,
    non_active_crossings,
    outer_bits_of,
    parents_concerned,
    put_on_cut,
    ring_members,
    settle,
    settle_nodes,
)
from cutting_trainer.cutting.subdivision import Pieces, spoiled, subdivide
from cutting_trainer.cutting.subdivision_cases import NAMES
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta

_CASE_OF_STATE = np.array([CASES.index(name) for name in NAMES])
_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_SMALL_SHARE = 0.25
"""Smallest share of an edge between a new node and an end, where elements would be too flat."""


class CutStateError(ValueError):
    """A state that is in no table; the mesh is unchanged."""


@dataclass(frozen=True)
class Scheme:
    """Parameters of a method of the family.

    Attributes:
        tau: a crossing nearer to a node than this share of its edge is snapped to the node.
        off: how far from the swept surface a node on the cut may stay that cannot slide onto it,
            and
        shape: largest distance of a sliding node from the surface of the tissue, as a share of the
            median altitude at the start.
        thin: a node stays on the cut where leaving it off would make an element flatter than this
            share.
        floor: smallest altitude of a new element, as a share of the median altitude at the start.
        true_points: new nodes lie at the true crossings; else at midpoints and centroids.
        slides: snapped nodes slide onto the swept surface.
        subdivides: elements are divided.
        least_share: smallest distance of new nodes from the ends of an edge, as a share of the
            edge.
        leads_on: the cut is led on beyond the blade, as the front ends short of it, and strokes are
            joined.
    """

    tau: float = 0.33
    off: float = 0.2
    thin: float = 0.06
    shape: float = 0.1
    floor: float = 0.02
    true_points: bool = True
    slides: bool = True
    subdivides: bool = True
    least_share: float = 0.1
    leads_on: bool = False


class Batch(NamedTuple):
    """A change of connectivity to be applied, with the resulting tables and numbers of nodes and
    tetrahedra.
    """

    tables: Tables
    delta: TopologyDelta
    report: CutReport
    size: tuple[int, int]


class _Moves(NamedTuple):
    """Sliding nodes: rows in the look-up table, shape (j,), and rest positions [m], shape (j,
    3).
    """

    rows: np.ndarray
    where: np.ndarray


def build_batch(
    mesh: TetMesh,
    positions: np.ndarray,
    tables: Tables,
    active: np.ndarray,
    scheme: Scheme,
    limits: SnapLimits,
) -> Batch:
    """Build the batch of all crossings that the blade has left.

    Args:
        mesh: the tissue.
        positions: current nodes [m], shape (n, 3).
        tables: of the stroke; updated as if the batch were applied.
        active: nodes of the tetrahedra around the blade, shape (a, 4).
        scheme: of the method.
        limits: of the mesh.

    Raises:
        CutStateError: an element has a state that is in no table, or would be inverted.
    """
    links = mesh.links
    edges, nodes = non_active_crossings(active, tables)
    if not len(edges) and not len(nodes):
        size = (mesh.node_count, len(mesh.tetrahedra))
        return Batch(tables, TopologyDelta(), CutReport(), size)
    _pull(tables, edges, scheme.least_share if scheme.true_points else 0.5)
    members = ring_members(links, tables, edges)
    m = len(mesh.tetrahedra)
    tables = with_room(
        tables, mesh_nodes=mesh.node_count, tetrahedra=m, nodes=0, edges=0, parents=len(members)
    )
    adopt(links, tables, members)
    pieces, moves, worst, nodes, parents = _sound_pieces(
        mesh, positions, tables, edges, nodes, scheme, limits
    )
    return _assemble(mesh, positions, tables, edges, nodes, parents, pieces, moves, worst)


def _sound_pieces(
    mesh: TetMesh,
    positions: np.ndarray,
    tables: Tables,
    edges: np.ndarray,
    nodes: np.ndarray,
    scheme: Scheme,
    limits: SnapLimits,
) -> tuple[Pieces, _Moves, float, np.ndarray, np.ndarray]:
    """Divide the parents; below the altitude floor with new nodes farther from the ends of edges,
    then at midpoints, then later, with the crossings that are to come, then at nodes, and otherwise
    not at all. Return also the nodes on the cut, and the parents.
    """
    parents = parents_concerned(mesh.links, tables, edges, nodes)
    front = scheme.tau if scheme.true_points else 0.5
    plain = np.zeros(0, np.int64)
    sliding = nodes if scheme.slides else nodes[:0]
    moves = _Moves(*slides(sliding, mesh.links, tables, mesh.rest, mesh.fixed, limits))
    crossings = tables.edge_share[edges]
    while True:
        pieces, unknown = subdivide(parents, mesh.links, tables, positions, mesh.rest, front, plain)
        if unknown >= 0:
            raise CutStateError(
                f'the tetrahedron with nodes {tables.parent_nodes[unknown].tolist()} is crossed '
                'in a way that is none of the cases A to H; abort the stroke'
            )
        bad, worst = spoiled(pieces, tables, mesh.rest, moves.rows, moves.where, limits.floor)
        if len(bad) == 0:
            break
        cut = _cut_edges(tables, bad)
        new = np.intersect1d(cut, edges)
        if _pull(tables, new, _SMALL_SHARE):
            continue
        pulled = _pull(tables, new, 0.5)
        centred = np.union1d(plain, [edge_key(*ends) for ends in tables.edge_nodes[cut].tolist()])
        stay = np.isin(tables.node_id[sliding], tables.parent_nodes[bad])
        if pulled or stay.any() or len(centred) > len(plain):
            plain = centred.astype(np.int64)
            sliding = np.ascontiguousarray(sliding[~stay])
            moves = _Moves(*slides(sliding, mesh.links, tables, mesh.rest, mesh.fixed, limits))
            continue
        if not _leave_for_later(tables, bad, edges, crossings):
            more = [put_on_cut(tables, int(parent), edges, positions) for parent in bad]
            nodes = np.concatenate([nodes, *more])
            if not sum(map(len, more)) and not sum(block(tables, int(p), edges) for p in bad):
                break
        # Also those around the nodes that were put on the cut just now.
        parents = parents_concerned(mesh.links, tables, edges, nodes)
    if len(pieces.corners) and worst <= 0.0:
        raise CutStateError('an element would be inverted; abort the stroke')
    return pieces, moves, float(worst), nodes, parents


def _cut_edges(tables: Tables, parents: np.ndarray) -> np.ndarray:
    """Return the rows of the edges of some parents that are cut."""
    rows = []
    for base in tables.parent_nodes[parents].tolist():
        found = (find_edge(tables, base[i], base[j]) for i, j in _PAIRS)
        rows += [row for row in found if row >= 0 and tables.edge_state[row] == DONE]
    return np.array(rows, np.int64)


def _pull(tables: Tables, edges: np.ndarray, least: float) -> bool:
    """Put new nodes no nearer to an end than a share of their edge; return whether any moved."""
    before = tables.edge_share[edges]
    tables.edge_share[edges] = np.clip(before, least, 1.0 - least)
    return bool((tables.edge_share[edges] != before).any())


def _leave_for_later(
    tables: Tables, parents: np.ndarray, edges: np.ndarray, crossings: np.ndarray
) -> bool:
    """Leave new crossings to a later batch where others of the same parent are still to come.

    Args:
        tables: of the stroke; changed.
        parents: rows.
        edges: rows of the edges that are new in the batch, shape (k,).
        crossings: where they are crossed, as shares, shape (k,).

    Returns:
        Whether there are any.
    """
    found = False
    for base in tables.parent_nodes[parents].tolist():
        rows = np.array([find_edge(tables, base[i], base[j]) for i, j in _PAIRS])
        states = np.where(rows >= 0, tables.edge_state[rows], 0)
        new = np.isin(edges, rows[states == DONE])
        if (states == PENDING).any() and new.any():
            tables.edge_state[edges[new]] = PENDING
            tables.edge_share[edges[new]] = crossings[new]
            found = True
    return found


def _assemble(
    mesh: TetMesh,
    positions: np.ndarray,
    tables: Tables,
    edges: np.ndarray,
    nodes: np.ndarray,
    parents: np.ndarray,
    pieces: Pieces,
    moves: _Moves,
    worst: float,
) -> Batch:
    """Duplicate nodes, write the delta, and update the tables."""
    n, m = mesh.node_count, len(mesh.tetrahedra)
    concerned = nodes_concerned(pieces, mesh.links, tables, positions, nodes, n)
    patch = lay_patch(pieces, concerned, mesh.links, tables, positions, n)
    before = patch.corners.copy()
    copies = split_nodes(patch, concerned, mesh.rest, pieces.new_rest)
    area, separated = cut_area(
        patch, pieces, tables, before, mesh.rest, pieces.new_rest, moves.rows, moves.where
    )
    changed = np.flatnonzero((patch.tetrahedra >= 0) & (patch.corners != before).any(axis=1))
    stayed = patch.tetrahedra[changed]
    removed = np.sort(np.concatenate([pieces.removed, stayed]))[::-1]
    delta = _delta(mesh, tables, patch, pieces, copies, moves, changed, removed)
    owners = np.concatenate([pieces.owners, tables.owner[stayed]]).astype(np.int64)
    labels = np.concatenate([pieces.labels, tables.label[stayed]])
    copied = np.concatenate([np.full(len(pieces.new_rest), -1), copies]).astype(np.int64)
    copied[copied >= n] = -1
    tables = with_room(
        tables,
        mesh_nodes=n + len(copied),
        tetrahedra=m + len(owners),
        nodes=0,
        edges=0,
        parents=0,
    )
    settle(tables, m, np.ascontiguousarray(removed), owners, labels)
    settle_nodes(tables, n, np.sort(pieces.orphans)[::-1].copy(), copied)
    tables.node_plane[moves.rows, 3] = 0.0
    cases = _count_cases(tables, parents, pieces.states, separated)
    report = CutReport(
        cases=cases,
        area=float(area),
        worst_altitude=worst if len(pieces.corners) else 0.0,
        warnings=_warnings(mesh, tables, edges, small_pieces(patch, pieces, mesh.links)),
    )
    size = (n + len(copied) - len(pieces.orphans), m + len(owners) - len(removed))
    return Batch(tables, delta, report, size)


def _warnings(
    mesh: TetMesh, tables: Tables, edges: np.ndarray, sizes: np.ndarray
) -> tuple[str, ...]:
    free = [f'a piece of {size} tetrahedra has come free' for size in sizes.tolist()]
    blocked = edges[tables.edge_state[edges] == BLOCKED]
    if len(blocked):
        x, y, z = 1e3 * mesh.rest[tables.edge_nodes[blocked[0]]].mean(axis=0)
        free.append(
            f'{len(blocked)} edges were too small to divide: the tissue stays connected there, '
            f'at ({x:.1f}, {y:.1f}, {z:.1f}) mm at rest'
        )
    return tuple(free)


def _delta(
    mesh: TetMesh,
    tables: Tables,
    patch: Patch,
    pieces: Pieces,
    copies: np.ndarray,
    moves: _Moves,
    changed: np.ndarray,
    removed: np.ndarray,
) -> TopologyDelta:
    n = mesh.node_count
    moved = tables.node_id[moves.rows]
    where_parents, where_weights = tables.slide_to[moves.rows], tables.slide[moves.rows]
    copy_parents = np.repeat(copies[:, None], 4, axis=1)
    copy_weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(copies), 1))
    new = copies >= n
    copy_parents[new] = pieces.new_parents[copies[new] - n]
    copy_weights[new] = pieces.new_weights[copies[new] - n]
    row, slid = np.nonzero(copies[:, None] == moved)
    copy_parents[row], copy_weights[row] = where_parents[slid], where_weights[slid]
    count = len(pieces.corners)
    stayed = patch.tetrahedra[changed]
    outer = outer_bits_of(mesh.links, stayed)
    return TopologyDelta(
        node_parents=np.concatenate([pieces.new_parents, copy_parents]),
        node_weights=np.concatenate([pieces.new_weights, copy_weights]),
        moved_nodes=moved,
        moved_parents=where_parents,
        moved_weights=where_weights,
        removed_tetrahedra=removed,
        tetrahedra=np.concatenate([patch.corners[:count], patch.corners[changed]]),
        outer_faces=np.concatenate([pieces.outer, outer]),
        regions=mesh.regions_at(np.concatenate([tables.children[pieces.owners, 0], stayed])),
    )


def _count_cases(
    tables: Tables, parents: np.ndarray, states: np.ndarray, separated: int
) -> np.ndarray:
    cases = np.zeros(len(CASES), np.int64)
    new = (states >= 0) & (states != tables.parent_state[parents])
    np.add.at(cases, _CASE_OF_STATE[states[new]], 1)
    tables.parent_state[parents] = states
    cases[CASES.index('separated')] = separated
    return cases


def give_up_edges(tables: Tables) -> None:
    """Block all pending crossings of edges: only nodes are cut."""
    states = tables.edge_state[: tables.counts[EDGES]]
    states[states == PENDING] = BLOCKED
