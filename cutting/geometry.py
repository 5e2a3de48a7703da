"""Exact-sign intersection tests of segments, triangles and tetrahedra, for the swept blade."""

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.mesh.locate import orientation
from cutting_trainer.tissue_sim.mesh.topology import FACE_NODES

EDGE_NODES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
"""Local nodes of the six edges of a tetrahedron."""


@inner
def height(normal, point, x):
    """Return height of x above the plane through a point with that normal, each shape (3,)."""
    return (
        normal[0] * (x[0] - point[0])
        + normal[1] * (x[1] - point[1])
        + normal[2] * (x[2] - point[2])
    )


@inner
def altitude(a, b, c, d):
    """Return the smallest altitude of the tetrahedron a b c d [m], negative if inverted."""
    largest = 0.0
    for p, q, r in ((a, b, c), (a, b, d), (a, c, d), (b, c, d)):
        ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        largest = max(largest, x * x + y * y + z * z)
    return orientation(a, b, c, d) / np.sqrt(largest)


@inner
def segment_meets_triangle(p, q, a, b, c):
    """Return whether the segment p q crosses the triangle a b c or touches it; not for coplanar
    ones.
    """
    above, below = orientation(a, b, c, p), orientation(a, b, c, q)
    if above * below > 0.0 or (above == 0.0 and below == 0.0):
        return False
    s, t, u = orientation(p, q, a, b), orientation(p, q, b, c), orientation(p, q, c, a)
    return (s >= 0.0 and t >= 0.0 and u >= 0.0) or (s <= 0.0 and t <= 0.0 and u <= 0.0)


@inner
def _inside(positions, corners, point):
    for face in range(4):
        a = positions[corners[FACE_NODES[face, 0]]]
        b = positions[corners[FACE_NODES[face, 1]]]
        c = positions[corners[FACE_NODES[face, 2]]]
        if orientation(a, b, c, point) > 0.0:
            return False
    return True


@inner
def triangle_meets_tetrahedron(a, b, c, positions, corners):
    """Return whether a triangle and a tetrahedron share a point.

    Args:
        a, b, c: corners of the triangle [m], shape (3,).
        positions: nodes [m], shape (n, 3).
        corners: nodes of the tetrahedron, positively oriented, shape (4,).
    """
    for i in range(3):
        low, high = np.inf, -np.inf
        for k in range(4):
            low = min(low, positions[corners[k], i])
            high = max(high, positions[corners[k], i])
        if min(a[i], b[i], c[i]) > high or max(a[i], b[i], c[i]) < low:
            return False
    for edge in range(6):
        p, q = positions[corners[EDGE_NODES[edge, 0]]], positions[corners[EDGE_NODES[edge, 1]]]
        if segment_meets_triangle(p, q, a, b, c):
            return True
    for face in range(4):
        p = positions[corners[FACE_NODES[face, 0]]]
        q = positions[corners[FACE_NODES[face, 1]]]
        r = positions[corners[FACE_NODES[face, 2]]]
        if (
            segment_meets_triangle(a, b, p, q, r)
            or segment_meets_triangle(b, c, p, q, r)
            or segment_meets_triangle(c, a, p, q, r)
        ):
            return True
    return _inside(positions, corners, a)


@inner
def sweep_meets(quad, positions, corners):
    """Return whether the sweep, two triangles with the diagonal from corner 0 to 2, meets a
    tetrahedron.

    Args:
        quad: root before, tip before, tip after, root after [m], shape (4, 3).
        positions: nodes [m], shape (n, 3).
        corners: nodes of the tetrahedron, shape (4,).
    """
    return triangle_meets_tetrahedron(
        quad[0], quad[1], quad[2], positions, corners
    ) or triangle_meets_tetrahedron(quad[0], quad[2], quad[3], positions, corners)


@kernel
def _altitudes(rest, tetrahedra, out):
    for k in range(len(out)):
        a, b, c, d = tetrahedra[k, 0], tetrahedra[k, 1], tetrahedra[k, 2], tetrahedra[k, 3]
        out[k] = altitude(rest[a], rest[b], rest[c], rest[d])


def smallest_altitudes(rest: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the smallest altitude of each tetrahedron [m], shape (m,)."""
    out = np.empty(len(tetrahedra))
    _altitudes(rest, np.ascontiguousarray(tetrahedra, np.int64), out)
    return out
