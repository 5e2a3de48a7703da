"""Kernels that find which part of the blade's edge is in the tissue, and where."""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner
from cutting_trainer.node_common.vectors import assign_all, differences, dot, sum_of
from cutting_trainer.tissue_sim.contact.fracture import BLADE_THICKNESS
from cutting_trainer.tissue_sim.mesh.locate import locate_points

POINTS = 48
SHARES = (np.arange(POINTS) + 0.5) / POINTS
"""Places of the points along the edge, from its tip to its root."""
_TESTS = 8
"""Places of a piece at which the end of the tissue is looked for."""
_MAX_STEPS = 100
"""Places at which tissue is looked for between an edge in the air and the device's."""
SETTLED = 1e-6
"""[m] of slip below which the edge counts as at rest."""


class Edge(NamedTuple):
    """Points along the blade's edge, from its tip to its root; kernels change them in place.

    Attributes:
        points: [m], shape (POINTS, 3).
        corners: nodes of the tetrahedron around each, shape (POINTS, 4).
        weights: barycentric coordinates in it, shape (POINTS, 4).
        spans: how much of the edge each stands for [pieces]; 0: in the air, shape (POINTS,).
        hint: a tetrahedron near the edge, shape (1,).
        region: of the tissue around each, shape (POINTS,).
        running: length at rest that a crack has still to run [m], and the length at rest of its
            last slip over that now, shape (2,).
    """

    points: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    spans: np.ndarray
    hint: np.ndarray
    region: np.ndarray
    running: np.ndarray


class Tissue(NamedTuple):
    """The tissue as operand of the kernels.

    Attributes:
        positions, rest: nodes now and at rest [m], shape (n, 3).
        tetrahedra, neighbors: of the mesh, shape (m, 4).
        near: tetrahedra among which points are looked for, shape (k,).
        opened: triangles of the surface that cuts have opened, shape (c, 3).
        region: of the tetrahedra, shape (m,); (0,): one.
    """

    positions: np.ndarray
    rest: np.ndarray
    tetrahedra: np.ndarray
    neighbors: np.ndarray
    near: np.ndarray
    opened: np.ndarray
    region: np.ndarray


@inner
def immerse(edge, device, tissue):
    """Find the points in the tissue. Those in the air go with them: the edge is rigid.

    Where a cut gapes so far that all are in the air, the edge goes on to the tissue before it,
    which has still to be cut, or else to the device's.
    """
    found, before, any_inside, lost = np.empty(POINTS, np.int64), edge.spans.copy(), False, False
    _locate(tissue, edge.points, edge.hint[0], found, edge.weights)
    for i in range(POINTS):
        lost = lost or (before[i] > 0.0 and found[i] < 0)
        any_inside = any_inside or found[i] >= 0
        edge.spans[i] = 1.0 if found[i] >= 0 else 0.0
    if not any_inside:
        _go_to_tissue(edge, device, tissue, found)
    elif lost:
        kept = edge.points.copy()
        lag_behind(edge, device)
        for i in range(POINTS):
            if before[i] == 0.0 or found[i] >= 0:
                edge.points[i] = kept[i]
        _locate(tissue, edge.points, edge.hint[0], found, edge.weights)
    for i in range(POINTS - 1, -1, -1):
        if found[i] < 0:
            edge.spans[i] = 0.0
            continue
        edge.spans[i], edge.hint[0] = 1.0, found[i]
        _enter(edge, i, tissue, found[i])
    _measure_spans(edge, device, tissue)
    _relax(edge, device, tissue, before)


@inner
def shares_inside(edge, tissue, before, after, spans, shares):
    """Find which share of its slip each point has made in the tissue.

    Args:
        edge: `Edge` after the slip and `immerse`.
        tissue: `Tissue`.
        before, after: ends of the slips [m], shape (POINTS, 3).
        spans: `Edge.spans` before, shape (POINTS,).
        shares: output, 1 but for points that have left the tissue, shape (POINTS,).
    """
    way, found, weights = np.empty((_TESTS, 3)), np.empty(_TESTS, np.int64), np.empty((_TESTS, 4))
    for i in range(POINTS):
        shares[i] = 1.0
        stays = edge.spans[i] > 0.0
        for c in range(3):
            stays = stays and edge.points[i, c] == after[i, c]
        if stays or spans[i] == 0.0:
            continue
        for k in range(_TESTS):
            part = (k + 1) / _TESTS
            for c in range(3):
                way[k, c] = (1.0 - part) * before[i, c] + part * after[i, c]
        _locate(tissue, way, edge.hint[0], found, weights)
        reached = 0
        while reached < _TESTS and found[reached] >= 0:
            reached += 1
        shares[i] = min((reached + 0.5) / _TESTS, 1.0)


@inner
def rest_length(edge, tissue):
    """Return the length at rest over that now, of the part of the edge in the tissue.

    Toughness is work by area at rest: tissue that the blade compresses along its edge is cut in
    full. Each run of points in the tissue counts from its first to its last, so that neither a
    crushed element nor a gap between two runs tells. A point on its own knows no stretch.

    Args:
        edge: `Edge`, of which a part is in the tissue.
        tissue: `Tissue`.
    """
    rest = now = 0.0
    first = 0
    for i in range(POINTS):
        if edge.spans[i] == 0.0:
            first = i + 1
            continue
        if i + 1 < POINTS and edge.spans[i + 1] > 0.0:
            continue
        length = sum_of(edge.spans[first : i + 1])
        at_rest = apart = 0.0
        for c in range(3):
            way = 0.0
            for k in range(4):
                way += edge.weights[i, k] * tissue.rest[edge.corners[i, k], c]
                way -= edge.weights[first, k] * tissue.rest[edge.corners[first, k], c]
            at_rest += way**2
            apart += (edge.points[i, c] - edge.points[first, c]) ** 2
        rest += length * (np.sqrt(at_rest / apart) if apart > 0.0 else 1.0)
        now += length
    return rest / now


@inner
def lag_behind(edge, device):
    """Move the points in the air as far behind the device's as the nearest in the tissue are.

    Between two points in the tissue, the lag is interpolated. Without any, there is none.
    """
    points, last = edge.points, -1
    for i in range(POINTS):
        if edge.spans[i] > 0.0:
            last = i
            continue
        ahead = i + 1
        while ahead < POINTS and edge.spans[ahead] == 0.0:
            ahead += 1
        if last < 0 and ahead == POINTS:
            assign_all(points, device)
            return
        first, second = last if last >= 0 else ahead, ahead if ahead < POINTS else last
        part = 0.0
        if first != second:
            part = (SHARES[i] - SHARES[first]) / (SHARES[second] - SHARES[first])
        for c in range(3):
            lag = (1.0 - part) * (device[first, c] - points[first, c])
            points[i, c] = device[i, c] - lag - part * (device[second, c] - points[second, c])


@inner
def _locate(tissue, points, hint, found, weights):
    locate_points(
        tissue.positions,
        tissue.tetrahedra,
        tissue.neighbors,
        tissue.near,
        points,
        hint,
        found,
        weights,
    )


@inner
def _enter(edge, i, tissue, tet):
    """Note the tetrahedron around a point."""
    for k in range(4):
        edge.corners[i, k] = tissue.tetrahedra[tet, k]
    edge.region[i] = tissue.region[tet] if tissue.region.shape[0] > 0 else 0


@inner
def _go_to_tissue(edge, device, tissue, found):
    """Move an edge in the air to where it meets tissue on its way to the device's."""
    ways, longest = differences(device, edge.points), 0.0
    for i in range(POINTS):
        longest = max(longest, dot(ways[i], ways[i]))
    steps = min(int(np.ceil(np.sqrt(longest) / (BLADE_THICKNESS / 2))), _MAX_STEPS)
    for step in range(1, steps + 1):
        for i in range(POINTS):
            for c in range(3):
                edge.points[i, c] = device[i, c] - (1.0 - step / steps) * ways[i, c]
        _locate(tissue, edge.points, edge.hint[0], found, edge.weights)
        for i in range(POINTS):
            if found[i] >= 0:
                return
    if steps == 0:
        assign_all(edge.points, device)
        _locate(tissue, edge.points, edge.hint[0], found, edge.weights)


@inner
def _measure_spans(edge, device, tissue):
    """Write how much of the edge each point stands for [pieces].

    At the end of the tissue it is the rest up to there, so that the force does not change in steps
    of a piece as the blade goes in.
    """
    beyond, found = np.empty((_TESTS, 3)), np.empty(_TESTS, np.int64)
    weights, inside = np.empty((_TESTS, 4)), np.empty(POINTS, np.bool_)
    for i in range(POINTS):
        inside[i] = edge.spans[i] > 0.0
    for i in range(POINTS):
        for step in (-1, 1):
            beside = i + step
            if not inside[i] or beside < 0 or beside >= POINTS or inside[beside]:
                continue
            for k in range(_TESTS):
                for c in range(3):
                    piece = device[1, c] - device[0, c]
                    beyond[k, c] = edge.points[i, c] + step * (k + 1) / _TESTS * piece
            _locate(tissue, beyond, edge.hint[0], found, weights)
            reached = 0
            while reached < _TESTS and found[reached] >= 0:
                reached += 1
            # The end is somewhere between the last place inside and the first outside.
            edge.spans[i] += min((reached + 0.5) / _TESTS, 1.0) - 0.5
        if inside[i]:
            edge.spans[i] = max(edge.spans[i], 1.0 / _TESTS)


@inner
def _relax(edge, device, tissue, before):
    """Spread the energy of points over the edge that has come into the tissue beside them.

    Args:
        edge, device, tissue: as for `immerse`.
        before: `Edge.spans` before [pieces], shape (POINTS,).
    """
    one, found, weights = np.empty((1, 3)), np.empty(1, np.int64), np.empty((1, 4))
    for i in range(POINTS):
        had = before[i] if before[i] > 0.0 else 0.5
        if edge.spans[i] <= had:
            continue
        share, longest = 1.0 - np.sqrt(had / edge.spans[i]), 0.0
        for c in range(3):
            stretch = device[i, c] - edge.points[i, c]
            longest = max(longest, abs(stretch))
            one[0, c] = edge.points[i, c] + share * stretch
        if longest <= SETTLED:
            continue
        _locate(tissue, one, edge.hint[0], found, weights)
        if found[0] >= 0:
            for c in range(3):
                edge.points[i, c] = one[0, c]
            for k in range(4):
                edge.weights[i, k] = weights[0, k]
            _enter(edge, i, tissue, found[0])
