"""Contact of cut faces: they meet without tension, slide with friction, and close.

A node of a cut face meets at most one triangle of another, where their normals are opposed and they
are near. In each substep an impulse keeps the node out of the triangle: on the node, and by the
weights of the foot on the triangle's nodes, so that momentum is conserved. Along the face an
impulse within the cone of Coulomb holds the node. The scheme is Moreau's, inelastic and of first
order. The impulses of one substep act from the begin of the next, which corrects them once.

Moreau, J. J.: Unilateral contact and dry friction in finite freedom dynamics. 1988.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.contact.cut_contact_search import (
    NO_NEAR_FACES,
    REACH,
    NearFaces,
    find_contacts,
    foot,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import (
    TetMesh,
    TopologyDelta,
    Touched,
    carried_over,
    grown,
)
from cutting_trainer.tissue_sim.mesh.topology import CUT

CUT_FRICTION = 0.3
"""Coefficient of friction between cut faces of tissue. Without any, a piece that is wedged in its
hole creeps out for seconds. That of muscle on bone: Shacham, S., Castel, D., Gefen, A.:
Measurements of the static friction coefficient between bone and muscle tissues. J. Biomech. Eng.
132, 2010."""
MAX_LOOKS = 6
"""Searches for what is near, in a frame."""
_RECOVERY = 0.1
"""Share of a depth that is taken back in a substep."""
_MAX_RECOVERY = 0.05
"""[m/s] of that at most."""
_MAX_WEIGHT = 2.0
"""Largest weight of a node of a triangle. Where the foot is farther off, as beside a triangle that
is pressed flat, there is no contact: a small impulse would throw the triangle's nodes away."""
_MAX_LEVER = 10.0
"""Largest way of a node for a change of the gap. Where node and foot are held, and only a corner
far from the foot moves, there is no contact: closing the gap would throw that corner away."""


class CutContacts(NamedTuple):
    """NearFaces as operand of the integrators' kernels.

    Attributes:
        at: first coordinates of the nodes, shape (c, 4).
        rest, smooth: see `NearFaces`.
        inverse: of the masses of the nodes, 0 where fixed [1/kg], shape (c, 4).
        weights: of the node, 1, and less those of the triangle's nodes at its foot, changed, shape
            (c, 4).
        normals: outward unit normals of the smooth surface there, changed, shape (c, 3).
        pulls: force on the node in the last substep, changed [N], shape (c, 3).
        gaps: at its end, changed [m], shape (c,).
        speeds: relative velocity at its end, changed [m/s], shape (c, 3).
        scalars: coefficient of friction; energy lost, and work by which faces that were in one
            another were moved apart [J], changed; shape (3,).
    """

    at: np.ndarray
    rest: np.ndarray
    smooth: np.ndarray
    inverse: np.ndarray
    weights: np.ndarray
    normals: np.ndarray
    pulls: np.ndarray
    gaps: np.ndarray
    speeds: np.ndarray
    scalars: np.ndarray


NO_CUT_CONTACTS = CutContacts(
    *NO_NEAR_FACES,
    np.zeros((0, 4)),
    np.zeros((0, 4)),
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros(3),
)


@inner
def _difference(faces, values, c):
    """Return the coordinates of a node less those of its foot."""
    at, weights = faces.at, faces.weights
    a, b, d, e = at[c, 0], at[c, 1], at[c, 2], at[c, 3]
    r, s, t = weights[c, 1], weights[c, 2], weights[c, 3]
    x = values[a] + r * values[b] + s * values[d] + t * values[e]
    y = values[a + 1] + r * values[b + 1] + s * values[d + 1] + t * values[e + 1]
    z = values[a + 2] + r * values[b + 2] + s * values[d + 2] + t * values[e + 2]
    return x, y, z


@inner
def _push(faces, c, x, y, z, u, v, q, beta, dt):
    """Apply an impulse [N s] to the nodes of a contact."""
    ahead = dt + beta
    for k in range(4):
        at, share = faces.at[c, k], faces.weights[c, k] * faces.inverse[c, k]
        v[at] += share * x
        v[at + 1] += share * y
        v[at + 2] += share * z
        u[at] += dt * share * x
        u[at + 1] += dt * share * y
        u[at + 2] += dt * share * z
        q[at] += ahead * share * x
        q[at + 1] += ahead * share * y
        q[at + 2] += ahead * share * z


@inner
def _corner(faces, c, k, u):
    """Return the position of a node of a contact [m]."""
    rest, at = faces.rest, faces.at[c, k]
    return rest[c, k, 0] + u[at], rest[c, k, 1] + u[at + 1], rest[c, k, 2] + u[at + 2]


@inner
def _place(faces, c, u):
    """Write normal and foot of a contact as they are now; return the gap along the normal [m]."""
    smooth, weights, normals = faces.smooth, faces.weights, faces.normals
    x, y, z = _corner(faces, c, 1, u)
    ax, ay, az = _corner(faces, c, 2, u)
    bx, by, bz = _corner(faces, c, 3, u)
    px, py, pz = _corner(faces, c, 0, u)
    ax, ay, az, bx, by, bz = ax - x, ay - y, az - z, bx - x, by - y, bz - z
    px, py, pz = px - x, py - y, pz - z
    second, third = foot(ax, ay, az, bx, by, bz, px, py, pz)
    first = 1.0 - second - third
    weights[c, 0], weights[c, 1], weights[c, 2], weights[c, 3] = 1.0, -first, -second, -third
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    size = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
    r = first * smooth[c, 0, 0] + second * smooth[c, 1, 0] + third * smooth[c, 2, 0]
    s = first * smooth[c, 0, 1] + second * smooth[c, 1, 1] + third * smooth[c, 2, 1]
    t = first * smooth[c, 0, 2] + second * smooth[c, 1, 2] + third * smooth[c, 2, 2]
    t /= size
    mx, my, mz = r * ax + s * bx + t * nx, r * ay + s * by + t * ny, r * az + s * bz + t * nz
    length = max(np.sqrt(mx * mx + my * my + mz * mz), 1e-300)
    mx, my, mz = mx / length, my / length, mz / length
    normals[c, 0], normals[c, 1], normals[c, 2] = mx, my, mz
    return (px * nx + py * ny + pz * nz) * (mx * nx + my * ny + mz * nz) / (size * size)


@inner
def _resolve(faces, c, u, v, q, beta, dt, wanted, response):
    """Correct the force of one contact, and with it the motion of its nodes.

    Args:
        wanted: relative displacement along the normal at the end of the substep [m].
        response: change of the relative velocity by an impulse [1/kg].
    """
    pulls, friction = faces.pulls, faces.scalars[0]
    nx, ny, nz = faces.normals[c, 0], faces.normals[c, 1], faces.normals[c, 2]
    fx, fy, fz = pulls[c, 0], pulls[c, 1], pulls[c, 2]
    x, y, z = _difference(faces, u, c)
    pressed = fx * nx + fy * ny + fz * nz
    now = pressed + (wanted - x * nx - y * ny - z * nz) / (dt * dt * response)
    if now <= 0.0:
        if fx == 0.0 and fy == 0.0 and fz == 0.0:
            return
        now = 0.0
    x, y, z = now * nx, now * ny, now * nz
    if friction > 0.0:
        vx, vy, vz = _difference(faces, v, c)
        off, slip = vx * nx + vy * ny + vz * nz, 1.0 / (dt * response)
        sx = fx - pressed * nx - slip * (vx - off * nx)
        sy = fy - pressed * ny - slip * (vy - off * ny)
        sz = fz - pressed * nz - slip * (vz - off * nz)
        side = np.sqrt(sx * sx + sy * sy + sz * sz)
        grip = min(1.0, friction * now / max(side, 1e-300))
        x, y, z = x + grip * sx, y + grip * sy, z + grip * sz
    _push(faces, c, dt * (x - fx), dt * (y - fy), dt * (z - fz), u, v, q, beta, dt)
    pulls[c, 0], pulls[c, 1], pulls[c, 2] = x, y, z


@kernel(error_model='numpy')
def subtract_pulls(faces, f):
    """Subtract the forces of the last substep from the elastic force [N], shape (3 n,)."""
    at, weights, pulls = faces.at, faces.weights, faces.pulls
    for c in range(at.shape[0]):
        for k in range(4):
            for i in range(3):
                f[at[c, k] + i] -= weights[c, k] * pulls[c, i]


@kernel(error_model='numpy')
def meet(faces, u, v, q, beta, dt):
    """Keep cut faces out of each other at the end of a substep; it had the forces of the last one.

    Args:
        faces: see `CutContacts`.
        u, v: displacement [m] and velocity [m/s], changed, shape (3 n,).
        q: u + beta v, changed.
        beta: damping [s].
        dt: substep [s].
    """
    count, pulls, weights, speeds = faces.at.shape[0], faces.pulls, faces.weights, faces.speeds
    normals = faces.normals
    offsets, wanted, response = np.empty(count), np.empty(count), np.zeros(count)
    for c in range(count):
        gap, depth = _place(faces, c, u), max(-faces.gaps[c], 0.0)
        x, y, z = _difference(faces, u, c)
        offsets[c] = gap - x * normals[c, 0] - y * normals[c, 1] - z * normals[c, 2]
        wanted[c] = min(_RECOVERY * depth, _MAX_RECOVERY * dt) - depth - offsets[c]
        largest = farthest = 0.0
        for k in range(4):
            weight = abs(weights[c, k])
            largest, farthest = max(largest, weight), max(farthest, weight * faces.inverse[c, k])
            response[c] += weight * weight * faces.inverse[c, k]
        if not (largest <= _MAX_WEIGHT and farthest <= _MAX_LEVER * response[c]):
            pulls[c, 0] = pulls[c, 1] = pulls[c, 2] = response[c] = 0.0
    for c in range(count):
        if response[c] > 0.0:
            _resolve(faces, c, u, v, q, beta, dt, wanted[c], response[c])
    for c in range(count):
        x, y, z = _difference(faces, u, c)
        nx, ny, nz = normals[c, 0], normals[c, 1], normals[c, 2]
        gap = offsets[c] + x * nx + y * ny + z * nz
        pressed = pulls[c, 0] * nx + pulls[c, 1] * ny + pulls[c, 2] * nz
        faces.scalars[2] += pressed * max(min(gap, 0.0) - min(faces.gaps[c], 0.0), 0.0)
        faces.gaps[c] = gap
        x, y, z = _difference(faces, v, c)
        work = pulls[c, 0] * (speeds[c, 0] + x) + pulls[c, 1] * (speeds[c, 1] + y)
        faces.scalars[1] -= 0.5 * dt * (work + pulls[c, 2] * (speeds[c, 2] + z))
        speeds[c, 0], speeds[c, 1], speeds[c, 2] = x, y, z


@kernel(error_model='numpy')
def _prepare(contacts, local, friction, pull, u, v):
    """Return the operand of the kernels.

    Args:
        contacts: see `NearFaces`.
        local: nodes as u and v number them, shape (c, 4).
        friction: coefficient.
        pull: force on each node of the tissue in the last substep [N], shape (n, 3).
        u, v: displacement [m] and velocity [m/s], shape (3 n,).
    """
    count = len(local)
    faces = CutContacts(
        3 * local, contacts.rest, contacts.smooth, np.zeros((count, 4)), np.empty((count, 4)),
        np.empty((count, 3)), np.zeros((count, 3)), np.empty(count), np.empty((count, 3)),
        np.zeros(3),
    )  # fmt: skip
    faces.scalars[0] = friction
    for c in range(count):
        faces.gaps[c] = _place(faces, c, u)
        faces.speeds[c, 0], faces.speeds[c, 1], faces.speeds[c, 2] = _difference(faces, v, c)
        node, pressed, side = contacts.nodes[c, 0], 0.0, 0.0
        for i in range(3):
            pressed += pull[node, i] * faces.normals[c, i]
        if pressed <= 0.0:
            continue
        for i in range(3):
            side += (pull[node, i] - pressed * faces.normals[c, i]) ** 2
        grip = min(1.0, friction * pressed / max(np.sqrt(side), 1e-300))
        for i in range(3):
            along = pressed * faces.normals[c, i]
            faces.pulls[c, i] = along + grip * (pull[node, i] - along)
    return faces


class CutContact:
    """Contact of the faces of all cuts in a tissue.

    Args:
        mesh: the tissue.
        friction: coefficient of dry friction between them.

    Attributes:
        lost: energy lost to friction and by faces that meet, since the start [J].
        recovered: work by which faces that were in one another were moved apart [J].
    """

    def __init__(self, mesh: TetMesh, friction: float) -> None:
        self._mesh = mesh
        self._friction = friction
        self._pull = np.zeros((0, 3))
        self.lost = self.recovered = 0.0

    @property
    def possible(self) -> bool:
        """Whether there are cut faces."""
        return bool((self._mesh.triangle_kind == CUT).any())

    def find(self, u: np.ndarray, v: np.ndarray, dt: float, substeps: int) -> tuple[NearFaces, int]:
        """Return the contacts that are near now, and for how many substeps they are known.

        Args:
            u, v: displacement [m] and velocity [m/s], shape (n, 3).
            dt: substep [s].
            substeps: of a frame.
        """
        mesh, least = self._mesh, max(substeps // MAX_LOOKS, 1)
        self._pull = grown(self._pull, mesh.node_count)
        contacts, fastest = find_contacts(mesh.links, mesh.rest, u, v, least * dt)
        nodes = contacts.nodes[:, 0]
        pull = self._pull[nodes]
        self._pull[:] = 0.0
        self._pull[nodes] = pull
        known = REACH / (2 * dt * fastest) if 0.0 < fastest < np.inf else 0.0 if fastest else np.inf
        return contacts, int(max(min(known, substeps), least))

    def operand(
        self,
        contacts: NearFaces,
        local: np.ndarray,
        u: np.ndarray,
        v: np.ndarray,
    ) -> CutContacts:
        """Return the operand of the kernels, which lacks the inverse masses.

        Args:
            contacts: near.
            local: their nodes as u and v number them, shape (c, 4).
            u, v: displacement [m] and velocity [m/s], shape (3 n,).
        """
        faces: CutContacts = _prepare(contacts, local, self._friction, self._pull, u, v)
        return faces

    def keep(self, contacts: NearFaces, faces: CutContacts) -> None:
        """Keep the forces that the kernels have found, and the energy lost."""
        self._pull[contacts.nodes[:, 0]] = faces.pulls
        self.lost += float(faces.scalars[1])
        self.recovered += float(faces.scalars[2])
        faces.scalars[1:] = 0.0

    def force(self, contacts: NearFaces, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the forces of cut faces on all nodes [N], shape (n, 3).

        Args:
            contacts: near.
            u, v: displacement [m] and velocity [m/s], shape (3 n,).
        """
        out = np.zeros(3 * self._mesh.node_count)
        faces = self.operand(contacts, contacts.nodes, u, v)
        subtract_pulls(faces, out)
        return -out.reshape(-1, 3)

    def kept(self) -> tuple[np.ndarray, float, float]:
        """Return a copy of the state for `restore`."""
        return self._pull.copy(), self.lost, self.recovered

    def restore(self, kept: tuple[np.ndarray, float, float]) -> None:
        """Return to a state of `kept`, which stays as it is."""
        self._pull, self.lost, self.recovered = kept[0].copy(), *kept[1:]

    def release(self) -> None:
        """Begin without forces."""
        self._pull[:] = 0.0

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Carry the forces through a change of connectivity.

        Args:
            count: of nodes before it.
            delta: the change, which the mesh has followed.
            touched: the written slots.
        """
        self._pull = grown(self._pull, count + len(delta.node_parents))
        carried_over(self._pull, count, delta, touched)
