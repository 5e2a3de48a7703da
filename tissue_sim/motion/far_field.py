"""Far field: nodes near the tool move on their own, all others by a coarse grid.

The displacement of a far node is the one that it had at the start of a frame, plus an interpolation
of the grid's unknowns (Galerkin): nothing jumps where the tool goes on, and a node keeps its
history, whose fine shape fades while no tool acts. At the start of a frame the force
on the unknowns is that of the whole tissue. Within it the far elements are linear; those with a
free node are evaluated as they are, and nodes are free wherever linear would be wrong. An unknown
has the mass of its far nodes, so that no frequency is above that of the whole tissue, and the same
step is stable.
"""

from collections.abc import Sequence

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.contact.coupling import FREE, Coupling, held_nodes
from cutting_trainer.tissue_sim.elasticity.coarse_rows import CoarseRows
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, internal_force
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import smoothed_gradient
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.mesh.adjacency import intervals
from cutting_trainer.tissue_sim.mesh.tetra_mesh import Touched, grown
from cutting_trainer.tissue_sim.motion.active_region import Region
from cutting_trainer.tissue_sim.motion.coarse_grid import CoarseGrid
from cutting_trainer.tissue_sim.motion.coarse_stiffness import CoarseStiffness
from cutting_trainer.tissue_sim.motion.far_relaxation import LENGTHS, descend, gathered

_CELLS_PER_NODE = 0.5
"""Cells of the grid, as a share of the free nodes."""
_MOVES = 0.05
"""Way of the tool, relative to the radius of the free nodes, after which they are chosen anew."""
SHARES = 1.0, 0.7, 0.5
"""Shares of the free nodes after 0, 1 and 2 concessions; docs/performance.md has their price."""
_LEVELS = 3
_BENT, _STAYS_BENT = 0.12, 0.08
"""|F - I| at which a node becomes free, and at least has to be to stay so: up to there the tangent
of a law or of a rotation is at most some twice the linear stiffness, and a frame is stable."""
_RING = 2.0
"""Radius within which far nodes relax at each frame, relative to that of the free nodes: there the
field is too curved for the grid."""


@kernel
def _weighed(level, columns, weights, inverse_mass, out):
    """Add the masses of far nodes to those of the unknowns; return these nodes, sorted.

    Args:
        level: 0 at free nodes, shape (n,).
        columns, weights: see `CoarseGrid`.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        out: [kg], shape (c,).
    """
    far, count = np.empty(len(level), np.int64), 0
    for node in range(len(level)):
        if level[node] == 0 or inverse_mass[3 * node] == 0.0:
            continue
        mass, follows = 1.0 / inverse_mass[3 * node], False
        for k in range(8):
            w = weights[node, k]
            if w > 0.0:
                out[columns[node, k]] += w * mass
                follows = True
        if follows:
            far[count] = node
            count += 1
    return far[:count].copy()


@kernel
def _rank(rest, centres, out):
    """Write squared distances from the nearest of some places."""
    for node in range(len(rest)):
        out[node] = np.inf
        for c in range(len(centres)):
            x, y = rest[node, 0] - centres[c, 0], rest[node, 1] - centres[c, 1]
            z = rest[node, 2] - centres[c, 2]
            out[node] = min(out[node], x * x + y * y + z * z)


@kernel(error_model='numpy')
def _strain_domains(domains, u, out):
    """Write the squares of F - I of smoothing domains, shape (r,)."""
    for row in range(len(out)):
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = smoothed_gradient(domains, u, row)
        out[row] = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz
        out[row] += zx * zx + zy * zy + zz * zz


@kernel(error_model='numpy')
def _strain_elements(elements, u, out):
    """Write the largest square of F - I of the nodes' elements, shape (n,)."""
    out[:] = 0.0
    for tet in range(len(elements.corners) // 4):
        at = tet // LANES * KEPT * LANES + tet % LANES
        corner = 4 * (tet // LANES) * LANES + tet % LANES
        square, first = 0.0, elements.corners[corner]
        for i in range(3):
            for j in range(3):
                value = 0.0
                for a in range(3):
                    node = elements.corners[corner + (a + 1) * LANES]
                    value += (u[node + i] - u[first + i]) * elements.data[at + (3 * a + j) * LANES]
                square += value * value
        for a in range(4):
            node = elements.corners[corner + a * LANES] // 3
            out[node] = max(out[node], square)


@kernel
def _follow(far, columns, weights, u, v, start):
    """Move far nodes with the unknowns, and give them their velocity; see `FarField.follow`."""
    for node in far:
        for i in range(3):
            way = speed = 0.0
            for k in range(8):
                w = weights[node, k]
                if w > 0.0:
                    at = start + 3 * columns[node, k] + i
                    way += w * u[at]
                    speed += w * v[at]
            u[3 * node + i] += way
            v[3 * node + i] = speed


class FarField:
    """Free nodes around the tools, and the unknowns that move all others.

    Where the tissue has strained or turned too much to be linear, nodes are free as well.

    Args:
        model: the elastic model.
        nodes: how many are free.

    Attributes:
        concession: steps by which fewer are free.
    """

    whole = True
    """All nodes move."""

    def __init__(self, model: ElasticModel, nodes: int) -> None:
        self._model = model
        self._nodes = nodes
        self.concession = 0
        n = model.mesh.node_count
        cells = max(1, round(_CELLS_PER_NODE * nodes))
        self._grid = CoarseGrid(model.mesh, model.neighbours, cells)
        self._stiffness = CoarseStiffness(model, self._grid)
        # All is in the sum: otherwise the first frame of a large tissue would take ten others'.
        self._stiffness.evaluate_apart(np.zeros(n, bool), np.zeros(0, np.int64))
        self._level = np.full(n, _LEVELS + 1, np.uint8)
        self._ring = np.full(n, _LEVELS + 1, np.uint8)
        self._far = np.zeros(0, np.int64)
        self._centres = np.zeros((0, 3))
        self._radius = 0.0
        self._mass = np.zeros(0)
        self._changed = True

    @property
    def extra(self) -> int:
        """Coordinates of the unknowns, which follow those of the nodes in u and v."""
        return 3 * self._grid.count

    @property
    def nodes(self) -> np.ndarray:
        """Free nodes, sorted, shape (a,)."""
        return np.flatnonzero(self._level == 0)

    @property
    def count(self) -> int:
        """Number of free nodes."""
        return int((self._level == 0).sum())

    @property
    def near(self) -> np.ndarray:
        """Nodes whose rows and domains are evaluated as they are, sorted, shape (b,)."""
        return np.flatnonzero(self._level <= 1)

    def concede(self, steps: int) -> None:
        """Leave fewer nodes around the tools free, from the next choice on.

        Those that a tool loads, and those that are bent, stay free.

        Args:
            steps: place in `SHARES`; beyond the last: the last.
        """
        steps = min(steps, len(SHARES) - 1)
        self._changed |= steps != self.concession
        self.concession = steps

    def operands(self) -> Operands:
        """Return the operands of the part that is evaluated as it is."""
        return self._model.operands_within(self._level[: self._model.mesh.node_count], 0)

    def covers(self, couplings: Sequence[Coupling]) -> bool:
        """Return whether the nodes that tools load are free."""
        return not self._level[held_nodes(couplings)].any()

    def choose(
        self,
        u: np.ndarray,
        v: np.ndarray,
        force: np.ndarray,
        inverse_mass: np.ndarray,
        couplings: Sequence[Coupling],
        omega: float,
    ) -> Region:
        """Choose the free nodes, and begin anew from the present displacement, the ring relaxed.

        Args:
            u: displacement with the unknowns, which become 0 [m], shape (3 (n + c),).
            v: velocity; that of unknowns follows nodes that are not free any more [m/s].
            force: elastic force at u [N], follows it, shape (n, 3).
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            couplings: of the tools.
            omega: bound of the highest frequency [rad/s].
        """
        n, start = len(inverse_mass) // 3, len(inverse_mass)
        bent = self._bent(u, inverse_mass)
        if self._moved_on(couplings) or (self._level[:n][bent > _BENT**2] > 0).any():
            before = self._level[:n] == 0
            self._select(couplings, bent)
            self._weigh(v, inverse_mass, before)
            self._surround()
        self._relax_ring(u, force, inverse_mass, omega)
        level = self._level[:n]
        operands = self.operands()
        u[start:] = 0.0
        f, flat = np.zeros(start), force.reshape(-1)
        internal_force(operands, u[:start], f, 1)
        inside = np.zeros(n, bool)
        for low, high in operands.reach:
            inside[low:high] = True
        rim = self._far[inside[self._far]]
        far_force, near_force = np.zeros((2, self.extra))
        grid, stiffness = self._grid, self._stiffness
        gathered(self._far, grid.columns, grid.weights, flat, 3, far_force)
        gathered(rim, grid.columns, grid.weights, f, 3, near_force)
        coarse = CoarseRows(
            start,
            3 * rim,
            u[:start].reshape(-1, 3)[rim].ravel(),
            3 * grid.columns[rim].ravel(),
            grid.weights[rim].ravel(),
            stiffness.used,
            stiffness.neighbours,
            stiffness.blocks,
            far_force - near_force,
        )
        unknowns = np.array([[n, n + grid.count]])
        spans = np.concatenate([intervals(level, 0), unknowns])
        reach = np.concatenate([operands.reach, unknowns])
        operands = operands._replace(reach=reach, coarse=coarse)
        return Region(spans, operands, operands, None)

    def inverse(self, inverse_mass: np.ndarray) -> np.ndarray:
        """Return inverse masses with those of the unknowns [1/kg], shape (3 (n + c),)."""
        own = np.where(self._mass > 0.0, 1.0 / np.maximum(self._mass, 1e-300), 0.0)
        return np.concatenate([inverse_mass, np.repeat(own, 3)])

    def diagonal(self, diagonal: np.ndarray) -> np.ndarray:
        """Return the diagonal of the stiffness with that of the unknowns [N/m]."""
        return np.concatenate([diagonal, self._stiffness.diagonal])

    def follow(self, u: np.ndarray, v: np.ndarray, start: int) -> None:
        """Move the far nodes with the unknowns, at the end of a frame.

        Args:
            u, v: displacement [m] and velocity [m/s] with the unknowns, shape (3 (n + c),).
            start: coordinate of the first unknown.
        """
        _follow(self._far, self._grid.columns, self._grid.weights, u, v, start)
        u[start:] = 0.0

    def relax(
        self, u: np.ndarray, force: np.ndarray, inverse_mass: np.ndarray, omega: float
    ) -> None:
        """Take a part of the fine shape, such as that of a dent, from all far nodes.

        Args:
            u: displacement [m], changed, shape (3 n,).
            force: elastic force there [N], shape (n, 3).
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            omega: bound of the highest frequency [rad/s].
        """
        descend(self._grid, self._far, self._mass, u, force, inverse_mass, omega**-2)

    def _relax_ring(
        self, u: np.ndarray, force: np.ndarray, inverse_mass: np.ndarray, omega: float
    ) -> None:
        """Relax the far nodes around the free ones; the force follows them."""
        n = len(force)
        ring, near = (np.flatnonzero(self._ring[:n] <= level) for level in (0, 1))
        if len(ring) == 0:
            return
        operands, f = self._model.operands_within(self._ring[:n], 1), np.zeros(3 * n)
        for length in LENGTHS:
            descend(self._grid, ring, self._mass, u, force, inverse_mass, length * omega**-2)
            internal_force(operands, u[: 3 * n], f, 1)
            force[near] = f.reshape(-1, 3)[near]

    def release(self, touched: Touched) -> None:
        """Prepare a change of connectivity: the mesh has changed, the model not yet."""
        mesh = self._model.mesh
        stars = [mesh.star(int(node)) for node in touched.rest]
        self._stiffness.release(touched.nodes, np.concatenate([touched.tetrahedra, *stars]))

    def follow_cut(self, touched: Touched) -> None:
        """Follow a change of connectivity, after the model."""
        n = self._model.mesh.node_count
        self._level, self._ring = (
            grown(level, n, fill=_LEVELS + 1) for level in (self._level, self._ring)
        )
        self._grid.follow_cut(touched, self._take_out)
        self._changed = True

    def move(self, nodes: np.ndarray) -> np.ndarray:
        """Return whether nodes move on their own, or not at all, in their shape."""
        return (self._level[nodes] == 0) | (self._model.mesh.fixed[nodes] == 1)

    def ahead(self, left: int, total: int, shortened: float) -> int:
        """Return the number of substeps until the next choice: all of the frame."""
        return left

    def wake(self) -> None:
        """Take the present velocity of the nodes over."""
        self._mass = np.zeros(0)
        self._changed = True

    def _take_out(self, nodes: np.ndarray) -> None:
        """Take the parts that depend on some nodes out of the reduced stiffness."""
        around = self._model.neighbours.around(nodes, 1)
        self._stiffness.release_around(around, nodes)

    def _moved_on(self, couplings: Sequence[Coupling]) -> bool:
        if self._changed or not self.covers(couplings):
            return True
        places = self._places(couplings)
        if len(places) == 0:
            return False
        if len(places) != len(self._centres):
            return True
        ways = np.linalg.norm(places - self._centres, axis=1)
        return bool((ways > _MOVES * self._radius).any())

    def _places(self, couplings: Sequence[Coupling]) -> np.ndarray:
        """Return where tools load the tissue at rest [m], shape (t, 3)."""
        rest = self._model.mesh.rest
        acting = [c.weights @ rest[c.nodes] for c in couplings if c.mode != FREE]
        return np.array(acting).reshape(-1, 3)

    def _bent(self, u: np.ndarray, inverse_mass: np.ndarray) -> np.ndarray:
        """Return the squares of F - I at nodes that can move, 0 of a linear model, shape (n,)."""
        out = np.zeros(len(inverse_mass) // 3)
        if self._model.rotating:
            operands = self._model.operands()
            if self._model.smoothing is not None:
                strains = np.zeros(len(operands.domains.used))
                _strain_domains(operands.domains, u, strains)
                np.maximum.at(out, self._model.smoothing.row_nodes, strains)
            else:
                _strain_elements(operands.elements, u, out)
            out[inverse_mass[::3] == 0.0] = 0.0
        return out

    def _select(self, couplings: Sequence[Coupling], bent: np.ndarray) -> None:
        """Choose the nodes nearest to a tool, without tools to their last places, and bent ones."""
        model, n = self._model, self._model.mesh.node_count
        places = self._places(couplings)
        if len(places):
            self._centres = places
        free = np.zeros(0, np.int64)
        if len(self._centres):
            rank = np.empty(n)
            _rank(model.mesh.rest, self._centres, rank)
            held = held_nodes(couplings)
            rank[held] = -1.0
            most = min(max(len(held), round(SHARES[self.concession] * self._nodes), 1), n) - 1
            free = np.argpartition(rank, most)[: most + 1]
            self._radius = float(np.sqrt(max(rank[free].max(), 0.0)))
        free = np.union1d(free, np.flatnonzero(bent > _STAYS_BENT**2))
        self._level = model.neighbours.levels(free, _LEVELS)
        near = self._level <= 1
        self._stiffness.evaluate_apart(near, free)
        self._changed = False

    def _surround(self) -> None:
        """Take the far nodes near the tools as the ring."""
        mesh = self._model.mesh
        rank = np.full(mesh.node_count, np.inf)
        if len(self._centres):
            _rank(mesh.rest, self._centres, rank)
        near = self._far[rank[self._far] <= (_RING * self._radius) ** 2]
        self._ring = self._model.neighbours.levels(near, _LEVELS)

    def _weigh(self, v: np.ndarray, inverse_mass: np.ndarray, before: np.ndarray) -> None:
        """Weigh the unknowns; nodes that are not free any more give them their momentum.

        Args:
            v: velocity with the unknowns [m/s], changed, shape (3 (n + c),).
            inverse_mass: by coordinate [1/kg], shape (3 n,).
            before: whether nodes were free, shape (n,).
        """
        grid, n, start = self._grid, len(before), 3 * len(before)
        known = grown(self._mass, grid.count)[: grid.count] > 0.0
        self._mass = np.zeros(grid.count)
        arrays = grid.columns, grid.weights
        self._far = _weighed(self._level[:n], *arrays, inverse_mass, self._mass)
        velocity, own = v[start:].reshape(-1, 3), v[:start].reshape(-1, 3)
        everything = self._gave(self._far, own, inverse_mass) if not known.all() else None
        left = self._far[before[self._far]]
        weight = np.maximum(self._mass, 1e-300)[:, None]
        given, momentum = self._gave(left, own, inverse_mass)
        velocity += (momentum - given[:, None] * velocity) / weight
        if everything is not None:
            velocity[~known] = (everything[1] / weight)[~known]
        velocity[self._mass <= 0.0] = 0.0

    def _gave(
        self, nodes: np.ndarray, v: np.ndarray, inverse_mass: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mass [kg], shape (c,), and momentum, shape (c, 3), that nodes give to unknowns."""
        grid = self._grid
        values = np.zeros((len(v), 4))
        values[nodes, 3] = 1.0 / inverse_mass[3 * nodes]
        values[nodes, :3] = values[nodes, 3:] * v[nodes]
        both = np.zeros((grid.count, 4))
        gathered(nodes, grid.columns, grid.weights, values.ravel(), 4, both.reshape(-1))
        return both[:, 3], both[:, :3]
