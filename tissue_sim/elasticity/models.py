"""Elastic models with one interface: tensors, nodal smoothing, corotational elements, a law.

| model | tensors (lambda, mu) | smoothing domains | elements | rotating |
|---|---|---|---|---|
| linear | all | | | no |
| linear_smoothed | 0, w mu | lambda, (1 - w) mu | | no |
| corotational | | | all | yes |
| corotational_smoothed | | lambda, (1 - w) mu | 0, w mu | yes |
| stiffening | 0, w mu | lambda, (1 - w) mu | where strained | by its law |

with w = PLAIN_SHARE. Parts that a model lacks cost nothing, so one kernel serves all models.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.adaptive_law import (
    NO_LAW,
    Law,
    add_law_bounds,
    add_law_forces,
)
from cutting_trainer.tissue_sim.elasticity.coarse_rows import (
    NO_COARSE_ROWS,
    CoarseRows,
    lead_far_nodes,
    put_coarse_forces,
)
from cutting_trainer.tissue_sim.elasticity.corotational import (
    CorotationalElements,
    Elements,
    add_elements,
)
from cutting_trainer.tissue_sim.elasticity.local_rows import (
    MAX_LOCAL_NODES,
    NO_LOCAL_ROWS,
    Locality,
    LocalRows,
    local_product,
    locality,
)
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    NodalSmoothing,
    SmoothingDomains,
    add_linear_smoothed_forces,
    add_smoothed_forces,
)
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.tensor_mass import (
    StiffnessRows,
    TensorMass,
    put_rows,
    shape_gradients,
)
from cutting_trainer.tissue_sim.mesh.adjacency import (
    NodeAdjacency,
    chunks_around,
    intervals,
    nodes_of_chunks,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, Touched, grown
from cutting_trainer.tissue_sim.mesh.topology import of_region

ModelName = Literal[
    'linear', 'linear_smoothed', 'corotational', 'corotational_smoothed', 'stiffening'
]
MODELS: tuple[ModelName, ...] = get_args(ModelName)
PLAIN_SHARE = 0.3
"""Part of the shear stiffness that smoothed models leave to the elements.

Averages over nodes alone do not see some short waves. With this part K is at least w times that
of plain elements without lambda, which has the six rigid motions and no other zero mode.
"""

STRAIN_TOLERANCE = 0.05
"""Change of shape or direction |F - I| up to which the stiffening model is linear; in elements,
which have no part in volume and a smaller one in shear, twice as much."""


class Operands(NamedTuple):
    """Operands of the kernels for a model.

    Attributes:
        rows: tensors, or no rows.
        domains: smoothing domains of nodes, or none.
        elements: corotational elements, or none.
        rotating: 1 if domains and elements rotate with the tissue, else 0.
        awake: intervals of nodes whose rows are evaluated, shape (s, 2).
        spans: intervals of evaluated domains: `awake`, and those of further regions at its nodes.
        reach: intervals of nodes read and written by these, shape (s, 2).
        chunks: evaluated chunks of elements, shape (k,).
        local: complete rows of a part with its own numbering of u and f, or none.
        law: of domains and elements, instead of corotation, or none.
        load: forces to subtract from the elastic ones [N], by coordinate; (0,): none.
        coarse: unknowns after the nodes that move far nodes, or none.
    """

    rows: StiffnessRows
    domains: SmoothingDomains
    elements: Elements
    rotating: int
    awake: np.ndarray
    spans: np.ndarray
    reach: np.ndarray
    chunks: np.ndarray
    local: LocalRows
    law: Law
    load: np.ndarray
    coarse: CoarseRows


class ModelPart(NamedTuple):
    """Some nodes with a numbering of their own.

    Attributes:
        place: the nodes and their numbers.
        operands: for the force on them, by these numbers.
    """

    place: Locality
    operands: Operands


@inner(error_model='numpy')
def _begin(operands, u, f):
    """Write the forces of the tensors in all of reach, 0 where there are none."""
    rows, awake, reach = operands.rows, operands.awake, operands.reach
    n = rows.used.shape[0]
    if n == 0 or awake.shape[0] != 1 or awake[0, 1] - awake[0, 0] < n:
        for s in range(reach.shape[0]):
            f[3 * reach[s, 0] : 3 * reach[s, 1]] = 0.0
    put_rows(rows, awake, u, f)


@kernel(error_model='numpy')
def internal_force(operands, u, f, rotation_steps):
    """Compute the elastic force that resists a displacement, less the load of the operands.

    Args:
        operands: of the model; its rotations, if any, follow u.
        u: displacement by coordinate [m], shape (3 n,).
        f: output [N]: exact at nodes with only awake neighbours, 0 or partial elsewhere in reach,
            unchanged beyond, shape (3 n,).
        rotation_steps: iterations of the rotations; negative: until convergence.

    Returns:
        Elastic energy of domains and elements [J]; with a law, that of all if rotation_steps is
        negative.
    """
    lead_far_nodes(operands.coarse, u, 1.0)
    energy = _elastic_force(operands, u, f, rotation_steps)
    if operands.load.shape[0] > 0:
        _subtract(operands.load, operands.reach, f)
    put_coarse_forces(operands.coarse, u, f, 1.0)
    return energy


@inner(error_model='numpy')
def _subtract(load, reach, f):
    for s in range(reach.shape[0]):
        for i in range(3 * reach[s, 0], min(3 * reach[s, 1], load.shape[0])):
            f[i] -= load[i]


@inner(error_model='numpy')
def _elastic_force(operands, u, f, rotation_steps):
    if operands.local.first.shape[0] > 0:
        local_product(operands.local, u, f)
        return 0.0
    _begin(operands, u, f)
    if operands.law.domains.shape[0] > 0:
        return add_law_forces(
            operands.law, operands.domains, operands.elements, operands.awake, operands.spans,
            operands.chunks, u, f, rotation_steps,
        )  # fmt: skip
    energy = 0.0
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_linear_smoothed_forces(operands.domains, operands.spans, u, f)
    elif operands.domains.used.shape[0] > 0:
        energy += add_smoothed_forces(operands.domains, operands.spans, u, f, rotation_steps, 1.0)
    if operands.chunks.shape[0] > 0:
        energy += add_elements(operands.elements, operands.chunks, u, f, rotation_steps, 1.0)
    return energy


@kernel(error_model='numpy')
def stiffness_product(operands, x, f):
    """Compute f = K x under the present rotations.

    Args:
        operands: of the model.
        x: by coordinate, shape (3 n,).
        f: output, shape (3 n,).
    """
    lead_far_nodes(operands.coarse, x, 0.0)
    _stiffness_product(operands, x, f)
    put_coarse_forces(operands.coarse, x, f, 0.0)


@inner(error_model='numpy')
def _stiffness_product(operands, x, f):
    _begin(operands, x, f)
    if operands.law.domains.shape[0] > 0:
        add_linear_smoothed_forces(operands.domains, operands.spans, x, f)
        add_law_bounds(
            operands.law, operands.domains, operands.elements, operands.spans, operands.chunks, x, f
        )
        return
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_linear_smoothed_forces(operands.domains, operands.spans, x, f)
    elif operands.domains.used.shape[0] > 0:
        add_smoothed_forces(operands.domains, operands.spans, x, f, 0, 0.0)
    if operands.chunks.shape[0] > 0:
        add_elements(operands.elements, operands.chunks, x, f, 0, 0.0)


@kernel
def gather_incident_rows(links, rest, nodes, constants, relative, densities, mass, diagonal, norms):
    """Compute masses, diagonal and norms of plain elements' rows at some nodes.

    Args:
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        nodes: which, shape (r,).
        constants: lambda [Pa], mu [Pa].
        relative: stiffness by region, relative to these.
        densities: by region [kg/m^3].
        mass: output [kg] (thesis eq. 4.2), shape (>= n,).
        diagonal: output [N/m], shape (>= 3 n,).
        norms: output, sums of the Frobenius norms of the element blocks K_ij of row i [N/m];
            element rotations do not change them, shape (>= n,).
    """
    lame_lambda, lame_mu = constants[0], constants[1]
    g = np.empty((4, 3))
    for node in nodes:
        mass[node] = 0.0
        norms[node] = 0.0
        for i in range(3):
            diagonal[3 * node + i] = 0.0
        corner = links.first_corner[node]
        while corner >= 0:
            a = corner % 4
            volume = shape_gradients(rest, links.tetrahedra, corner // 4, g)
            mass[node] += 0.25 * of_region(links, corner // 4, densities) * volume
            volume *= of_region(links, corner // 4, relative)
            dot = volume * lame_mu * (g[a, 0] * g[a, 0] + g[a, 1] * g[a, 1] + g[a, 2] * g[a, 2])
            both = volume * (lame_lambda + lame_mu)
            for i in range(3):
                diagonal[3 * node + i] += both * g[a, i] * g[a, i] + dot
            for b in range(4):
                dot = g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2]
                square = 0.0
                for i in range(3):
                    for k in range(3):
                        value = lame_lambda * g[a, i] * g[b, k] + lame_mu * g[b, i] * g[a, k]
                        if i == k:
                            value += lame_mu * dot
                        square += value * value
                norms[node] += volume * np.sqrt(square)
            corner = links.corner_next[corner]


@kernel
def assembled_norms(tensors, links, nodes, norms):
    """Compute the sums of Frobenius norms of the assembled 3x3 blocks of some rows.

    Args:
        tensors: a `tensor_mass.Tensors`.
        links: connectivity.
        nodes: which rows, shape (r,).
        norms: output [N/m], shape (>= n,).
    """
    seen = np.empty(256, np.int64)
    for which in range(len(nodes)):
        node = nodes[which]
        d = tensors.diagonal[node]
        total = np.sqrt(d[0] ** 2 + d[3] ** 2 + d[5] ** 2 + 2 * (d[1] ** 2 + d[2] ** 2 + d[4] ** 2))
        number = 0
        corner = links.first_corner[node]
        while corner >= 0:
            for b in range(4):
                other = links.tetrahedra[corner // 4, b]
                new = other != node
                for k in range(number):
                    if seen[k] == other:
                        new = False
                if new:
                    total += _edge_norm(tensors, max(node, other), min(node, other))
                    if number < 256:
                        seen[number] = other
                        number += 1
            corner = links.corner_next[corner]
        norms[node] = total


@inner
def _edge_norm(tensors, high, low):
    for slot in range(tensors.start[high], tensors.start[high] + tensors.used[high]):
        if tensors.columns[slot] == 3 * low:
            square = 0.0
            for i in range(9):
                square += tensors.blocks[9 * slot + i] ** 2
            return np.sqrt(square)
    return 0.0


_NO_ROWS = StiffnessRows(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32), np.zeros(0), np.zeros(0)
)
_NO_DOMAINS = SmoothingDomains(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32),
    np.zeros(0), np.zeros(0), np.zeros((0, 4)), np.zeros(2),
)  # fmt: skip
_NO_ELEMENTS = Elements(np.zeros(0, np.uint32), np.zeros(0))
_NO_LOAD = np.zeros(0)


class ElasticModel:
    """Elasticity of a mesh under cuts (docs/method.md, with the limits of each model).

    Args:
        mesh: the mesh; the model follows it by `update`.
        material: its constants.
        name: of the model.
        tolerance: |F - I| up to which the stiffening model is linear; 0: nowhere.

    Attributes:
        load: forces that act beside the elastic ones [N], shape (3 n,); (0,): none.

    Raises:
        MeshError: the mesh has a region without constants.
        ValueError: there is no such model.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: Material,
        name: ModelName = 'linear',
        tolerance: float = STRAIN_TOLERANCE,
    ) -> None:
        if name not in MODELS:
            raise ValueError(f'there is no model {name!r}: give one of {", ".join(MODELS)}')
        self.mesh = mesh
        self.material = material
        self.name = name
        self.rotating = not name.startswith('linear')
        self.lawful = name == 'stiffening'
        lam, mu, relative = material.lame_lambda, material.lame_mu, material.relative_stiffness
        last = int(mesh.regions.max(initial=0))
        if last >= len(relative):
            raise MeshError(
                f'the mesh has a region {last}, the material {len(relative) - 1} regions'
            )
        smoothed = name.endswith('_smoothed') or self.lawful
        plain = (0.0, PLAIN_SHARE * mu) if smoothed else (lam, mu)
        corotational = name.startswith('corotational')
        self.tensor_mass = None if corotational else TensorMass(mesh, *plain, relative)
        self._elements = CorotationalElements(mesh, *plain, relative) if self.rotating else None
        self._law = NO_LAW
        if self.lawful:
            own = PLAIN_SHARE * mu
            self._law = NO_LAW._replace(
                domains=np.array([mu, -own, lam, material.stiffening]),
                elements=np.array([0.0, own, 0.0, material.stiffening]),
                tolerance=np.array([tolerance, 2.0 * tolerance]),
                implicit=np.zeros(1, np.int64),
            )
        self._domains = None
        if smoothed:
            self._domains = NodalSmoothing(mesh, lam, (1 - PLAIN_SHARE) * mu, relative)
        self._assembled = name == 'linear'
        self._neighbours: NodeAdjacency | None = None
        self._mass = np.zeros(0)
        self._diagonal = np.zeros(0)
        self._norms = np.zeros(0)
        self.load = _NO_LOAD
        self._gather(np.arange(mesh.node_count))

    def update(self, touched: Touched) -> None:
        """Recompute only the parts touched by a change of connectivity.

        Args:
            touched: slots written by the batch.
        """
        if self.tensor_mass is not None:
            self.tensor_mass.update(touched.nodes)
        if self._domains is not None:
            self._domains.update(touched.nodes)
        if self._elements is not None:
            stars = [self.mesh.star(int(node)) for node in touched.rest]
            self._elements.update(np.concatenate([touched.tetrahedra, *stars]))
        if self._neighbours is not None:
            self._neighbours.update(touched.nodes)
        self._gather(touched.nodes)

    def _gather(self, nodes: np.ndarray) -> None:
        n, links = self.mesh.node_count, self.mesh.links
        self._mass = grown(self._mass, n)
        self._norms = grown(self._norms, n)
        self._diagonal = grown(self._diagonal, 3 * len(self._mass))
        m = self.material
        constants = np.array([m.lame_lambda, m.lame_mu])
        which = np.asarray(nodes, np.int64)
        gather_incident_rows(
            links, self.mesh.rest, which, constants, m.relative_stiffness, m.densities,
            self._mass, self._diagonal, self._norms,
        )  # fmt: skip
        if self._assembled and self.tensor_mass is not None:
            assembled_norms(self.tensor_mass.tensors, links, which, self._norms)

    @property
    def mass(self) -> np.ndarray:
        """Lumped masses [kg], shape (n,); a view."""
        return self._mass[: self.mesh.node_count]

    @property
    def diagonal(self) -> np.ndarray:
        """Diagonal of the plain elements' stiffness at rest [N/m], shape (3 n,); a view."""
        return self._diagonal[: 3 * self.mesh.node_count]

    @property
    def smoothing(self) -> NodalSmoothing | None:
        """Smoothing domains of the nodes, if the model has them."""
        return self._domains

    def frequency_rows(self, nodes: np.ndarray) -> np.ndarray:
        """Return Gershgorin's row sums of M^-1 K by 3x3 blocks; the largest bounds all eigenvalues.

        A row depends only on the elements of its node, so only rows touched by a cut change. For
        smoothed models it is the row of plain elements: smoothing removes energy (Jensen).

        Args:
            nodes: which rows, shape (r,).

        Returns:
            Squares of frequencies [1/s^2], shape (r,).
        """
        return np.asarray(self._norms[nodes] / self._mass[nodes])

    @property
    def neighbours(self) -> NodeAdjacency:
        """Adjacency of the nodes; built on first use."""
        if self._neighbours is None:
            self._neighbours = NodeAdjacency(self.mesh)
        return self._neighbours

    def operands(self, nodes: np.ndarray | None = None) -> Operands:
        """Return the operands of the kernels.

        Args:
            nodes: nodes with an exact force, None: all; sorted, shape (a,).
        """
        if nodes is not None:
            return self.operands_within(self.neighbours.levels(nodes, 2), 0)
        whole = np.array([[0, self.mesh.node_count]])
        chunks = np.arange(-(-len(self.mesh.tetrahedra) // LANES) if self._elements else 0)
        return self._operands(whole, whole, chunks)

    def operands_within(self, level: np.ndarray, most: int) -> Operands:
        """Return the operands for the force at the nodes up to a level.

        Args:
            level: `NodeAdjacency.levels` up to `most` + 2 at least, shape (n,).
            most: level of the nodes with an exact force.
        """
        chunks = np.zeros(0, np.int64)
        rows, reach = intervals(level, most + 1), intervals(level, most + 2)
        if self._elements:
            chunks = chunks_around(self.mesh, np.flatnonzero(level <= most), LANES)
            theirs = (level > most + 2).astype(np.uint8)
            theirs[nodes_of_chunks(self.mesh, chunks, LANES)] = 0
            reach = intervals(theirs, 0)
        return self._operands(rows, reach, chunks)

    def _law_operands(self, chunks: np.ndarray) -> Law:
        """Return operands of the law, with a list of candidates of their own."""
        if not self.lawful:
            return NO_LAW
        law, n = self._law, self.mesh.node_count
        n = n if self._domains is None else self._domains.count
        slots = -(-len(self.mesh.tetrahedra) // LANES) * LANES
        if (len(law.domain_bounds), len(law.element_bounds)) != (n, slots):
            law = law._replace(domain_bounds=np.zeros(n), element_bounds=np.zeros(slots))
            self._law = law
        return law._replace(
            counters=np.zeros(2, np.int64), candidates=np.zeros(len(chunks) * LANES, np.int64)
        )

    def _operands(self, rows: np.ndarray, reach: np.ndarray, chunks: np.ndarray) -> Operands:
        return Operands(
            self.tensor_mass.operands if self.tensor_mass else _NO_ROWS,
            self._domains.operands if self._domains else _NO_DOMAINS,
            self._elements.operands if self._elements else _NO_ELEMENTS,
            int(self.rotating),
            rows,
            rows if self._domains is None else self._domains.spans(rows),
            reach,
            chunks,
            NO_LOCAL_ROWS,
            self._law_operands(chunks),
            self.load,
            NO_COARSE_ROWS,
        )

    def part(self, nodes: np.ndarray, around: np.ndarray, others: np.ndarray) -> ModelPart | None:
        """Return some nodes with a numbering of their own if a step is cheaper so; else None.

        Args:
            nodes, around, others: see `locality`.
        """
        if self.name != 'linear' or self.tensor_mass is None or len(nodes) > MAX_LOCAL_NODES:
            return None
        place = locality(self.tensor_mass.operands, nodes, around, others, self.mesh.node_count)
        own, all_of_them = np.array([[0, len(nodes)]]), np.array([[0, len(place.at) // 3]])
        none = np.zeros(0, np.int64)
        operands = Operands(
            _NO_ROWS, _NO_DOMAINS, _NO_ELEMENTS, 0, own, own, all_of_them, none, place.rows,
            NO_LAW, _NO_LOAD, NO_COARSE_ROWS,
        )  # fmt: skip
        return ModelPart(place, operands)

    def evaluate(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the elastic force that resists a displacement, less the load.

        Args:
            u: displacement [m], shape (n, 3). The rotations follow it until convergence.

        Returns:
            Force [N], shape (n, 3), and elastic energy [J], without the load's.
        """
        f = np.empty(3 * self.mesh.node_count)
        flat = np.ascontiguousarray(u, float).ravel()
        energy = float(internal_force(self.operands(), flat, f, -1))
        force = f.reshape(-1, 3)
        if self.rotating:
            return force, energy
        return force, 0.5 * float(np.sum(u * force)) + self.half_work(flat)

    def half_work(self, u: np.ndarray) -> float:
        """Return half the work of the load along a displacement [m], shape (3 n,) [J]."""
        return 0.5 * float(self.load @ u) if len(self.load) else 0.0

    def restart_rotations(self, u: np.ndarray) -> None:
        """Compute the rotations anew: a step that diverged leaves some that follow no shape.

        Args:
            u: displacement [m], shape (n, 3).
        """
        if not self.rotating:
            return
        if self._elements is not None:
            self._elements.update(np.arange(len(self.mesh.tetrahedra)))
        if self._domains is not None:
            self._domains.forget_rotations()
        self.evaluate(u)

    def force(self, u: np.ndarray) -> np.ndarray:
        """Return the elastic force that resists a displacement [N], shape (n, 3), see
        `evaluate`.
        """
        return self.evaluate(u)[0]

    def product(self, x: np.ndarray, nodes: np.ndarray | None = None) -> np.ndarray:
        """Return the product of stiffness under present rotations and a displacement.

        Args:
            x: [m], shape (n, 3).
            nodes: rows of the result, None: all; sorted, shape (a,).

        Returns:
            [N], shape (n, 3); with `nodes` at these only, shape (a, 3).
        """
        f = np.empty(3 * self.mesh.node_count)
        stiffness_product(self.operands(nodes), np.ascontiguousarray(x, float).ravel(), f)
        force = f.reshape(-1, 3)
        return force if nodes is None else force[nodes]

    def dense(self) -> np.ndarray:
        """Return the stiffness matrix [N/m], shape (3 n, 3 n); for small meshes and tests."""
        size = 3 * self.mesh.node_count
        operands, k, x = self.operands(), np.empty((size, size)), np.zeros(size)
        for i in range(size):
            x[i] = 1.0
            stiffness_product(operands, x, k[i])
            x[i] = 0.0
        return k
