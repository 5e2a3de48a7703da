"""Strains averaged over the nodes: what cures linear tetrahedra of locking.

Smoothed finite elements over nodes (Liu et al. 2009): the domain of a node is a quarter of each of
its elements, and its displacement gradient their mean by volume,

    H_i = sum_j u_j G_ij^T,    G_ij = sum over elements t of i and j of V_t g_tj / sum of V_t.

Row i needs the star of node i only, so a cut recomputes the rows of the nodes it touched, and a
domain ends at the lips of a cut. The forces V_i P_i G_ij go out over the same row, while it is in
cache.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from tissue_sim.mesh import TetMesh, grown
from tissue_sim.rotation import (
    ENERGY,
    LANES,
    ORDERED_MATH,
    ROTATION,
    SHEAR,
    SLOTS,
    VOLUMETRIC,
    settle,
    stress,
    turn,
)
from tissue_sim.simd import (
    add_three,
    load_four,
    plus_product,
    prefetch,
    product,
    spread,
    three,
    unpack,
)
from tissue_sim.tensor_mass import longer, move_row, packed, shape_gradients


class Domains(NamedTuple):
    """Rows of the averaged gradients; row i of a node spans `start[i]` to `start[i] + used[i]`.

    Attributes:
        start, used, room: first slot, used slots and slots of each row, shape (n,).
        columns: three times the node j of each entry, shape (c,). The node itself is among them
            at the surface only: in the interior G_ii is 0.
        vectors: G_ij [1/m]; some beyond the last row, as three are read as four, shape (3 c,).
        volume: of the domains [m^3], shape (n,).
        rotation: quaternions, shape (n, 4).
        lame: lambda and mu [Pa], shape (2,).
    """

    start: np.ndarray
    used: np.ndarray
    room: np.ndarray
    columns: np.ndarray
    vectors: np.ndarray
    volume: np.ndarray
    rotation: np.ndarray
    lame: np.ndarray


@njit(cache=True)
def _on_surface(links, node):
    corner = links.first_corner[node]
    while corner >= 0:
        for local in range(4):
            if local != corner % 4 and links.face_triangle[corner // 4, local] >= 0:
                return True
        corner = links.corner_next[corner]
    return False


@njit(cache=True)
def gather_domains(domains, filled, links, rest, nodes):
    """Computes the rows of some nodes from their stars; their rotations begin at none.

    Args:
        domains: written for `nodes` only.
        filled: slots that are given to rows; grows with rows that move, shape (1,).
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        nodes: which rows, shape (r,).

    Returns:
        Index into `nodes` of the first for whose row the arrays are too short, or -1.
    """
    g = np.empty((4, 3))
    for which in range(len(nodes)):
        node = nodes[which]
        first = domains.start[node]
        used = 0
        total = 0.0
        outside = _on_surface(links, node)
        corner = links.first_corner[node]
        while corner >= 0:
            tet = corner // 4
            volume = shape_gradients(rest, links.tetrahedra, tet, g)
            total += volume
            for b in range(4):
                if b == corner % 4 and not outside:
                    continue
                column = 3 * links.tetrahedra[tet, b]
                slot = first
                while slot < first + used and domains.columns[slot] != column:
                    slot += 1
                if slot == first + used:
                    if used == domains.room[node]:
                        d = domains
                        d.used[node] = used
                        if not move_row(
                            d.start, d.used, d.room, d.columns, d.vectors, filled, node
                        ):
                            return which
                        first = d.start[node]
                        slot = first + used
                    used += 1
                    domains.columns[slot] = column
                    for i in range(3):
                        domains.vectors[3 * slot + i] = 0.0
                for i in range(3):
                    domains.vectors[3 * slot + i] += volume * g[b, i]
            corner = links.corner_next[corner]
        domains.used[node] = used
        domains.volume[node] = 0.25 * total
        for slot in range(3 * first, 3 * (first + used)):
            domains.vectors[slot] /= total
        domains.rotation[node] = 0.0
        domains.rotation[node, 0] = 1.0
    return -1


_U1, _U2, _U3 = (np.uint64(i) for i in (1, 2, 3))
_AHEAD, _LINE = np.uint64(3 * 384), np.uint64(8)
"""Numbers by which vectors are asked of memory beforehand, and how many come at once."""


@njit(cache=True, fastmath=ORDERED_MATH, error_model='numpy')
def _gradient(domains, u, i):
    """Rows of the averaged displacement gradient of a node."""
    hx = hy = hz = spread(0.0)
    first = np.uint64(domains.start[i])
    for k in range(first, first + np.uint64(domains.used[i])):
        j = np.uint64(domains.columns[k])
        vector = load_four(domains.vectors, _U3 * np.uint64(k))  # and the first of the next
        hx = plus_product(hx, spread(u[j]), vector)
        hy = plus_product(hy, spread(u[j + _U1]), vector)
        hz = plus_product(hz, spread(u[j + _U2]), vector)
    return unpack(hx), unpack(hy), unpack(hz)


@njit(cache=True, fastmath=ORDERED_MATH, error_model='numpy')
def _add_forces(domains, i, px, py, pz, f):
    """Adds the forces V P G_ij over the row of a node, P given by its columns."""
    vectors = domains.vectors
    first = np.uint64(domains.start[i])
    for k in range(first, first + np.uint64(domains.used[i])):
        q = _U3 * np.uint64(k)
        force = plus_product(product(px, spread(vectors[q])), py, spread(vectors[q + _U1]))
        force = plus_product(force, pz, spread(vectors[q + _U2]))
        add_three(f, np.uint64(domains.columns[k]), force)


@njit(cache=True, fastmath=ORDERED_MATH, error_model='numpy')
def _average(domains, u, i, lane, chunk, unit):
    """Puts the averaged gradient of a node in a lane."""
    L = LANES
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _gradient(domains, u, i)
    chunk[lane], chunk[lane + L], chunk[lane + 2 * L] = unit + xx, xy, xz
    chunk[lane + 3 * L], chunk[lane + 4 * L], chunk[lane + 5 * L] = yx, unit + yy, yz
    chunk[lane + 6 * L], chunk[lane + 7 * L], chunk[lane + 8 * L] = zx, zy, unit + zz
    chunk[lane + SHEAR * L] = 2.0 * domains.lame[1] * domains.volume[i]
    chunk[lane + VOLUMETRIC * L] = domains.lame[0] * domains.volume[i]
    for k in range(4):
        chunk[lane + (ROTATION + k) * L] = domains.rotation[i, k]


@njit(cache=True, fastmath=ORDERED_MATH, error_model='numpy')
def _distribute(domains, i, lane, chunk, f):
    """Adds the forces V P G_ij of a lane over the row of a node."""
    L = LANES
    px = three(chunk[lane], chunk[lane + 3 * L], chunk[lane + 6 * L])
    py = three(chunk[lane + L], chunk[lane + 4 * L], chunk[lane + 7 * L])
    pz = three(chunk[lane + 2 * L], chunk[lane + 5 * L], chunk[lane + 8 * L])
    _add_forces(domains, i, px, py, pz, f)


@njit(cache=True, fastmath=ORDERED_MATH, error_model='numpy')
def add_still_domains(domains, awake, u, f):
    """Adds the forces of domains that do not turn: linear in u.

    Args:
        domains: the rows.
        awake: intervals of nodes whose domains count, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
    """
    for s in range(awake.shape[0]):
        for i in range(awake[s, 0], min(domains.used.shape[0], awake[s, 1])):
            here = _U3 * np.uint64(domains.start[i])
            for q in range(here, here + _U3 * np.uint64(domains.used[i]), _LINE):
                prefetch(domains.vectors, q + _AHEAD)
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _gradient(domains, u, i)
            shear = domains.lame[1] * domains.volume[i]
            pressure = domains.lame[0] * domains.volume[i] * (xx + yy + zz)
            xx, yy = 2.0 * shear * xx + pressure, 2.0 * shear * yy + pressure
            zz = 2.0 * shear * zz + pressure
            xy, xz, yz = shear * (xy + yx), shear * (xz + zx), shear * (yz + zy)
            columns = three(xx, xy, xz), three(xy, yy, yz), three(xz, yz, zz)
            _add_forces(domains, i, *columns, f)


@njit(cache=True, error_model='numpy')
def add_domains(domains, awake, u, f, turns, unit):
    """Adds the forces of the domains.

    Args:
        domains: the rows; their rotations follow u by `turns` steps.
        awake: intervals of nodes whose domains count, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
        turns: steps of the rotations; negative: until they have settled.
        unit: 1 for forces, 0 for the product of the stiffness, rotations as they are, with u.

    Returns:
        Their elastic energy [J].
    """
    chunk = np.zeros(SLOTS * LANES)
    energy = 0.0
    for i in range(ROTATION * LANES, (ROTATION + 1) * LANES):
        chunk[i] = 1.0
    n = domains.used.shape[0]
    for s in range(awake.shape[0]):
        for low in range(awake[s, 0], min(n, awake[s, 1]), LANES):
            high = min(low + LANES, n, awake[s, 1])
            for i in range(low, high):
                _average(domains, u, i, i - low, chunk, unit)
            for _ in range(turns):
                turn(chunk)
            if turns < 0:
                settle(chunk, 1e-14, 100)
            if turns != 0:
                for i in range(low, high):
                    for k in range(4):
                        domains.rotation[i, k] = chunk[i - low + (ROTATION + k) * LANES]
            stress(chunk, unit)
            for i in range(low, high):
                energy += chunk[i - low + ENERGY * LANES]
                _distribute(domains, i, i - low, chunk, f)
    return energy


class NodeDomains:
    """The domains of a mesh that is cut.

    Args:
        mesh: the mesh; followed by `update`.
        lame_lambda, lame_mu: [Pa].
    """

    def __init__(self, mesh: TetMesh, lame_lambda: float, lame_mu: float) -> None:
        self._mesh = mesh
        self._lame = np.array([lame_lambda, lame_mu])
        n = self._mesh.node_count
        tets = self._mesh.tetrahedra.astype(np.int64)
        pairs = [tets[:, [i, j]] for i in range(4) for j in range(4)]
        both = np.concatenate(pairs)
        entries = np.unique(both[:, 0] * n + both[:, 1])
        room = np.bincount(entries // n, minlength=n)
        slots = int(room.sum())
        # Spare room, which costs nothing until it is used: no cut has to move it all.
        most = 2 * slots
        self._domains = Domains(
            np.concatenate([[0], np.cumsum(room)[:-1]]),
            np.zeros(n, np.int64),
            room,
            np.zeros(most, np.uint32),
            np.zeros(3 * most),
            np.zeros(n),
            np.zeros((n, 4)),
            self._lame,
        )
        self._filled = np.array([slots])
        self._gather(np.arange(n))

    def update(self, nodes: np.ndarray) -> None:
        """Computes the rows of the nodes that a change of connectivity touched, and no other.

        Args:
            nodes: `Touched.nodes` of the batch, shape (r,).
        """
        n, d = self._mesh.node_count, self._domains
        known = len(d.room)
        self._domains = d._replace(
            **{
                name: grown(getattr(d, name), n)
                for name in ('start', 'used', 'room', 'volume', 'rotation')
            }
        )
        if len(self._domains.room) > known:
            self._domains.room[known:] = 0
        self._gather(np.asarray(nodes, np.int64))
        d = self._domains
        rows = d.start, d.used, d.room, n
        columns, vectors = packed(*rows, d.columns, d.vectors, self._filled)
        self._domains = d._replace(columns=columns, vectors=vectors)

    def _gather(self, nodes: np.ndarray) -> None:
        while len(nodes):
            full = gather_domains(
                self._domains, self._filled, self._mesh.links, self._mesh.rest, nodes
            )
            if full < 0:
                return
            nodes = nodes[full:]
            d = self._domains
            size = int(self._filled[0]) + longer.py_func(int(d.room[nodes[0]])) + 1
            columns = grown(d.columns, size)
            self._domains = d._replace(columns=columns, vectors=grown(d.vectors, 3 * len(columns)))

    @property
    def operands(self) -> Domains:
        """What `add_domains` takes: the rows of the nodes there are."""
        n, d = self._mesh.node_count, self._domains
        return d._replace(
            start=d.start[:n],
            used=d.used[:n],
            room=d.room[:n],
            volume=d.volume[:n],
            rotation=d.rotation[:n],
        )
