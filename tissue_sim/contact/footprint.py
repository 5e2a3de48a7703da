"""Footprint of the tool: the surface nodes that share its load, whatever the mesh.

The load of a sphere acts on a disc of Hertz's radius a, which may be smaller than an element. The
nodes therefore share a smooth pressure on a disc that the mesh can resolve, and the coupling spring
gets the difference: the settlement under Hertz's pressure less that under the smooth one, both of a
half-space (`Springs`). The mesh has the part that is far from the tool; the part near it is
exact.
"""

import math
from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.node_common.vectors import area_vector, norm
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched, carried_over
from cutting_trainer.tissue_sim.mesh.topology import Links

SETTLEMENT = 36 * 120 * math.sqrt(math.pi) / (math.gamma(3.5) ** 2 * math.gamma(6.5) * math.pi)
"""Mean settlement of a half-space under the smooth pressure, times E* b / force: 0.7665. For a
pressure (1 - r^2/b^2)^q it is the integral of the squared Hankel transform of the pressure."""
WIDENING = 1.6
"""Least ratio of the disc's radius to Hertz's a. From 2 SETTLEMENT = 1.53 on, the spring in series
is never stiffer than the coupling spring."""
RESOLVED = 1.5
"""Least ratio of the disc's radius to the size of the elements."""
_FINENESS = 4.0
"""Points of the quadrature over the disc's radius, at least."""
_MAX_PARTS = 16


class Footprint(NamedTuple):
    """Nodes that share the load of a tool.

    Attributes:
        nodes: each once, sorted, shape (c,).
        weights: positive, sum 1, shape (c,).
        radius: of a whole disc with the same area under load [m]; 0: the load is not spread.
        height: of the nodes' weighted mean over the touched point at rest [m]: on a dome below 0.
    """

    nodes: np.ndarray
    weights: np.ndarray
    radius: float
    height: float


class Scratch(NamedTuple):
    """Work space of `_spread`, left as it was found.

    Attributes:
        known: triangles that are listed, all False, shape (>= k,).
        queue: triangles, shape (>= k,).
        share: integrals by node, all 0, shape (>= n,).
        found: nodes, shape (>= n,).
    """

    known: np.ndarray
    queue: np.ndarray
    share: np.ndarray
    found: np.ndarray


class Footprints:
    """Finds footprints on a tissue.

    Args:
        mesh: the tissue, not cut yet; followed by `apply_cut`.
    """

    __slots__ = ('__dict__', '_scratch')  # not in the recorded state, which is what `vars` has

    def __init__(self, mesh: TetMesh) -> None:
        self._mesh = mesh
        self._sizes = node_sizes(mesh)[:, None]

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Follow a change of connectivity; new nodes have the size of the elements around before.

        Args:
            count: of nodes before.
            delta, touched: as for `carried_over`.
        """
        sizes = np.zeros((count + len(delta.node_parents), 1))
        sizes[:count] = self._sizes[:count]
        carried_over(sizes, count, delta, touched)
        self._sizes = sizes[: self._mesh.node_count].copy()

    def radius(self, nodes: np.ndarray, weights: np.ndarray, hertz: float) -> float:
        """Return the radius of the disc for a contact [m].

        Args:
            nodes, weights: of the touched point, shape (c,).
            hertz: radius of Hertz's contact [m].
        """
        return max(WIDENING * hertz, RESOLVED * float(weights @ self._sizes[nodes, 0]))

    def around(self, nodes: np.ndarray, weights: np.ndarray, radius: float) -> Footprint:
        """Return the footprint around a touched point, on the surface that can be reached from it.

        Lengths are those at rest: a dent or a bent flap does not change them. Nodes that do not
        move take no part.

        Args:
            nodes, weights: of the touched point, shape (c,).
            radius: of the disc [m].
        """
        mesh = self._mesh
        centre = weights @ mesh.rest[nodes]
        outward = np.zeros(3)
        work = self._work()
        found, shares = _spread(mesh.links, mesh.rest, nodes, centre, radius, outward, work)
        covered = min(3 * float(shares.sum()) / (math.pi * radius**2), 1.0)
        moves = mesh.fixed[found] == 0
        found, shares = found[moves], shares[moves]
        if not shares.sum() > 0.0:
            return Footprint(nodes, weights, 0.0, 0.0)
        order = np.argsort(found)
        found, shares = found[order], shares[order] / shares.sum()
        height = float((shares @ mesh.rest[found] - centre) @ outward)
        return Footprint(found, shares, radius * math.sqrt(covered), height)

    def _work(self) -> Scratch:
        """Return the work space, made anew only where the mesh has outgrown it."""
        triangles, nodes = int(self._mesh.links.counts[1]), len(self._mesh.rest)
        work: Scratch | None = getattr(self, '_scratch', None)
        if work is None or len(work.known) < triangles or len(work.share) < nodes:
            k, n = 2 * triangles, 2 * nodes
            work = Scratch(
                np.zeros(k, np.bool_), np.empty(k, np.int64), np.zeros(n), np.empty(n, np.int64)
            )
            self._scratch = work
        return work


def node_sizes(mesh: TetMesh) -> np.ndarray:
    """Return the size of the elements at each node [m], shape (n,).

    It is the edge of a regular tetrahedron with the mean volume of the node's elements.
    """
    nodes, volumes = mesh.tetrahedra.ravel(), np.repeat(np.abs(mesh.volumes()), 4)
    count = np.bincount(nodes, minlength=mesh.node_count)
    mean = np.bincount(nodes, volumes, mesh.node_count) / np.maximum(count, 1)
    return np.asarray(np.cbrt(6 * math.sqrt(2) * mean))


@kernel
def _spread(
    links: Links,
    rest: np.ndarray,
    nodes: np.ndarray,
    centre: np.ndarray,
    radius: float,
    outward: np.ndarray,
    work: Scratch,
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the smooth pressure against the shape functions of the surface.

    Args:
        links: of the mesh.
        rest: positions [m], shape (n, 3).
        nodes: of the touched triangles, shape (c,).
        centre: of the disc [m], shape (3,).
        radius: of the disc [m].
        outward: output, mean unit normal of the touched triangles, shape (3,).
        work: its arrays cover the mesh.

    Returns:
        Nodes, each once, and their integrals [m^2], both shape (f,).
    """
    known, queue, share, found = work.known, work.queue, work.share, work.found
    normal = np.empty(3)
    count = _begin(links, rest, nodes, known, queue, outward)
    filled = done = 0
    while done < count:
        triangle = links.triangles[queue[done]]
        done += 1
        area = _unit_normal(rest, triangle, normal)
        facing = normal[0] * outward[0] + normal[1] * outward[1] + normal[2] * outward[2]
        if area == 0.0 or facing <= 0.0:
            continue
        if not _add_shares(rest, triangle, centre, radius, area * facing, share):
            continue
        for node in triangle:
            if share[node] > 0.0:
                seen = False
                for i in range(filled):
                    seen = seen or found[i] == node
                if not seen:
                    found[filled] = node
                    filled += 1
            count = _list_triangles(links, node, known, queue, count)
    for i in range(count):
        known[queue[i]] = False
    found = found[:filled].copy()
    shares = share[found]
    for node in found:
        share[node] = 0.0
    return found, shares


@inner
def _begin(links, rest, nodes, known, queue, outward):
    """List the touched triangles; write their mean normal; return their number.

    A touched edge or corner names fewer than three nodes: those with most of the nodes count.
    """
    count = most = 0
    for node in nodes:
        count = _list_triangles(links, node, known, queue, count)
    listed, count = count, 0
    shared = np.zeros(listed, np.int64)
    for i in range(listed):
        known[queue[i]] = False
        for node in links.triangles[queue[i]]:
            shared[i] += np.any(nodes == node)
        most = max(most, shared[i])
    normal = np.empty(3)
    for i in range(listed):
        triangle = links.triangles[queue[i]]
        if shared[i] == most and _unit_normal(rest, triangle, normal) > 0.0:
            outward += normal
            queue[count] = queue[i]
            count += 1
    for i in range(count):
        known[queue[i]] = True
    size = norm(outward)
    if size > 0.0:
        outward /= size
    return count


@inner
def _list_triangles(links, node, known, queue, count):
    """Append the surface triangles of a node that are not known yet; return the new number."""
    corner = links.first_corner[node]
    while corner >= 0:
        tet, opposite = corner // 4, corner % 4
        for i in range(4):
            slot = links.face_triangle[tet, i]
            if i != opposite and slot >= 0 and not known[slot]:
                known[slot] = True
                queue[count] = slot
                count += 1
        corner = links.corner_next[corner]
    return count


@inner
def _unit_normal(rest, triangle, normal):
    """Write the outward unit normal of a triangle; return its area [m^2], 0 for a sliver."""
    a, b, c = rest[triangle[0]], rest[triangle[1]], rest[triangle[2]]
    area_vector(a, b, c, normal)
    size = norm(normal)
    if size < 1e-18:
        return 0.0
    normal /= size
    return size / 2


@inner
def _add_shares(rest, triangle, centre, radius, area, share):
    """Add the integrals over one triangle; return whether the disc reaches it.

    The triangle is divided into parts that are small against the disc, each with its middle as
    point.
    """
    a, b, c = rest[triangle[0]], rest[triangle[1]], rest[triangle[2]]
    longest = 0.0
    for p, q in ((a, b), (b, c), (c, a)):
        longest = max(longest, (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
    parts = int(min(np.ceil(_FINENESS * np.sqrt(longest) / radius), _MAX_PARTS))
    each = area / (parts * parts)
    reached = False
    for i in range(parts):
        for j in range(parts - i):
            for upper in range(2 if i + j < parts - 1 else 1):
                beta = (i + (1 + upper) / 3.0) / parts
                gamma = (j + (1 + upper) / 3.0) / parts
                alpha = 1.0 - beta - gamma
                away = 0.0
                for axis in range(3):
                    x = alpha * a[axis] + beta * b[axis] + gamma * c[axis] - centre[axis]
                    away += x * x
                inside = 1.0 - away / (radius * radius)
                if inside > 0.0:
                    reached = True
                    value = each * inside * inside
                    share[triangle[0]] += alpha * value
                    share[triangle[1]] += beta * value
                    share[triangle[2]] += gamma * value
    return reached
