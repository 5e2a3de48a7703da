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

from typing import Literal, get_args

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.adaptive_law import NO_LAW, Law
from cutting_trainer.tissue_sim.elasticity.coarse_rows import NO_COARSE_ROWS
from cutting_trainer.tissue_sim.elasticity.corotational import CorotationalElements, Elements
from cutting_trainer.tissue_sim.elasticity.elastic_force import (
    ModelPart,
    Operands,
    internal_force,
    stiffness_product,
)
from cutting_trainer.tissue_sim.elasticity.local_rows import (
    MAX_LOCAL_NODES,
    NO_LOCAL_ROWS,
    locality,
)
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.nodal_rows import assembled_norms, gather_incident_rows
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import NodalSmoothing, SmoothingDomains
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.tensor_mass import StiffnessRows, TensorMass
from cutting_trainer.tissue_sim.mesh.adjacency import (
    NodeAdjacency,
    chunks_around,
    intervals,
    nodes_of_chunks,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, Touched, grown

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
