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
    tangent_factors,
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


RATIO, MIN_STRETCH, MAX_STRETCH = _Q, _SHARE, _PULL
"""Slots of `tangents_in_lanes`: J, least and largest principal stretch."""


@kernel(fastmath=SAFE_MATH, error_model='numpy')
def tangents_in_lanes(chunk, constants):
    """Compute what the tangent of the law has more than the linear one in each lane.

    Args:
        chunk: h, changed, shape (SLOTS_OF_LAW LANES,). Output in the slots of the stress: the
            matrix B [Pa], xx xy xz yy yz zz, with G^T B G the trace of the additional stiffness
            along a vector G, see `tangent_factors`.
        constants: as for `stiffening_stress`.
    """
    L = LANES
    E = chunk[0 : SLOTS_OF_LAW * L]
    a, c, lam, b_law = constants[0], constants[1], constants[2], constants[3]
    linear = 4.0 * (a + c) + lam
    for b in range(L):
        h0, h1, h2 = E[b], E[b + L], E[b + 2 * L]
        h3, h4, h5 = E[b + 3 * L], E[b + 4 * L], E[b + 5 * L]
        h6, h7, h8 = E[b + 6 * L], E[b + 7 * L], E[b + 8 * L]
        _, ratio, least, most = tangent_modulus(
            h0, h1, h2, h3, h4, h5, h6, h7, h8, a, c, lam, b_law
        )
        f0, f4, f8 = 1.0 + h0, 1.0 + h4, 1.0 + h8
        square = f0 * f0 + f4 * f4 + f8 * f8 + h1 * h1 + h2 * h2 + h3 * h3
        square += h5 * h5 + h6 * h6 + h7 * h7
        steep, volumetric, g, slope = tangent_factors(square, ratio, a, c, lam, b_law)
        c0, c1, c2 = f4 * f8 - h5 * h7, h5 * h6 - h3 * f8, h3 * h7 - f4 * h6
        c3, c4, c5 = h2 * h7 - h1 * f8, f0 * f8 - h2 * h6, h1 * h6 - f0 * h7
        c6, c7, c8 = h1 * h5 - h2 * f4, h2 * h3 - f0 * h5, f0 * f4 - h1 * h3
        a0, a1, a2 = f0 - slope * c0, h1 - slope * c1, h2 - slope * c2
        a3, a4, a5 = h3 - slope * c3, f4 - slope * c4, h5 - slope * c5
        a6, a7, a8 = h6 - slope * c6, h7 - slope * c7, f8 - slope * c8
        more = 3.0 * g - linear
        E[b + STRESS * L] = (
            steep * (a0 * a0 + a3 * a3 + a6 * a6)
            + volumetric * (c0 * c0 + c3 * c3 + c6 * c6) + more
        )  # fmt: skip
        E[b + (STRESS + 1) * L] = steep * (a0 * a1 + a3 * a4 + a6 * a7) + volumetric * (
            c0 * c1 + c3 * c4 + c6 * c7
        )
        E[b + (STRESS + 2) * L] = steep * (a0 * a2 + a3 * a5 + a6 * a8) + volumetric * (
            c0 * c2 + c3 * c5 + c6 * c8
        )
        E[b + (STRESS + 3) * L] = (
            steep * (a1 * a1 + a4 * a4 + a7 * a7)
            + volumetric * (c1 * c1 + c4 * c4 + c7 * c7) + more
        )  # fmt: skip
        E[b + (STRESS + 4) * L] = steep * (a1 * a2 + a4 * a5 + a7 * a8) + volumetric * (
            c1 * c2 + c4 * c5 + c7 * c8
        )
        E[b + (STRESS + 5) * L] = (
            steep * (a2 * a2 + a5 * a5 + a8 * a8)
            + volumetric * (c2 * c2 + c5 * c5 + c8 * c8) + more
        )  # fmt: skip
        E[b + RATIO * L], E[b + MIN_STRETCH * L], E[b + MAX_STRETCH * L] = ratio, least, most


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
def _trace_shares(chunk, shapes, least):
    """Compute V G^T B G of each lane beyond a tolerance, at its four corners."""
    L = LANES
    E, S = chunk[0 : SLOTS_OF_LAW * L], shapes[0 : _SLOTS_OF_SHAPES * L]
    for b in range(L):
        counts = 1.0 if E[b + _SQUARE * L] >= least else 0.0
        share = counts * E[b + VOLUME * L]
        xx, xy, xz = E[b + STRESS * L], E[b + (STRESS + 1) * L], E[b + (STRESS + 2) * L]
        yy, yz, zz = E[b + (STRESS + 3) * L], E[b + (STRESS + 4) * L], E[b + (STRESS + 5) * L]
        x0, y0, z0 = 0.0, 0.0, 0.0
        for a in range(3):
            x, y, z = S[b + 3 * a * L], S[b + (3 * a + 1) * L], S[b + (3 * a + 2) * L]
            x0, y0, z0 = x0 + x, y0 + y, z0 + z
            off = xy * x * y + xz * x * z + yz * y * z
            S[b + (10 + a) * L] = share * (xx * x * x + yy * y * y + zz * z * z + 2.0 * off)
        off = xy * x0 * y0 + xz * x0 * z0 + yz * y0 * z0
        S[b + 9 * L] = share * (xx * x0 * x0 + yy * y0 * y0 + zz * z0 * z0 + 2.0 * off)
        E[b + _TRACE * L] = counts


@kernel(error_model='numpy')
def add_group_traces(constants, tolerance, elements, groups, u, traces):
    """Add what the tangent of some groups has more than the linear one to traces of 3x3 blocks.

    Args:
        constants, tolerance, elements, groups, u: see `add_group_forces`.
        traces: added to [N/m], shape (n,).

    Returns:
        Number of elements beyond the tolerance.
    """
    L, many, count = LANES, LANES // GROUP, 0
    chunk, shapes = np.zeros(SLOTS_OF_LAW * L), np.zeros(_SLOTS_OF_SHAPES * L)
    for low in range(0, groups.shape[0], many):
        some = groups[low : low + many]
        _gather(elements, some, u, constants[0] + constants[1], chunk, shapes)
        _measures(chunk)
        tangents_in_lanes(chunk, constants)
        _trace_shares(chunk, shapes, tolerance * tolerance)
        for which in range(some.shape[0]):
            corner = 4 * (some[which] // L) * L + some[which] % L
            for b in range(GROUP):
                lane = which * GROUP + b
                if chunk[lane + VOLUME * L] == 0.0 or chunk[lane + _TRACE * L] == 0.0:
                    continue
                count += 1
                for a in range(4):
                    node = elements.corners[corner + a * L + b] // 3
                    traces[node] += shapes[lane + (9 + a) * L]
    return count
