"""Nodal smoothing of strains (NS-FEM) against volumetric locking of linear tetrahedra.

Node-based smoothed finite elements (Liu et al. 2009): the smoothing domain of a node is a quarter
of each of its elements, and its displacement gradient their mean by volume,

    H_i = sum_j u_j G_ij^T,    G_ij = sum over elements t of i and j of V_t g_tj / sum of V_t.

Row i needs the elements of node i only. A cut therefore recomputes the rows of the touched nodes,
and a domain ends at the cut faces. The forces V_i P_i G_ij use the same row, while it is in cache.

Where regions of different materials meet, a node has a domain for each: a mean of their strains
would be that of neither. The domain of the first region is the row of the node; those of the others
follow the rows of all nodes.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.rotation import (
    ENERGY,
    LANES,
    ORDERED_MATH,
    ROTATION,
    SHEAR,
    SLOTS,
    VOLUMETRIC,
    rotation_step,
    settle,
    stress,
)
from cutting_trainer.tissue_sim.elasticity.simd import (
    add_three,
    load_four,
    plus_product,
    prefetch,
    product,
    spread,
    three,
    unpack,
)
from cutting_trainer.tissue_sim.elasticity.tensor_mass import (
    ONE_MATERIAL,
    longer,
    move_row,
    packed,
    shape_gradients,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown
from cutting_trainer.tissue_sim.mesh.topology import of_region


class SmoothingDomains(NamedTuple):
    """Rows of the smoothed gradients; row i of a node spans `start[i]` to `start[i] + used[i]`.

    After the rows of the n nodes come those of further regions, r in all.

    Attributes:
        start, used, room: first slot, used slots and slots of each row, shape (r,).
        columns: three times the node j of each entry, shape (c,). The node itself is among them
            at the surface only: in the interior G_ii is 0.
        vectors: G_ij [1/m], with some after the last row because three are read as four, shape (3
            c,).
        volume: of the domains, times their relative stiffness [m^3], shape (r,).
        rotation: quaternions, shape (r, 4).
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


@inner
def _on_surface(links, node):
    corner = links.first_corner[node]
    while corner >= 0:
        for local in range(4):
            if local != corner % 4 and links.face_triangle[corner // 4, local] >= 0:
                return True
        corner = links.corner_next[corner]
    return False


@inner
def _between_regions(links, node):
    """Return whether the elements of a node are of several regions."""
    if links.region.shape[0] == 0:
        return False
    corner = links.first_corner[node]
    region = links.region[corner // 4]
    while corner >= 0:
        if links.region[corner // 4] != region:
            return True
        corner = links.corner_next[corner]
    return False


@kernel
def regions_at_nodes(links, nodes):
    """Return 256 times a node plus a region, for the regions of some nodes' elements, ascending.

    Args:
        links: connectivity of a tissue of several regions.
        nodes: ascending, shape (a,).

    Returns:
        Shape (b,), int64.
    """
    found = [np.int64(0) for _ in range(0)]
    for node in nodes:
        seen = np.zeros(256, np.bool_)
        corner = links.first_corner[node]
        while corner >= 0:
            seen[links.region[corner // 4]] = True
            corner = links.corner_next[corner]
        for region in range(256):
            if seen[region]:
                found.append(np.int64(256 * node + region))
    return np.array(found, np.int64)


@kernel
def gather_smoothing_domains(domains, filled, links, rest, rows, nodes, regions, relative):
    """Compute some rows from the elements of their nodes, with identity rotations.

    Args:
        domains: written for `rows` only.
        filled: slots allocated to rows; grows with moved rows, shape (1,).
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        rows: which, shape (r,).
        nodes: of the rows, shape (r,).
        regions: whose elements count, shape (r,); (0,): all.
        relative: stiffness by region, by which elements are weighted.

    Returns:
        Index into `rows` of the first that does not fit in the arrays, or -1.
    """
    g = np.empty((4, 3))
    for which in range(len(rows)):
        node, row = nodes[which], rows[which]
        first = domains.start[row]
        used = 0
        total = 0.0
        outside = _on_surface(links, node) or _between_regions(links, node)
        corner = links.first_corner[node]
        while corner >= 0:
            tet = corner // 4
            if regions.shape[0] > 0 and links.region[tet] != regions[which]:
                corner = links.corner_next[corner]
                continue
            volume = shape_gradients(rest, links.tetrahedra, tet, g) * of_region(
                links, tet, relative
            )
            total += volume
            for b in range(4):
                if b == corner % 4 and not outside:
                    continue
                column = 3 * links.tetrahedra[tet, b]
                slot = first
                while slot < first + used and domains.columns[slot] != column:
                    slot += 1
                if slot == first + used:
                    if used == domains.room[row]:
                        d = domains
                        d.used[row] = used
                        if not move_row(d.start, d.used, d.room, d.columns, d.vectors, filled, row):
                            return which
                        first = d.start[row]
                        slot = first + used
                    used += 1
                    domains.columns[slot] = column
                    for i in range(3):
                        domains.vectors[3 * slot + i] = 0.0
                for i in range(3):
                    domains.vectors[3 * slot + i] += volume * g[b, i]
            corner = links.corner_next[corner]
        domains.used[row] = used
        domains.volume[row] = 0.25 * total
        for slot in range(3 * first, 3 * (first + used)):
            domains.vectors[slot] /= total
        domains.rotation[row] = 0.0
        domains.rotation[row, 0] = 1.0
    return -1


_U1, _U2, _U3 = (np.uint64(i) for i in (1, 2, 3))
_AHEAD, _LINE = np.uint64(3 * 384), np.uint64(8)
"""Prefetch distance in numbers, and numbers per cache line."""


@inner(fastmath=ORDERED_MATH, error_model='numpy')
def smoothed_gradient(domains, u, i):
    """Return the rows of the smoothed displacement gradient of a node."""
    hx = hy = hz = spread(0.0)
    first = np.uint64(domains.start[i])
    for k in range(first, first + np.uint64(domains.used[i])):
        j = np.uint64(domains.columns[k])
        vector = load_four(domains.vectors, _U3 * np.uint64(k))  # and the first of the next
        hx = plus_product(hx, spread(u[j]), vector)
        hy = plus_product(hy, spread(u[j + _U1]), vector)
        hz = plus_product(hz, spread(u[j + _U2]), vector)
    return unpack(hx), unpack(hy), unpack(hz)


@inner(fastmath=ORDERED_MATH, error_model='numpy')
def add_domain_forces(domains, i, px, py, pz, f):
    """Add the forces V P G_ij over the row of a node, P given by its columns."""
    vectors = domains.vectors
    first = np.uint64(domains.start[i])
    for k in range(first, first + np.uint64(domains.used[i])):
        q = _U3 * np.uint64(k)
        force = plus_product(product(px, spread(vectors[q])), py, spread(vectors[q + _U1]))
        force = plus_product(force, pz, spread(vectors[q + _U2]))
        add_three(f, np.uint64(domains.columns[k]), force)


@inner(fastmath=ORDERED_MATH, error_model='numpy')
def _average(domains, u, i, lane, chunk, unit):
    """Write the smoothed gradient of a node to a lane."""
    L = LANES
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = smoothed_gradient(domains, u, i)
    chunk[lane], chunk[lane + L], chunk[lane + 2 * L] = unit + xx, xy, xz
    chunk[lane + 3 * L], chunk[lane + 4 * L], chunk[lane + 5 * L] = yx, unit + yy, yz
    chunk[lane + 6 * L], chunk[lane + 7 * L], chunk[lane + 8 * L] = zx, zy, unit + zz
    chunk[lane + SHEAR * L] = 2.0 * domains.lame[1] * domains.volume[i]
    chunk[lane + VOLUMETRIC * L] = domains.lame[0] * domains.volume[i]
    for k in range(4):
        chunk[lane + (ROTATION + k) * L] = domains.rotation[i, k]


@inner(fastmath=ORDERED_MATH, error_model='numpy')
def _distribute(domains, i, lane, chunk, f):
    """Add the forces V P G_ij of a lane over the row of a node."""
    L = LANES
    px = three(chunk[lane], chunk[lane + 3 * L], chunk[lane + 6 * L])
    py = three(chunk[lane + L], chunk[lane + 4 * L], chunk[lane + 7 * L])
    pz = three(chunk[lane + 2 * L], chunk[lane + 5 * L], chunk[lane + 8 * L])
    add_domain_forces(domains, i, px, py, pz, f)


@inner(fastmath=ORDERED_MATH, error_model='numpy')
def add_linear_smoothed_forces(domains, awake, u, f):
    """Add the forces of domains that do not rotate: linear in u.

    Args:
        domains: the rows.
        awake: intervals of evaluated nodes, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
    """
    for s in range(awake.shape[0]):
        for i in range(awake[s, 0], min(domains.used.shape[0], awake[s, 1])):
            here = _U3 * np.uint64(domains.start[i])
            for q in range(here, here + _U3 * np.uint64(domains.used[i]), _LINE):
                prefetch(domains.vectors, q + _AHEAD)
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = smoothed_gradient(domains, u, i)
            shear = domains.lame[1] * domains.volume[i]
            pressure = domains.lame[0] * domains.volume[i] * (xx + yy + zz)
            xx, yy = 2.0 * shear * xx + pressure, 2.0 * shear * yy + pressure
            zz = 2.0 * shear * zz + pressure
            xy, xz, yz = shear * (xy + yx), shear * (xz + zx), shear * (yz + zy)
            columns = three(xx, xy, xz), three(xy, yy, yz), three(xz, yz, zz)
            add_domain_forces(domains, i, *columns, f)


@inner(error_model='numpy')
def add_smoothed_forces(domains, awake, u, f, rotation_steps, unit):
    """Add the forces of the smoothing domains.

    Args:
        domains: the rows; their rotations follow u by `rotation_steps` steps.
        awake: intervals of evaluated nodes, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
        rotation_steps: iterations of the rotations; negative: until convergence.
        unit: 1 for forces, 0 for the product of stiffness and u under present rotations.

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
            for _ in range(rotation_steps):
                rotation_step(chunk)
            if rotation_steps < 0:
                settle(chunk, 1e-14, 100)
            if rotation_steps != 0:
                for i in range(low, high):
                    for k in range(4):
                        domains.rotation[i, k] = chunk[i - low + (ROTATION + k) * LANES]
            stress(chunk, unit)
            for i in range(low, high):
                energy += chunk[i - low + ENERGY * LANES]
                _distribute(domains, i, i - low, chunk, f)
    return energy


_BY_ROW = ('start', 'used', 'room', 'volume', 'rotation')


class NodalSmoothing:
    """Smoothing domains of a mesh under cuts.

    Args:
        mesh: the mesh; followed by `update`.
        lame_lambda, lame_mu: [Pa].
        relative: stiffness by region, relative to these.
        split: whether the regions at a node have a domain each; else they share one, whose strain
            is their mean by stiffness.
    """

    def __init__(
        self,
        mesh: TetMesh,
        lame_lambda: float,
        lame_mu: float,
        relative: np.ndarray = ONE_MATERIAL,
        *,
        split: bool = True,
    ) -> None:
        self._mesh = mesh
        self._lame = np.array([lame_lambda, lame_mu])
        self._relative = relative
        self._split = split and len(mesh.regions) > 0
        self._others = np.zeros(0, np.int64)
        n = self._nodes = self._mesh.node_count
        tets = self._mesh.tetrahedra.astype(np.int64)
        pairs = [tets[:, [i, j]] for i in range(4) for j in range(4)]
        both = np.concatenate(pairs)
        entries = np.unique(both[:, 0] * n + both[:, 1])
        room = np.bincount(entries // n, minlength=n)
        slots = int(room.sum())
        # Spare room is free until used: no cut has to move all of the array.
        most = 2 * slots
        self._domains = SmoothingDomains(
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
        self._renew(np.arange(n))

    def forget_rotations(self) -> None:
        """Set all rotations to the identity."""
        self._domains.rotation[:] = (1.0, 0.0, 0.0, 0.0)

    def update(self, nodes: np.ndarray) -> None:
        """Recompute the rows of the nodes touched by a change of connectivity.

        Args:
            nodes: `Touched.nodes` of the batch, shape (r,).
        """
        n, d = self._mesh.node_count, self._domains
        known = len(d.room)
        self._grow(n)
        if len(self._domains.room) > known:
            self._domains.room[known:] = 0
        self._renew(np.asarray(nodes, np.int64))
        d = self._domains
        rows = d.start, d.used, d.room, self.count
        columns, vectors = packed(*rows, d.columns, d.vectors, self._filled)
        self._domains = d._replace(columns=columns, vectors=vectors)

    def _grow(self, rows: int) -> None:
        d = self._domains
        self._domains = d._replace(**{name: grown(getattr(d, name), rows) for name in _BY_ROW})

    def _renew(self, nodes: np.ndarray) -> None:
        """Compute the rows of some nodes, sorted, shape (r,)."""
        if not self._split:
            self._nodes = self._mesh.node_count
            self._gather(nodes, nodes, self._others)
            return
        n = self._mesh.node_count
        keys = regions_at_nodes(self._mesh.links, nodes)
        first = np.diff(keys // 256, prepend=-1) != 0
        kept = ~np.isin(self._others // 256, nodes) & (self._others // 256 < n)
        others = np.union1d(self._others[kept], keys[~first])
        rows = self._nodes + np.flatnonzero(kept)
        before = {name: getattr(self._domains, name)[rows] for name in _BY_ROW}
        self._domains.room[self._nodes : self.count] = 0  # their slots are not those of other rows
        kept_keys, self._others, self._nodes = self._others[kept], others, n
        self._grow(self.count)
        self._domains.room[n : self.count] = 0
        rows = n + np.searchsorted(others, kept_keys)
        for name, values in before.items():
            getattr(self._domains, name)[rows] = values
        self._gather(nodes, nodes, keys[first] % 256)
        rows = n + np.searchsorted(others, keys[~first])
        self._gather(rows, keys[~first] // 256, keys[~first] % 256)

    def _gather(self, rows: np.ndarray, nodes: np.ndarray, regions: np.ndarray) -> None:
        while len(rows):
            full = gather_smoothing_domains(
                self._domains, self._filled, self._mesh.links, self._mesh.rest, rows, nodes,
                regions, self._relative,
            )  # fmt: skip
            if full < 0:
                return
            rows, nodes, regions = rows[full:], nodes[full:], regions[full:]
            d = self._domains
            size = int(self._filled[0]) + longer.py_func(int(d.room[rows[0]])) + 1
            columns = grown(d.columns, size)
            self._domains = d._replace(columns=columns, vectors=grown(d.vectors, 3 * len(columns)))

    @property
    def count(self) -> int:
        """Number of rows: of the nodes, and of further regions at them."""
        return self._nodes + len(self._others)

    @property
    def row_nodes(self) -> np.ndarray:
        """Node of each row, shape (r,)."""
        return np.concatenate([np.arange(self._nodes), self._others // 256])

    def spans(self, nodes: np.ndarray) -> np.ndarray:
        """Return intervals of rows, shape (s, 2), of intervals of nodes, shape (a, 2)."""
        if not len(self._others):
            return nodes
        more = self._nodes + np.searchsorted(self._others // 256, nodes)
        return np.concatenate([nodes, more[more[:, 1] > more[:, 0]]])

    def rows(self, nodes: np.ndarray) -> np.ndarray:
        """Return the rows of some nodes, shape (r,)."""
        if not len(self._others):
            return nodes
        more = self._nodes + np.flatnonzero(np.isin(self._others // 256, nodes))
        return np.concatenate([nodes, more])

    @property
    def operands(self) -> SmoothingDomains:
        """Return the present rows, for `add_smoothed_forces`."""
        d, r = self._domains, self.count
        return d._replace(**{name: getattr(d, name)[:r] for name in _BY_ROW})
