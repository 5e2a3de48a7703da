"""Corotational elements: linear elasticity in a frame that rotates with each tetrahedron.

Mueller and Gross 2004. Elements lie in chunks of LANES, slot by slot: a loop over the lanes has
neither branches nor calls, and runs on vector registers. Constants and rotation stay in memory, all
else in a scratch chunk that fits into the first cache.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.rotation import (
    ENERGY,
    LANES,
    ROTATION,
    SAFE_MATH,
    SHEAR,
    SLOTS,
    rotation_step,
    settle,
    stress,
)
from cutting_trainer.tissue_sim.elasticity.simd import prefetch
from cutting_trainer.tissue_sim.elasticity.tensor_mass import ONE_MATERIAL, shape_gradients
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, grown
from cutting_trainer.tissue_sim.mesh.topology import of_region

KEPT = 15
"""Slots of an element: three gradients, rotation, 2 mu V, lambda V."""


class Elements(NamedTuple):
    """Chunks of elements; unused slots have zero stiffness.

    Attributes:
        corners: three times the nodes, four slots of LANES a chunk, shape (4 LANES k,).
        data: KEPT slots of LANES a chunk: gradients of shape functions 1 to 3 [1/m], quaternion,
            2 mu V and lambda V [J], shape (KEPT LANES k,).
    """

    corners: np.ndarray
    data: np.ndarray


@kernel
def gather_elements(elements, links, rest, which, count, lame_lambda, lame_mu, relative):
    """Write the slots of some elements, with identity rotations.

    Args:
        elements: written for `which` only.
        links: connectivity.
        rest: rest positions [m], shape (n, 3).
        which: slots; those from `count` on are cleared, shape (r,).
        count: number of elements m.
        lame_lambda, lame_mu: [Pa].
        relative: stiffness by region, relative to these.
    """
    tetrahedra, g = links.tetrahedra, np.empty((4, 3))
    for tet in which:
        chunk, lane = tet // LANES, tet % LANES
        at = chunk * KEPT * LANES + lane
        for k in range(KEPT):
            elements.data[at + k * LANES] = 0.0
        elements.data[at + ROTATION * LANES] = 1.0
        for a in range(4):
            elements.corners[(4 * chunk + a) * LANES + lane] = 0
        if tet < count:
            volume = shape_gradients(rest, tetrahedra, tet, g) * of_region(links, tet, relative)
            for a in range(4):
                node = tetrahedra[tet, a]
                elements.corners[(4 * chunk + a) * LANES + lane] = 3 * node
            for k in range(9):
                elements.data[at + k * LANES] = g[1 + k // 3, k % 3]
            elements.data[at + 13 * LANES] = 2.0 * lame_mu * volume
            elements.data[at + 14 * LANES] = lame_lambda * volume


_U1, _U2 = np.uint32(1), np.uint32(2)
_LINE = np.uint64(8)


@inner(fastmath=SAFE_MATH, error_model='numpy')
def chunk_deformation(data, corners, u, chunk, unit):
    """Write the gradients of a chunk's elements in its slots 0 to 8: F = unit I + sum u_b g_b^T."""
    L = LANES
    D, C, E = data[0 : KEPT * L], corners[0 : 4 * L], chunk[0 : SLOTS * L]
    for b in range(6 * L):
        E[ROTATION * L + b] = D[ROTATION * L + b]
    for b in range(L):
        i, j = np.uint32(C[b]), np.uint32(C[L + b])
        k, m = np.uint32(C[2 * L + b]), np.uint32(C[3 * L + b])
        here = np.uint64(KEPT * (L + b))
        prefetch(data, here)  # the next chunk
        prefetch(data, here + _LINE)
        x, y, z = u[i], u[i + _U1], u[i + _U2]
        E[b], E[b + 3 * L], E[b + 6 * L] = u[j] - x, u[j + _U1] - y, u[j + _U2] - z
        E[b + L], E[b + 4 * L], E[b + 7 * L] = u[k] - x, u[k + _U1] - y, u[k + _U2] - z
        E[b + 2 * L], E[b + 5 * L], E[b + 8 * L] = u[m] - x, u[m + _U1] - y, u[m + _U2] - z
    for b in range(L):
        a0, a1, a2 = D[b], D[b + L], D[b + 2 * L]
        b0, b1, b2 = D[b + 3 * L], D[b + 4 * L], D[b + 5 * L]
        c0, c1, c2 = D[b + 6 * L], D[b + 7 * L], D[b + 8 * L]
        x, y, z = E[b], E[b + L], E[b + 2 * L]
        E[b] = unit + x * a0 + y * b0 + z * c0
        E[b + L], E[b + 2 * L] = x * a1 + y * b1 + z * c1, x * a2 + y * b2 + z * c2
        x, y, z = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        E[b + 4 * L] = unit + x * a1 + y * b1 + z * c1
        E[b + 3 * L], E[b + 5 * L] = x * a0 + y * b0 + z * c0, x * a2 + y * b2 + z * c2
        x, y, z = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        E[b + 8 * L] = unit + x * a2 + y * b2 + z * c2
        E[b + 6 * L], E[b + 7 * L] = x * a0 + y * b0 + z * c0, x * a1 + y * b1 + z * c1


@inner(fastmath=SAFE_MATH, error_model='numpy')
def _scatter(data, corners, chunk, f):
    """Add the nodal forces V P g_b of a chunk."""
    L = LANES
    D, C, E = data[0 : KEPT * L], corners[0 : 4 * L], chunk[0 : SLOTS * L]
    for b in range(L):
        p0, p1, p2 = E[b], E[b + L], E[b + 2 * L]
        p3, p4, p5 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        p6, p7, p8 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        a0, a1, a2 = D[b], D[b + L], D[b + 2 * L]
        b0, b1, b2 = D[b + 3 * L], D[b + 4 * L], D[b + 5 * L]
        c0, c1, c2 = D[b + 6 * L], D[b + 7 * L], D[b + 8 * L]
        E[b] = p0 * a0 + p1 * a1 + p2 * a2
        E[b + L] = p3 * a0 + p4 * a1 + p5 * a2
        E[b + 2 * L] = p6 * a0 + p7 * a1 + p8 * a2
        E[b + 3 * L] = p0 * b0 + p1 * b1 + p2 * b2
        E[b + 4 * L] = p3 * b0 + p4 * b1 + p5 * b2
        E[b + 5 * L] = p6 * b0 + p7 * b1 + p8 * b2
        E[b + 6 * L] = p0 * c0 + p1 * c1 + p2 * c2
        E[b + 7 * L] = p3 * c0 + p4 * c1 + p5 * c2
        E[b + 8 * L] = p6 * c0 + p7 * c1 + p8 * c2
    for b in range(L):
        i, j = np.uint32(C[b]), np.uint32(C[L + b])
        k, m = np.uint32(C[2 * L + b]), np.uint32(C[3 * L + b])
        x0, y0, z0 = E[b], E[b + L], E[b + 2 * L]
        x1, y1, z1 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        x2, y2, z2 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        f[i] -= x0 + x1 + x2
        f[i + _U1] -= y0 + y1 + y2
        f[i + _U2] -= z0 + z1 + z2
        f[j] += x0
        f[j + _U1] += y0
        f[j + _U2] += z0
        f[k] += x1
        f[k + _U1] += y1
        f[k + _U2] += z1
        f[m] += x2
        f[m + _U1] += y2
        f[m + _U2] += z2


@inner(error_model='numpy')
def add_elements(elements, awake, u, f, rotation_steps, unit):
    """Add the elements' forces.

    Args:
        elements: the chunks; their rotations follow u by `rotation_steps` steps.
        awake: which chunks, shape (k,).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
        rotation_steps: iterations of the rotations; negative: until convergence.
        unit: 1 for forces, 0 for the product of stiffness and u under present rotations.

    Returns:
        Their elastic energy [J].
    """
    chunk = np.empty(SLOTS * LANES)
    energy = 0.0
    for k in awake:
        data = elements.data[k * KEPT * LANES : (k + 1) * KEPT * LANES]
        corners = elements.corners[4 * k * LANES : 4 * (k + 1) * LANES]
        chunk_deformation(data, corners, u, chunk, unit)
        for _ in range(rotation_steps):
            rotation_step(chunk)
        if rotation_steps < 0:
            settle(chunk, 1e-14, 100)
        if rotation_steps != 0:
            for i in range(ROTATION * LANES, SHEAR * LANES):
                data[i] = chunk[i]
        stress(chunk, unit)
        for i in range(ENERGY * LANES, (ENERGY + 1) * LANES):
            energy += chunk[i]
        _scatter(data, corners, chunk, f)
    return energy


class CorotationalElements:
    """Corotational elements of a mesh under cuts.

    Args:
        mesh: the mesh; followed by `update`.
        lame_lambda, lame_mu: [Pa].
        relative: stiffness by region, relative to these.
    """

    def __init__(
        self,
        mesh: TetMesh,
        lame_lambda: float,
        lame_mu: float,
        relative: np.ndarray = ONE_MATERIAL,
    ) -> None:
        self._mesh = mesh
        self._relative = relative
        self._lame = (lame_lambda, lame_mu)
        self._count = 0
        self._elements = Elements(np.zeros(0, np.uint32), np.zeros(0))
        self.update(np.arange(len(mesh.tetrahedra)))

    def update(self, tetrahedra: np.ndarray) -> None:
        """Recompute elements.

        Args:
            tetrahedra: touched by a change of connectivity or rest positions, shape (r,).
        """
        count = len(self._mesh.tetrahedra)
        chunks = -(-count // LANES)
        known = len(self._elements.data) // (KEPT * LANES)
        self._elements = Elements(
            grown(self._elements.corners, 4 * LANES * chunks),
            grown(self._elements.data, KEPT * LANES * chunks),
        )
        room = len(self._elements.data) // (KEPT * LANES) * LANES
        new = np.arange(known * LANES, room)
        gone = np.arange(count, self._count)
        which = np.unique(np.concatenate([np.asarray(tetrahedra, np.int64), new, gone]))
        gather_elements(
            self._elements, self._mesh.links, self._mesh.rest, which, count, *self._lame,
            self._relative,
        )  # fmt: skip
        self._count = count

    @property
    def operands(self) -> Elements:
        """Return the used chunks, for `add_elements`."""
        chunks = -(-self._count // LANES)
        return Elements(
            self._elements.corners[: 4 * LANES * chunks],
            self._elements.data[: KEPT * LANES * chunks],
        )
