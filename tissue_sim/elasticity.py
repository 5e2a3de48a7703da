"""The elastic models, one protocol: sums of tensors, node domains and corotational elements.

| model | tensors (lambda, mu) | domains | elements | turns |
|---|---|---|---|---|
| linear | all | | | no |
| linear_smoothed | 0, w mu | lambda, (1 - w) mu | | no |
| corotational | | | all | yes |
| corotational_smoothed | | lambda, (1 - w) mu | 0, w mu | yes |

with w = PLAIN_SHARE. What a model has none of costs nothing, so that one kernel serves them all.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np
from numba import njit

from tissue_sim.corotational import CorotationalElements, Elements, add_elements
from tissue_sim.domains import Domains, NodeDomains, add_domains, add_still_domains
from tissue_sim.local_rows import (
    LARGEST,
    NO_LOCAL_ROWS,
    Locality,
    LocalRows,
    local_product,
    locality,
)
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh, Touched, grown
from tissue_sim.rings import Neighbours, chunks_around, intervals, nodes_of_chunks
from tissue_sim.rotation import LANES
from tissue_sim.tensor_mass import Rows, TensorMass, put_rows, shape_gradients

ModelName = Literal['linear', 'linear_smoothed', 'corotational', 'corotational_smoothed']
MODELS: tuple[ModelName, ...] = get_args(ModelName)

PLAIN_SHARE = 0.3
"""Part of the shear stiffness that smoothed models leave to the elements.

Averages over nodes alone do not see some short waves. With this part K is at least w times that
of plain elements without lambda, which has the six rigid motions and no other zero mode.
"""


class Operands(NamedTuple):
    """What the kernels take of a model.

    Attributes:
        rows: tensors; no rows if there are none.
        domains: of the nodes; none likewise.
        elements: corotational ones; none likewise.
        rotating: 1 if domains and elements turn with the tissue, else 0.
        awake: intervals of nodes whose rows and domains are evaluated, shape (s, 2).
        reach: intervals of nodes that these read and write, shape (s, 2).
        chunks: of elements that are evaluated, shape (k,).
        local: whole rows of a part on its own, by whose numbers u and f then are; none likewise.
    """

    rows: Rows
    domains: Domains
    elements: Elements
    rotating: int
    awake: np.ndarray
    reach: np.ndarray
    chunks: np.ndarray
    local: LocalRows


class Part(NamedTuple):
    """Some nodes on their own.

    Attributes:
        place: which, and their numbers.
        operands: for the force on them, by these numbers.
    """

    place: Locality
    operands: Operands


@njit(cache=True, error_model='numpy')
def _begin(operands, u, f):
    """Puts the forces of the tensors in all of reach, 0 where they have none."""
    rows, awake, reach = operands.rows, operands.awake, operands.reach
    n = rows.used.shape[0]
    if n == 0 or awake.shape[0] != 1 or awake[0, 1] - awake[0, 0] < n:
        for s in range(reach.shape[0]):
            f[3 * reach[s, 0] : 3 * reach[s, 1]] = 0.0
    put_rows(rows, awake, u, f)


@njit(cache=True, error_model='numpy')
def internal_force(operands, u, f, turns):
    """Elastic force that resists a displacement.

    Args:
        operands: of the model; its rotations, if any, follow u.
        u: displacement by coordinate [m], shape (3 n,).
        f: output [N], right at nodes all of whose neighbours are awake, 0 or a part of it elsewhere
            in reach, unchanged beyond, shape (3 n,).
        turns: steps of the rotations; negative: until they have settled.

    Returns:
        Elastic energy of domains and elements [J].
    """
    if operands.local.first.shape[0] > 0:
        local_product(operands.local, u, f)
        return 0.0
    _begin(operands, u, f)
    energy = 0.0
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_still_domains(operands.domains, operands.awake, u, f)
    elif operands.domains.used.shape[0] > 0:
        energy += add_domains(operands.domains, operands.awake, u, f, turns, 1.0)
    if operands.chunks.shape[0] > 0:
        energy += add_elements(operands.elements, operands.chunks, u, f, turns, 1.0)
    return energy


@njit(cache=True, error_model='numpy')
def stiffness_product(operands, x, f):
    """Product f = K x with the stiffness under the rotations as they are.

    Args:
        operands: of the model.
        x: by coordinate, shape (3 n,).
        f: output, shape (3 n,).
    """
    _begin(operands, x, f)
    if operands.domains.used.shape[0] > 0 and not operands.rotating:
        add_still_domains(operands.domains, operands.awake, x, f)
    elif operands.domains.used.shape[0] > 0:
        add_domains(operands.domains, operands.awake, x, f, 0, 0.0)
    if operands.chunks.shape[0] > 0:
        add_elements(operands.elements, operands.chunks, x, f, 0, 0.0)


@njit(cache=True)
def gather_stars(links, rest, nodes, constants, mass, diagonal, norms):
    """Masses, diagonal and norm of the rows of plain elements at some nodes, from their stars.

    Args:
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        nodes: which, shape (r,).
        constants: lambda [Pa], mu [Pa], density [kg/m^3].
        mass: output [kg] (thesis eq. 4.2), shape (>= n,).
        diagonal: output [N/m], shape (>= 3 n,).
        norms: output, sums of the Frobenius norms of the element blocks K_ij of row i [N/m],
            which rotations of elements do not change, shape (>= n,).
    """
    lame_lambda, lame_mu, density = constants[0], constants[1], constants[2]
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
            mass[node] += 0.25 * density * volume
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


@njit(cache=True)
def assembled_norms(tensors, links, nodes, norms):
    """Sums of the Frobenius norms of the assembled 3x3 blocks of some rows.

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


@njit(cache=True)
def _edge_norm(tensors, high, low):
    for slot in range(tensors.start[high], tensors.start[high] + tensors.used[high]):
        if tensors.columns[slot] == 3 * low:
            square = 0.0
            for i in range(9):
                square += tensors.blocks[9 * slot + i] ** 2
            return np.sqrt(square)
    return 0.0


_NO_ROWS = Rows(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32), np.zeros(0), np.zeros(0)
)
_NO_DOMAINS = Domains(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32),
    np.zeros(0), np.zeros(0), np.zeros((0, 4)), np.zeros(2),
)  # fmt: skip
_NO_ELEMENTS = Elements(np.zeros(0, np.uint32), np.zeros(0))


class ElasticModel:
    """The elasticity of a mesh that is cut (docs/method.md, which says where each model fails).

    Args:
        mesh: the mesh; the model follows it by `update`.
        material: its constants.
        name: which model.
    """

    def __init__(self, mesh: TetMesh, material: Material, name: ModelName = 'linear') -> None:
        self.mesh = mesh
        self.material = material
        self.name = name
        self.rotating = name.startswith('corotational')
        lam, mu = material.lame_lambda, material.lame_mu
        smoothed = name.endswith('_smoothed')
        plain = (0.0, PLAIN_SHARE * mu) if smoothed else (lam, mu)
        self.tensor_mass = None if self.rotating else TensorMass(mesh, *plain)
        self._elements = CorotationalElements(mesh, *plain) if self.rotating else None
        self._domains = NodeDomains(mesh, lam, (1 - PLAIN_SHARE) * mu) if smoothed else None
        self._assembled = name == 'linear'
        self._neighbours: Neighbours | None = None
        self._mass = np.zeros(0)
        self._diagonal = np.zeros(0)
        self._norms = np.zeros(0)
        self._gather(np.arange(mesh.node_count))

    def update(self, touched: Touched) -> None:
        """Computes anew what a change of connectivity touched, and nothing else.

        Args:
            touched: what the batch wrote.
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
        constants = np.array([m.lame_lambda, m.lame_mu, m.density])
        which = np.asarray(nodes, np.int64)
        gather_stars(
            links, self.mesh.rest, which, constants, self._mass, self._diagonal, self._norms
        )
        if self._assembled and self.tensor_mass is not None:
            assembled_norms(self.tensor_mass.tensors, links, which, self._norms)

    @property
    def mass(self) -> np.ndarray:
        """Lumped masses [kg], shape (n,); a view."""
        return self._mass[: self.mesh.node_count]

    @property
    def diagonal(self) -> np.ndarray:
        """Of the stiffness of plain elements at rest [N/m], shape (3 n,); a view."""
        return self._diagonal[: 3 * self.mesh.node_count]

    def frequency_rows(self, nodes: np.ndarray) -> np.ndarray:
        """Gershgorin's row sums of M^-1 K by 3x3 blocks: the largest bounds all eigenvalues.

        A row depends on the star of its own node, so only rows that a cut touched change. Of
        smoothed models it is the row of plain elements: averaging takes energy away (Jensen).

        Args:
            nodes: which rows, shape (r,).

        Returns:
            Squares of frequencies [1/s^2], shape (r,).
        """
        return np.asarray(self._norms[nodes] / self._mass[nodes])

    @property
    def neighbours(self) -> Neighbours:
        """Which nodes share an element; made when first asked for."""
        if self._neighbours is None:
            self._neighbours = Neighbours(self.mesh)
        return self._neighbours

    def operands(self, nodes: np.ndarray | None = None) -> Operands:
        """What the kernels take.

        Args:
            nodes: at which the force is to be right, None: all; sorted, shape (a,).
        """
        if nodes is not None:
            return self.operands_within(self.neighbours.levels(nodes, 2), 0)
        whole = np.array([[0, self.mesh.node_count]])
        chunks = np.arange(-(-len(self.mesh.tetrahedra) // LANES) if self._elements else 0)
        return self._operands(whole, whole, chunks)

    def operands_within(self, level: np.ndarray, most: int) -> Operands:
        """What the kernels take for the force at the nodes up to a level.

        Args:
            level: `Neighbours.levels` of `most` + 2 rings at least, shape (n,).
            most: of the nodes at which the force is to be right.
        """
        chunks = np.zeros(0, np.int64)
        rows, reach = intervals(level, most + 1), intervals(level, most + 2)
        if self._elements:
            chunks = chunks_around(self.mesh, np.flatnonzero(level <= most), LANES)
            theirs = (level > most + 2).astype(np.uint8)
            theirs[nodes_of_chunks(self.mesh, chunks, LANES)] = 0
            reach = intervals(theirs, 0)
        return self._operands(rows, reach, chunks)

    def _operands(self, rows: np.ndarray, reach: np.ndarray, chunks: np.ndarray) -> Operands:
        return Operands(
            self.tensor_mass.operands if self.tensor_mass else _NO_ROWS,
            self._domains.operands if self._domains else _NO_DOMAINS,
            self._elements.operands if self._elements else _NO_ELEMENTS,
            int(self.rotating),
            rows,
            reach,
            chunks,
            NO_LOCAL_ROWS,
        )

    def part(self, nodes: np.ndarray, around: np.ndarray, others: np.ndarray) -> Part | None:
        """Some nodes on their own, where a step of them is cheaper so; else None.

        Args:
            nodes, around, others: see `locality`.
        """
        if self.name != 'linear' or self.tensor_mass is None or len(nodes) > LARGEST:
            return None
        place = locality(self.tensor_mass.operands, nodes, around, others, self.mesh.node_count)
        own, all_of_them = np.array([[0, len(nodes)]]), np.array([[0, len(place.at) // 3]])
        none = np.zeros(0, np.int64)
        operands = Operands(
            _NO_ROWS, _NO_DOMAINS, _NO_ELEMENTS, 0, own, all_of_them, none, place.rows
        )
        return Part(place, operands)

    def evaluate(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Elastic force that resists a displacement (the internal force is its negative).

        Args:
            u: displacement [m], shape (n, 3). Rotations follow it until they have settled.

        Returns:
            Force [N], shape (n, 3), and elastic energy [J].
        """
        f = np.empty(3 * self.mesh.node_count)
        flat = np.ascontiguousarray(u, float).ravel()
        energy = float(internal_force(self.operands(), flat, f, -1))
        force = f.reshape(-1, 3)
        return force, energy if self.rotating else 0.5 * float(np.sum(u * force))

    def force(self, u: np.ndarray) -> np.ndarray:
        """Elastic force that resists a displacement [N], shape (n, 3), see `evaluate`."""
        return self.evaluate(u)[0]

    def product(self, x: np.ndarray, nodes: np.ndarray | None = None) -> np.ndarray:
        """Stiffness, with rotations as they are, times some displacement.

        Args:
            x: [m], shape (n, 3).
            nodes: at which it is wanted, None: all; sorted, shape (a,).

        Returns:
            [N], shape (n, 3); with `nodes` at these only, shape (a, 3).
        """
        f = np.empty(3 * self.mesh.node_count)
        stiffness_product(self.operands(nodes), np.ascontiguousarray(x, float).ravel(), f)
        force = f.reshape(-1, 3)
        return force if nodes is None else force[nodes]

    def dense(self) -> np.ndarray:
        """The stiffness matrix [N/m], shape (3 n, 3 n); for small meshes and tests."""
        size = 3 * self.mesh.node_count
        operands, k, x = self.operands(), np.empty((size, size)), np.zeros(size)
        for i in range(size):
            x[i] = 1.0
            stiffness_product(operands, x, k[i])
            x[i] = 0.0
        return k
