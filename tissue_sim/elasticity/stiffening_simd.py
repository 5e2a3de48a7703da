"""The stiffening law at many points at once, in vector lanes.

A chunk holds LANES points, slot by slot. Every loop over the lanes has neither branches nor calls:
logarithm and exponential are series, as exact as those of the library. Tetrahedra come in groups of
GROUP neighbours, of which at least one may be beyond the tolerance.
"""

import math

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT, chunk_deformation
from cutting_trainer.tissue_sim.elasticity.rotation import LANES, SAFE_MATH, SLOTS
from cutting_trainer.tissue_sim.elasticity.stiffening import (
    MAX_EXPONENT,
    MAX_OWN_EXPONENT,
    MIN_RATIO,
    series_exponential,
    series_logarithm,
    tangent_modulus,
)

GROUP = 8
"""Elements that are evaluated together: a line of the cache in each slot."""
STRESS, VOLUME = 9, 18
SLOTS_OF_LAW = 26
"""Slots of a chunk: h (9), P V (9), V; |h|^2; g, q, share of the law, pull of the blend, all times
V; trace of h; energy beyond the linear law."""
_SQUARE, _G, _Q, _SHARE, _PULL, _TRACE, _ENERGY = 19, 20, 21, 22, 23, 24, 25
_SLOTS_OF_SHAPES = 18
"""Slots of gradients of shape functions 1 to 3 (9), and of differences of u, then nodal forces."""
_U1, _U2 = np.uint32(1), np.uint32(2)
_MIN_DIVISOR = 1e-12
"""Divisor that is no tolerance and no size of a strain, where these are 0."""


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _measures(chunk):
    """Compute |h|^2, the trace, and J in the slot of q."""
    L = LANES
    E = chunk[0 : SLOTS_OF_LAW * L]
    for b in range(L):
        h0, h1, h2 = E[b], E[b + L], E[b + 2 * L]
        h3, h4, h5 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        h6, h7, h8 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        square = h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3 + h4 * h4 + h5 * h5
        turned = h0 * h0 + h4 * h4 + h8 * h8 + 2.0 * (h1 * h3 + h2 * h6 + h5 * h7)
        f0, f4, f8 = 1.0 + h0, 1.0 + h4, 1.0 + h8
        square += h6 * h6 + h7 * h7 + h8 * h8
        E[b + _SQUARE * L] = square
        E[b + _ENERGY * L] = 0.5 * (square + turned)
        E[b + _TRACE * L] = h0 + h4 + h8
        E[b + _Q * L] = (
            f0 * (f4 * f8 - h5 * h7) + h1 * (h5 * h6 - h3 * f8) + h2 * (h3 * h7 - f4 * h6)
        )


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _factors(chunk, constants, tolerance):
    """Compute g, q, share and pull of each lane, times V, and its energy beyond the linear law."""
    L = LANES
    E = chunk[0 : SLOTS_OF_LAW * L]
    a, c, lam, b_law = constants[0], constants[1], constants[2], constants[3]
    mu, half_b = a + c, 0.5 / max(b_law, _MIN_DIVISOR)
    steep = 1.0 / max(tolerance, _MIN_DIVISOR)
    neo = 1.0 if b_law == 0.0 else 0.0
    for b in range(L):
        square, trace, ratio = E[b + _SQUARE * L], E[b + _TRACE * L], E[b + _Q * L]
        inside = max(ratio, MIN_RATIO)
        slope = 1.0 / inside
        log = series_logarithm(inside) + (ratio - inside) * slope
        x = square + 2.0 * trace - 2.0 * log
        y = max(b_law * x, 0.0)
        low, own_low = min(y, MAX_EXPONENT), min(y, MAX_OWN_EXPONENT)
        rise, own_rise = series_exponential(low), series_exponential(own_low)
        energy = a * (rise * (1.0 + y - low) - 1.0) + c * (own_rise * (1.0 + y - own_low) - 1.0)
        energy = half_b * energy * (1.0 - neo) + 0.5 * mu * x * neo + 0.5 * lam * log * log
        more = energy - mu * E[b + _ENERGY * L] - 0.5 * lam * trace * trace
        g = a * rise + c * own_rise
        size, volume = math.sqrt(square), E[b + VOLUME * L]
        t = min(max(size * steep - 1.0, 0.0), 1.0)
        share = volume * t * t * (3.0 - 2.0 * t)
        E[b + _G * L] = share * g
        E[b + _Q * L] = share * (lam * log - g) * slope
        E[b + _SHARE * L] = share
        E[b + _PULL * L] = volume * more * 6.0 * t * (1.0 - t) * steep / max(size, _MIN_DIVISOR)
        E[b + _ENERGY * L] = share * more


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _stresses(chunk, mu, lam, keep):
    """Compute P V: share of the law less the linear one, pull, and `keep` of the linear one."""
    L = LANES
    E = chunk[0 : SLOTS_OF_LAW * L]
    for b in range(L):
        h0, h1, h2 = E[b], E[b + L], E[b + 2 * L]
        h3, h4, h5 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        h6, h7, h8 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        g, q = E[b + _G * L], E[b + _Q * L]
        # P = g F + q cof F + pull h + linear (mu (h + h^T) + lam tr h I)
        linear = keep * E[b + VOLUME * L] - E[b + _SHARE * L]
        other = linear * mu
        own = g + E[b + _PULL * L] + other
        diagonal = g + linear * lam * E[b + _TRACE * L]
        straight = own + other
        f0, f4, f8 = 1.0 + h0, 1.0 + h4, 1.0 + h8
        E[b + 9 * L] = diagonal + straight * h0 + q * (f4 * f8 - h5 * h7)
        E[b + 10 * L] = own * h1 + other * h3 + q * (h5 * h6 - h3 * f8)
        E[b + 11 * L] = own * h2 + other * h6 + q * (h3 * h7 - f4 * h6)
        E[b + 12 * L] = own * h3 + other * h1 + q * (h2 * h7 - h1 * f8)
        E[b + 13 * L] = diagonal + straight * h4 + q * (f0 * f8 - h2 * h6)
        E[b + 14 * L] = own * h5 + other * h7 + q * (h1 * h6 - f0 * h7)
        E[b + 15 * L] = own * h6 + other * h2 + q * (h1 * h5 - h2 * f4)
        E[b + 16 * L] = own * h7 + other * h5 + q * (h2 * h3 - f0 * h5)
        E[b + 17 * L] = diagonal + straight * h8 + q * (f0 * f4 - h1 * h3)


@kernel(error_model='numpy')
def law_in_lanes(chunk, constants, tolerance, keep):
    """Compute the stress of the blended law less the linear one in each lane.

    Args:
        chunk: h, and V (0: an empty lane), changed, shape (SLOTS_OF_LAW LANES,).
        constants: as for `stiffening_stress`.
        tolerance: |h| from which the law counts; 0: everywhere.
        keep: share of the linear stress that is added.

    Returns:
        Energy beyond the linear law [J].
    """
    _measures(chunk)
    _factors(chunk, constants, tolerance)
    _stresses(chunk, constants[0] + constants[1], constants[2], keep)
    total = 0.0
    for b in range(_ENERGY * LANES, (_ENERGY + 1) * LANES):
        total += chunk[b]
    return total


MODULUS, RATIO, MIN_STRETCH, MAX_STRETCH = _G, _Q, _SHARE, _PULL
"""Slots of `tangents_in_lanes`: modulus [Pa], J, least and largest principal stretch."""


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def tangents_in_lanes(chunk, constants):
    """Compute the largest tangent modulus of the law in each lane, see `tangent_bound`.

    Args:
        chunk: h, changed, shape (SLOTS_OF_LAW LANES,).
        constants: as for `stiffening_stress`.
    """
    L = LANES
    E = chunk[0 : SLOTS_OF_LAW * L]
    a, c, lam, b_law = constants[0], constants[1], constants[2], constants[3]
    for b in range(L):
        modulus, ratio, least, most = tangent_modulus(
            E[b], E[b + L], E[b + 2 * L], E[b + 3 * L], E[b + 4 * L], E[b + 5 * L],
            E[b + 6 * L], E[b + 7 * L], E[b + 8 * L], a, c, lam, b_law,
        )  # fmt: skip
        E[b + MODULUS * L], E[b + RATIO * L] = modulus, ratio
        E[b + MIN_STRETCH * L], E[b + MAX_STRETCH * L] = least, most


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def groups_beyond(elements, chunks, u, tolerance, found):
    """List the first element of each group with one beyond a tolerance.

    Args:
        elements: shape functions and volumes.
        chunks: that are searched, shape (k,).
        u: displacement by coordinate [m], shape (3 n,).
        tolerance: of |h|.
        found: output, shape (k LANES / GROUP,).

    Returns:
        Number of groups.
    """
    L, least, count = LANES, tolerance * tolerance, 0
    chunk = np.zeros(SLOTS * L)
    for k in chunks:
        data = elements.data[k * KEPT * L : (k + 1) * KEPT * L]
        corners = elements.corners[4 * k * L : 4 * (k + 1) * L]
        chunk_deformation(data, corners, u, chunk, 0.0)
        E = chunk[0 : SLOTS * L]
        for b in range(L):
            square = E[b] ** 2 + E[b + L] ** 2 + E[b + 2 * L] ** 2 + E[b + 3 * L] ** 2
            square += E[b + 4 * L] ** 2 + E[b + 5 * L] ** 2 + E[b + 6 * L] ** 2
            E[b + 9 * L] = square + E[b + 7 * L] ** 2 + E[b + 8 * L] ** 2
        for low in range(9 * L, 10 * L, GROUP):
            beyond = False
            for b in range(low, low + GROUP):
                beyond |= not E[b] < least
            if beyond:
                found[count] = k * L + low - 9 * L
                count += 1
    return count


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _gather(elements, groups, u, mu, chunk, shapes):
    """Compute h and V of some groups, and keep their gradients."""
    L = LANES
    E, S = chunk[0 : SLOTS_OF_LAW * L], shapes[0 : _SLOTS_OF_SHAPES * L]
    scale = 0.5 / mu
    for which in range(groups.shape[0]):
        tet, low = groups[which], which * GROUP
        at, corner = tet // L * KEPT * L + tet % L, 4 * (tet // L) * L + tet % L
        for i in range(9):
            source, target = elements.data[at + i * L :], shapes[low + i * L :]
            for b in range(GROUP):
                target[b] = source[b]
        V, C = elements.data[at + 13 * L :], elements.corners[corner:]
        E1, S1 = chunk[low:], shapes[low:]
        for b in range(GROUP):
            n0, n1 = np.uint32(C[b]), np.uint32(C[L + b])
            n2, n3 = np.uint32(C[2 * L + b]), np.uint32(C[3 * L + b])
            x, y, z = u[n0], u[n0 + _U1], u[n0 + _U2]
            E1[VOLUME * L + b] = scale * V[b]
            S1[9 * L + b], S1[10 * L + b] = u[n1] - x, u[n1 + _U1] - y
            S1[11 * L + b], S1[12 * L + b] = u[n1 + _U2] - z, u[n2] - x
            S1[13 * L + b], S1[14 * L + b] = u[n2 + _U1] - y, u[n2 + _U2] - z
            S1[15 * L + b], S1[16 * L + b] = u[n3] - x, u[n3 + _U1] - y
            S1[17 * L + b] = u[n3 + _U2] - z
    for b in range(groups.shape[0] * GROUP, L):
        E[b + VOLUME * L] = 0.0
    for j in range(3):
        for b in range(L):
            g0, g1, g2 = S[b + j * L], S[b + (3 + j) * L], S[b + (6 + j) * L]
            for i in range(3):
                d0, d1, d2 = S[b + (9 + i) * L], S[b + (12 + i) * L], S[b + (15 + i) * L]
                E[b + (3 * i + j) * L] = d0 * g0 + d1 * g1 + d2 * g2


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _scatter(elements, groups, chunk, shapes, f):
    """Add the nodal forces of some groups."""
    L = LANES
    E, S = chunk[0 : SLOTS_OF_LAW * L], shapes[0 : _SLOTS_OF_SHAPES * L]
    for i in range(3):
        for b in range(L):
            p = STRESS + 3 * i
            p0, p1, p2 = E[b + p * L], E[b + (p + 1) * L], E[b + (p + 2) * L]
            for a in range(3):
                g0, g1, g2 = S[b + 3 * a * L], S[b + (3 * a + 1) * L], S[b + (3 * a + 2) * L]
                S[b + (9 + 3 * a + i) * L] = p0 * g0 + p1 * g1 + p2 * g2
    for which in range(groups.shape[0]):
        tet, low = groups[which], which * GROUP
        corner = 4 * (tet // L) * L + tet % L
        C, S1 = elements.corners[corner:], shapes[low + 9 * L :]
        for b in range(GROUP):
            n0, n1 = np.uint32(C[b]), np.uint32(C[L + b])
            n2, n3 = np.uint32(C[2 * L + b]), np.uint32(C[3 * L + b])
            x0, y0, z0 = S1[b], S1[L + b], S1[2 * L + b]
            x1, y1, z1 = S1[3 * L + b], S1[4 * L + b], S1[5 * L + b]
            x2, y2, z2 = S1[6 * L + b], S1[7 * L + b], S1[8 * L + b]
            f[n0] -= x0 + x1 + x2
            f[n0 + _U1] -= y0 + y1 + y2
            f[n0 + _U2] -= z0 + z1 + z2
            f[n1] += x0
            f[n1 + _U1] += y0
            f[n1 + _U2] += z0
            f[n2] += x1
            f[n2 + _U1] += y1
            f[n2 + _U2] += z1
            f[n3] += x2
            f[n3 + _U1] += y2
            f[n3 + _U2] += z2


@kernel(error_model='numpy')
def add_group_forces(constants, tolerance, elements, groups, u, f):
    """Add the forces of the law less the linear ones.

    Args:
        constants: as for `stiffening_stress`.
        tolerance: |h| from which the law counts.
        elements: shape functions and volumes.
        groups: their first elements, shape (k,).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).

    Returns:
        Energy beyond the linear law [J].
    """
    chunk, shapes = np.zeros(SLOTS_OF_LAW * LANES), np.zeros(_SLOTS_OF_SHAPES * LANES)
    total, many = 0.0, LANES // GROUP
    for low in range(0, groups.shape[0], many):
        some = groups[low : low + many]
        _gather(elements, some, u, constants[0] + constants[1], chunk, shapes)
        total += law_in_lanes(chunk, constants, tolerance, 0.0)
        _scatter(elements, some, chunk, shapes, f)
    return total


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def _row_shares(chunk, shapes, least, mu):
    """Compute V (modulus - 2 mu) sum_k |g_k| |g_j| of each lane beyond a tolerance."""
    L = LANES
    E, S = chunk[0 : SLOTS_OF_LAW * L], shapes[0 : _SLOTS_OF_SHAPES * L]
    for b in range(L):
        x1, y1, z1 = S[b], S[b + L], S[b + 2 * L]
        x2, y2, z2 = S[b + 3 * L], S[b + 4 * L], S[b + 5 * L]
        x3, y3, z3 = S[b + 6 * L], S[b + 7 * L], S[b + 8 * L]
        x0, y0, z0 = x1 + x2 + x3, y1 + y2 + y3, z1 + z2 + z3
        n0, n1 = math.sqrt(x0 * x0 + y0 * y0 + z0 * z0), math.sqrt(x1 * x1 + y1 * y1 + z1 * z1)
        n2, n3 = math.sqrt(x2 * x2 + y2 * y2 + z2 * z2), math.sqrt(x3 * x3 + y3 * y3 + z3 * z3)
        counts = 1.0 if E[b + _SQUARE * L] >= least else 0.0
        more = counts * E[b + VOLUME * L] * (E[b + MODULUS * L] - 2.0 * mu) * (n0 + n1 + n2 + n3)
        E[b + _TRACE * L] = counts
        S[b + 9 * L], S[b + 10 * L] = more * n0, more * n1
        S[b + 11 * L], S[b + 12 * L] = more * n2, more * n3


@kernel(error_model='numpy')
def add_group_rows(constants, tolerance, elements, groups, u, rows):
    """Add to bounds of row sums what the tangent of some groups has more than the linear one.

    Args:
        constants, tolerance, elements, groups, u: see `add_group_forces`.
        rows: added to [N/m], shape (n,).

    Returns:
        Number of elements beyond the tolerance.
    """
    L, many, count = LANES, LANES // GROUP, 0
    chunk, shapes = np.zeros(SLOTS_OF_LAW * L), np.zeros(_SLOTS_OF_SHAPES * L)
    mu = constants[0] + constants[1]
    for low in range(0, groups.shape[0], many):
        some = groups[low : low + many]
        _gather(elements, some, u, mu, chunk, shapes)
        _measures(chunk)
        tangents_in_lanes(chunk, constants)
        _row_shares(chunk, shapes, tolerance * tolerance, mu)
        for which in range(some.shape[0]):
            corner = 4 * (some[which] // L) * L + some[which] % L
            for b in range(GROUP):
                lane = which * GROUP + b
                if chunk[lane + VOLUME * L] == 0.0 or chunk[lane + _TRACE * L] == 0.0:
                    continue
                count += 1
                for a in range(4):
                    node = elements.corners[corner + a * L + b] // 3
                    rows[node] += shapes[lane + (9 + a) * L]
    return count
