"""Validation of tetrahedral meshes and measures of element quality."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.kernels import kernel

Nodes = NDArray[np.float64]
Tetrahedra = NDArray[np.int32]

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite to each corner, counter-clockwise from outside."""
EDGES = np.array(list(combinations(range(4), 2)))
MIN_SIZE, MAX_SIZE = 0.002, 2.0
"""[m] of the longest side of a tissue's bounding box."""
COINCIDENT = 1e-9
"""Distance below which two nodes coincide, relative to the mesh's size."""
FLAT = 1e-9
"""Six times the volume over the cube of the longest edge, below which an element is flat."""

_SOMEWHERE = np.array([0.51, 0.29, 0.81]) + np.sqrt([2, 3, 5]) / 100
"""A direction along which no two nodes of a regular mesh have the same coordinate."""

_log = logging.getLogger(__name__)


class Region(Protocol):
    """A part of space, boundary included."""

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points, shape (n, 3), lie in it, shape (n,)."""


@dataclass(frozen=True)
class Quality:
    """Quality measures of elements, each of shape (m,)."""

    altitude: NDArray[np.float64]
    """[m], the smallest of the four."""
    radius_ratio: NDArray[np.float64]
    """3 r / R of inscribed and circumscribed sphere: 1 for a regular element, 0 for a flat one."""
    dihedral: NDArray[np.float64]
    """[deg], the smallest of the six angles between faces."""


def check_mesh(nodes: Nodes, tetrahedra: Tetrahedra) -> Tetrahedra:
    """Check that a mesh is a conforming solid, and orient its elements.

    Elements of negative volume are inverted, with a warning; nothing else is repaired. Numbers in
    messages are indices of these arrays and count from 0.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: node indices, shape (m, 4).

    Returns:
        The tetrahedra, positively oriented, shape (m, 4).

    Raises:
        MeshError: one sentence with the element or node, and the remedy.
    """
    _check_arrays(nodes, tetrahedra)
    _check_elements(tetrahedra)
    _check_size(nodes)
    _check_nodes(nodes, tetrahedra)
    tetrahedra = _oriented(nodes, tetrahedra)
    pairs = _face_pairs(nodes, tetrahedra)
    _check_pinches(nodes, tetrahedra, pairs)
    return tetrahedra


def select_fixed(
    nodes: Nodes, tetrahedra: Tetrahedra, regions: Sequence[Region]
) -> NDArray[np.bool_]:
    """Return the nodes fixed by the regions; every connected part of the mesh must be held.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: node indices, shape (m, 4).
        regions: a node in any of them is fixed.

    Returns:
        shape (n,).

    Raises:
        MeshError: a region holds no node, a part of the mesh is not held, or no node can move.
    """
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    span = f'the mesh spans {_place(low)} to {_place(high)}'
    fixed = np.zeros(len(nodes), bool)
    for i, region in enumerate(regions):
        inside = region.contains(nodes)
        if not inside.any():
            raise MeshError(f'tissue.fixed.{i} holds no node: {span}; move or enlarge the region')
        fixed |= inside
    if fixed.all():
        raise MeshError(
            f'tissue.fixed holds all {len(nodes)} nodes: {span}; make the regions smaller'
        )
    ends = tetrahedra[:, EDGES].reshape(-1, 2)
    count, part = components(len(nodes), ends)
    held = np.zeros(count, bool)
    held[part[fixed]] = True
    if not held.all():
        loose = int(np.flatnonzero(~held[part])[0])
        raise MeshError(
            f'the mesh has {count} separate parts and no fixed node holds the one with node '
            f'{loose} at {_place(nodes[loose])}: add a region to tissue.fixed, or delete that part'
        )
    if count > 1:
        _log.warning('the mesh has %d parts that do not touch; each is held by fixed nodes', count)
    return fixed


def quality(nodes: Nodes, tetrahedra: Tetrahedra) -> Quality:
    """Compute the shape measures of every element.

    Args:
        nodes: [m], shape (n, 3).
        tetrahedra: positively oriented, shape (m, 4).
    """
    corners = nodes[tetrahedra]
    volumes = _six_volumes(nodes, tetrahedra) / 6
    a, b, c = (corners[:, FACES[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=2) / 2
    normals /= 2 * areas[:, :, None]
    cosines = -np.einsum('mek,mek->me', normals[:, EDGES[:, 0]], normals[:, EDGES[:, 1]])
    lengths = np.linalg.norm(corners[:, EDGES[:, 0]] - corners[:, EDGES[:, 1]], axis=2)
    # Products of opposite edges are the sides of a triangle whose area gives the circumradius.
    p, q, r = (lengths[:, i] * lengths[:, 5 - i] for i in range(3))
    squared_area = np.maximum((p + q + r) * (p + q - r) * (p - q + r) * (-p + q + r), 0)
    circumradius = np.sqrt(squared_area) / (24 * volumes)
    inradius = 3 * volumes / areas.sum(axis=1)
    return Quality(
        altitude=3 * volumes / areas.max(axis=1),
        radius_ratio=3 * inradius / circumradius,
        dihedral=np.degrees(np.arccos(np.clip(cosines, -1, 1))).min(axis=1),
    )


def _check_arrays(nodes: Nodes, tetrahedra: Tetrahedra) -> None:
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise MeshError(f'nodes have the shape {nodes.shape}: it must be (n, 3)')
    if tetrahedra.ndim != 2 or tetrahedra.shape[1] != 4 or not len(tetrahedra):
        raise MeshError(f'tetrahedra have the shape {tetrahedra.shape}: it must be (m, 4), m >= 1')
    bad = _first(~np.isfinite(nodes).all(axis=1))
    if bad is not None:
        raise MeshError(
            f'node {bad} lies at {_place(nodes[bad])}: coordinates must be finite, export the mesh '
            'again'
        )
    bad = _first(((tetrahedra < 0) | (tetrahedra >= len(nodes))).any(axis=1))
    if bad is not None:
        raise MeshError(
            f'{_element(bad, tetrahedra)}, but there are only the nodes 0 to {len(nodes) - 1}: '
            'export the mesh again'
        )


def _check_elements(tetrahedra: Tetrahedra) -> None:
    ordered = np.sort(tetrahedra, axis=1)
    bad = _first((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if bad is not None:
        raise MeshError(f'{_element(bad, tetrahedra)}, one of them twice: delete the element')
    _, first, group = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    originals = first[group.ravel()]
    bad = _first(originals != np.arange(len(tetrahedra)))
    if bad is not None:
        raise MeshError(
            f'{_element(bad, tetrahedra)}, the same as tetrahedron {originals[bad]}: delete one'
        )


def _check_size(nodes: Nodes) -> None:
    size = float(np.ptp(nodes, axis=0).max())
    if size > MAX_SIZE:
        unit, shrunk = ('mm', size / 1000) if size >= 10 else ('cm', size / 100)
        hint = f'if the file is in {unit} (then {shrunk:.3g} m), set tissue.unit: {unit}'
    elif size < MIN_SIZE:
        hint = 'if the file is in metres, set tissue.unit: m; if in centimetres, cm'
    else:
        return
    raise MeshError(
        f'the mesh is {size:.3g} m long, but a tissue is {MIN_SIZE:g} to {MAX_SIZE:g} m: {hint}'
    )


def _check_nodes(nodes: Nodes, tetrahedra: Tetrahedra) -> None:
    unused = np.ones(len(nodes), bool)
    unused[tetrahedra] = False
    bad = _first(unused)
    if bad is not None:
        raise MeshError(
            f'node {bad} at {_place(nodes[bad])} is in no tetrahedron ({unused.sum()} in all): '
            'delete it'
        )
    near = COINCIDENT * float(np.ptp(nodes, axis=0).max())
    pairs = _coincident(nodes, near)
    if len(pairs):
        a, b = pairs[np.lexsort(pairs.T[::-1])[0]]
        raise MeshError(
            f'nodes {a} and {b} coincide at {_place(nodes[a])} ({len(pairs)} pairs in all): merge '
            'duplicate nodes in the mesher (Gmsh: "Coherence Mesh")'
        )


def _coincident(nodes: Nodes, near: float) -> NDArray[np.intp]:
    """Return pairs of nodes within a distance `near` [m], shape (p, 2); some of them, if there are
    very many.

    Such nodes are close along any direction, and along most directions few others are.
    """
    along = nodes @ (_SOMEWHERE / np.linalg.norm(_SOMEWHERE))
    order = np.argsort(along)
    along, found = along[order], [np.zeros((0, 2), np.intp)]
    for apart in range(1, len(nodes)):
        close = np.flatnonzero(along[apart:] - along[:-apart] <= near)
        if not len(close) or sum(map(len, found)) > len(nodes):
            break
        pairs = np.sort(np.column_stack((order[close], order[close + apart])), axis=1)
        distances = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
        found.append(pairs[distances <= near])
    return np.concatenate(found)


def _oriented(nodes: Nodes, tetrahedra: Tetrahedra) -> Tetrahedra:
    volumes = _six_volumes(nodes, tetrahedra)
    corners = nodes[tetrahedra]
    longest = np.linalg.norm(corners[:, EDGES[:, 0]] - corners[:, EDGES[:, 1]], axis=2).max(axis=1)
    flatness = np.abs(volumes) / longest**3
    worst = int(flatness.argmin())
    if flatness[worst] < FLAT:
        raise MeshError(
            f'{_element(worst, tetrahedra)}, its volume is {volumes[worst] / 6:.3g} m^3 at an edge '
            f'of {longest[worst]:.3g} m near {_place(corners[worst].mean(axis=0))}: it is flat; '
            'optimise the mesh or delete the element'
        )
    inverted = volumes < 0
    if inverted.any():
        _log.warning('%d of %d tetrahedra were turned over', inverted.sum(), len(tetrahedra))
        tetrahedra = tetrahedra.copy()
        tetrahedra[inverted] = tetrahedra[inverted][:, [0, 1, 3, 2]]
    return tetrahedra


def _face_pairs(nodes: Nodes, tetrahedra: Tetrahedra) -> NDArray[np.intp]:
    """Return pairs of items 4 * element + corner with the same opposite face, shape (p, 2)."""
    faces = tetrahedra[:, FACES].reshape(-1, 3)
    ordered = np.sort(faces, axis=1)
    order = np.lexsort(ordered.T[::-1])
    same = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    triple = _first(same[1:] & same[:-1])
    if triple is not None:
        owners = (order[triple : triple + 3] // 4).tolist()
        face = ordered[order[triple]]
        raise MeshError(
            f'the face of the nodes {face.tolist()} near {_place(nodes[face].mean(axis=0))} '
            f'belongs to more than two tetrahedra, {owners}: elements overlap; mesh the solid again'
        )
    pairs = np.column_stack((order[:-1][same], order[1:][same]))
    # Seen from the two sides of a face, its corners run in opposite directions.
    first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
    turns = np.stack([(first == np.roll(second, k, axis=1)).all(axis=1) for k in range(3)])
    bad = _first(turns.any(axis=0))
    if bad is not None:
        face = first[bad]
        raise MeshError(
            f'tetrahedra {pairs[bad, 0] // 4} and {pairs[bad, 1] // 4} lie on the same side of '
            f'their common face {face.tolist()} near {_place(nodes[face].mean(axis=0))}: one is '
            'folded into the other; mesh the solid again'
        )
    return pairs


def _check_pinches(nodes: Nodes, tetrahedra: Tetrahedra, pairs: NDArray[np.intp]) -> None:
    """Refuse nodes and edges whose tetrahedra are not connected by faces."""
    element, corner = np.divmod(pairs, 4)
    count = len(tetrahedra)
    shared = np.sort(tetrahedra[element[:, 0]][np.arange(len(pairs))[:, None], FACES[corner[:, 0]]])
    for size, name in ((1, 'node'), (2, 'edge')):
        # One item by element and corner (or edge) of it; items are linked across interior faces.
        subsets = np.array(list(combinations(range(4), size)))
        keys = np.sort(tetrahedra[:, subsets], axis=2)
        links = []
        for part in combinations(range(3), size):
            wanted = shared[:, None, list(part)]
            links.append(
                np.column_stack(
                    [
                        element[:, s] * len(subsets)
                        + (keys[element[:, s]] == wanted).all(axis=2).argmax(axis=1)
                        for s in (0, 1)
                    ]
                )
            )
        _, star = components(count * len(subsets), np.concatenate(links))
        _, first_of_star = np.unique(star, return_index=True)
        simplices = keys.reshape(-1, size)[first_of_star]
        found, stars = np.unique(simplices, axis=0, return_counts=True)
        bad = _first(stars > 1)
        if bad is not None:
            members = found[bad].tolist()
            which = f'node {members[0]}' if size == 1 else f'the edge of the nodes {members}'
            raise MeshError(
                f'{which} at {_place(nodes[found[bad]].mean(axis=0))} joins {stars[bad]} parts of '
                f'the solid that share no face there ({(stars > 1).sum()} {name}s in all): '
                'give each part its own nodes, or fill the gap'
            )


def components(count: int, links: NDArray[np.integer]) -> tuple[int, NDArray[np.int64]]:
    """Return the number of connected parts of some items by their links, shape (k, 2), and the part
    of each, shape (n,).
    """
    label = np.empty(count, np.int64)
    return _join(np.ascontiguousarray(links, np.int64), label), label


@kernel
def _join(links: NDArray[np.int64], label: NDArray[np.int64]) -> int:
    """Return the part of each item, in the order of the parts' first items.

    Source: R. E. Tarjan and J. van Leeuwen, J. ACM 31 (1984): union, with paths halved.
    """
    for i in range(len(label)):
        label[i] = i
    for k in range(len(links)):
        a, b = links[k, 0], links[k, 1]
        while label[a] != a:
            label[a] = label[label[a]]
            a = label[a]
        while label[b] != b:
            label[b] = label[label[b]]
            b = label[b]
        label[max(a, b)] = min(a, b)
    # A part's first item is its root: it is numbered before all others.
    parts = 0
    for i in range(len(label)):
        if label[i] == i:
            label[i] = parts
            parts += 1
        else:
            label[i] = label[label[i]]
    return parts


def _six_volumes(nodes: Nodes, tetrahedra: Tetrahedra) -> NDArray[np.float64]:
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    return np.asarray(np.einsum('mk,mk->m', np.cross(b - a, c - a), d - a))


def _first(mask: Any) -> int | None:
    return int(mask.argmax()) if mask.any() else None


def _element(index: int, tetrahedra: Tetrahedra) -> str:
    return f'tetrahedron {index} has the nodes {tetrahedra[index].tolist()}'


def _place(point: NDArray[np.float64]) -> str:
    return '(' + ', '.join(f'{x:.4g}' for x in point) + ') m'
