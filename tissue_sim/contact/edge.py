"""Kernels of the blade's edge: its points in the air, its length in the tissue, its resistance."""

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.contact.fracture import look_ahead
from cutting_trainer.tissue_sim.mesh.locate import locate_points

_TINY = 1e-300


@kernel
def lag_behind(device, points, inside, shares):
    """Return the points, with those in the air as far behind as the nearest in the tissue.

    Between two points in the tissue, the lag is interpolated.

    Args:
        device: points of the device's edge [m], shape (p, 3).
        points: those of the edge [m], shape (p, 3).
        inside: which are in the tissue, shape (p,).
        shares: their places along the edge, ascending, shape (p,).

    Returns:
        A new array [m], shape (p, 3); the device's points where none is in the tissue.
    """
    count, out, last = len(points), device.copy(), -1
    for i in range(count):
        if inside[i]:
            out[i] = points[i]
            last = i
            continue
        ahead = i + 1
        while ahead < count and not inside[ahead]:
            ahead += 1
        if last < 0 and ahead == count:
            return out
        first, second = last if last >= 0 else ahead, ahead if ahead < count else last
        part = 0.0
        if first != second:
            part = (shares[i] - shares[first]) / (shares[second] - shares[first])
        for c in range(3):
            lag = (1.0 - part) * (device[first, c] - points[first, c])
            out[i, c] -= lag + part * (device[second, c] - points[second, c])
    return out


@kernel
def measure_lengths(positions, tetrahedra, neighbors, points, inside, piece, parts, hint):
    """Return how much of the edge each point stands for [pieces], shape (p,).

    At the end of the tissue it is the rest up to there, so that the force does not change in steps
    of a piece as the blade goes in.

    Args:
        positions: nodes now [m], shape (n, 3).
        tetrahedra, neighbors: of the mesh, shape (m, 4).
        points: of the edge [m], shape (p, 3).
        inside: which are in the tissue, shape (p,).
        piece: from a point to the next [m], shape (3,).
        parts: places of a piece at which the end of the tissue is looked for, shape (q,).
        hint: a tetrahedron near the edge.
    """
    count, tested = len(points), len(parts)
    lengths = np.ones(count)
    beyond, found = np.empty((tested, 3)), np.empty(tested, np.int64)
    weights = np.empty((tested, 4))
    for i in range(count):
        for step in (-1, 1):
            beside = i + step
            if not inside[i] or beside < 0 or beside >= count or inside[beside]:
                continue
            for k in range(tested):
                for c in range(3):
                    beyond[k, c] = points[i, c] + step * parts[k] * piece[c]
            locate_points(positions, tetrahedra, neighbors, beyond, hint, found, weights)
            reached = 0
            while reached < tested and found[reached] >= 0:
                reached += 1
            lengths[i] += reached / tested - 0.5
        lengths[i] = max(lengths[i], parts[0])
    return lengths


@kernel
def resist(points, ways, cuts, pieces, edge, toughness, friction, reach, ahead):
    """Return which points meet uncut tissue, and the largest force of each piece of the edge.

    Args:
        points: in the tissue [m], shape (p, 3).
        ways: along which they are pulled [m]; changed as by `look_ahead`, shape (p, 3).
        cuts: triangles of cuts near the edge [m], shape (t, 3, 3).
        pieces: lengths of the pieces [m], shape (p,).
        edge: unit vector along the edge, shape (3,).
        toughness: [J/m^2].
        friction: per length [N/m].
        reach, ahead: as of `look_ahead` [m].

    Returns:
        1 where uncut tissue is ahead, else 0, shape (p,), and the forces J l sin(edge, way) +
        friction [N], shape (p,).
    """
    count = len(points)
    fresh, limits = np.empty(count), np.empty(count)
    look_ahead(points, ways, cuts, reach, ahead, fresh)
    for i in range(count):
        x, y, z = ways[i, 0], ways[i, 1], ways[i, 2]
        a, b, c = y * edge[2] - z * edge[1], z * edge[0] - x * edge[2], x * edge[1] - y * edge[0]
        size = max(np.sqrt(x * x + y * y + z * z), _TINY)
        sine = np.sqrt(a * a + b * b + c * c) / size
        limits[i] = pieces[i] * (fresh[i] * toughness * sine + friction)
    return fresh, limits
