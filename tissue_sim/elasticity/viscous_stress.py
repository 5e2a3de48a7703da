"""Kernels of viscosity: the terms of a Prony series follow the stress of their nodes, in lanes.

A chunk holds LANES nodes, slot by slot, see `rotation`: loops over lanes run on vector registers.
"""

import math

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    add_domain_forces,
    smoothed_gradient,
)
from cutting_trainer.tissue_sim.elasticity.rotation import (
    LANES,
    ORDERED_MATH,
    ROTATION,
    SAFE_MATH,
    SLOTS,
    settle,
)
from cutting_trainer.tissue_sim.elasticity.simd import three
from cutting_trainer.tissue_sim.elasticity.stiffening import (
    MAX_EXPONENT,
    MIN_RATIO,
    stiffening_stress,
)

KEPT = 7
"""Numbers of a term at a node: s by xx, yy, zz, xy, xz, yz, and its energy alone [Pa]."""
LINEAR, TURNING, LAW = 0, 1, 2
_ROTATION_TOLERANCE = 1e-9
"""[rad]; its square is the error of a stress."""
_MATRIX = SLOTS
"""First slot of R by rows. A chunk has the slots of `rotation` first, with F and the quaternion of
R, then these, each of LANES numbers."""
_RESULT, _STRAIN, _TERM, _TOTAL = SLOTS + 9, SLOTS + 15, SLOTS + 21, SLOTS + 27
"""First slots of symmetric tensors by xx, yy, zz, xy, xz, yz."""
_RATE, _AWAY, _SQUARE, _GAINED, _BEFORE, _STORED, _LOST, _SLOTS = range(SLOTS + 33, SLOTS + 41)
"""Slots of numbers: a = 1 - exp(-dt / tau), square of the largest |T - s|, |s|^2, s e after and
before, energy and loss by volume; and how many there are."""


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _put(x, y, z, rotation, i, at, chunk):
    """Write I plus the rows of a gradient, and a node's rotation, to a lane of a chunk."""
    L = LANES
    for k in range(3):
        chunk[at + k * L], chunk[at + (3 + k) * L], chunk[at + (6 + k) * L] = x[k], y[k], z[k]
    for k in range(3):
        chunk[at + 4 * k * L] += 1.0
    for k in range(4):
        chunk[at + (ROTATION + k) * L] = rotation[i, k]


@inner
def _put_rest(chunk, at):
    """Write F and R of a node at rest to a lane: no other waits for it to settle."""
    for k in range(ROTATION + 4):
        chunk[at + k * LANES] = 0.0
    for k in (0, 4, 8, ROTATION):
        chunk[at + k * LANES] = 1.0


@inner(error_model='numpy', fastmath=SAFE_MATH)
def _put_matrix(chunk):
    """Compute R from the quaternions of all lanes."""
    L = LANES
    E = chunk[0 : _SLOTS * L]
    for b in range(L):
        w, x, y, z = E[b + 9 * L], E[b + 10 * L], E[b + 11 * L], E[b + 12 * L]
        E[b + _MATRIX * L] = 1 - 2 * (y * y + z * z)
        E[b + (_MATRIX + 1) * L] = 2 * (x * y - w * z)
        E[b + (_MATRIX + 2) * L] = 2 * (x * z + w * y)
        E[b + (_MATRIX + 3) * L] = 2 * (x * y + w * z)
        E[b + (_MATRIX + 4) * L] = 1 - 2 * (x * x + z * z)
        E[b + (_MATRIX + 5) * L] = 2 * (y * z - w * x)
        E[b + (_MATRIX + 6) * L] = 2 * (x * z - w * y)
        E[b + (_MATRIX + 7) * L] = 2 * (y * z + w * x)
        E[b + (_MATRIX + 8) * L] = 1 - 2 * (x * x + y * y)


@inner(error_model='numpy', fastmath=SAFE_MATH)
def _turn_back(chunk):
    """Compute sym(R^T F) of all lanes, into the slots `_RESULT`."""
    L = LANES
    E = chunk[0 : _SLOTS * L]
    for b in range(L):
        for i in range(3):
            for j in range(i, 3):
                both = 0.0
                for k in range(3):
                    both += E[b + (_MATRIX + 3 * k + i) * L] * E[b + (3 * k + j) * L]
                    both += E[b + (_MATRIX + 3 * k + j) * L] * E[b + (3 * k + i) * L]
                at = i if i == j else 2 + i + j
                E[b + (_RESULT + at) * L] = 0.5 * both


@inner(error_model='numpy', fastmath=SAFE_MATH)
def _make_deviatoric(chunk, twice_mu):
    """Compute deviatoric strain and linear stress of the stretches of all lanes."""
    L = LANES
    E = chunk[0 : _SLOTS * L]
    for b in range(L):
        x, y, z = E[b + _RESULT * L], E[b + (_RESULT + 1) * L], E[b + (_RESULT + 2) * L]
        mean = (x + y + z) / 3.0
        E[b + _RESULT * L], E[b + (_RESULT + 1) * L] = x - mean, y - mean
        E[b + (_RESULT + 2) * L] = z - mean
        for k in range(6):
            e = E[b + (_RESULT + k) * L]
            E[b + (_STRAIN + k) * L] = e
            E[b + (_RESULT + k) * L] = twice_mu * e


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _put_law_stress(chunk, at, law, f, p):
    """Replace F of a lane by its stress without the part along the change of volume [Pa].

    Args:
        chunk: see `_MATRIX`.
        at: lane.
        law: mu, 0, lambda and b, see `stiffening_stress`.
        f, p: scratch, shape (9,).
    """
    L = LANES
    for k in range(9):
        f[k] = chunk[at + k * L]
    c0, c1, c2 = f[4] * f[8] - f[5] * f[7], f[5] * f[6] - f[3] * f[8], f[3] * f[7] - f[4] * f[6]
    ratio = max(f[0] * c0 + f[1] * c1 + f[2] * c2, MIN_RATIO)
    for i in range(3):
        f[4 * i] -= 1.0
    stiffening_stress(f, law, p)
    for i in range(3):
        f[4 * i] += 1.0
    work = 0.0
    for i in range(9):
        work += p[i] * f[i]
    off = work / (3.0 * ratio)
    p[0], p[1], p[2] = p[0] - off * c0, p[1] - off * c1, p[2] - off * c2
    p[3] -= off * (f[2] * f[7] - f[1] * f[8])
    p[4] -= off * (f[0] * f[8] - f[2] * f[6])
    p[5] -= off * (f[1] * f[6] - f[0] * f[7])
    p[6] -= off * (f[1] * f[5] - f[2] * f[4])
    p[7] -= off * (f[2] * f[3] - f[0] * f[5])
    p[8] -= off * (f[0] * f[4] - f[1] * f[3])
    for k in range(9):
        chunk[at + k * L] = p[k]


@inner(error_model='numpy')
def _conjugate(square, law):
    """Return the energy by volume that belongs to a stress alone: s e - W(e) of its strain e [Pa].

    In a deviatoric strain the law has W = mu / (2 b) (exp(y) - 1) with y = 2 b |e|^2, so that
    2 y exp(2 y) = b |s|^2 / mu^2: Lambert's function, by the iteration of Iacono and Boyd (2017).

    Args:
        square: |s|^2 [Pa^2].
        law: see `_put_law_stress`.
    """
    mu, b = law[0], law[3]
    z = b * square / (mu * mu)
    if z < 1e-12:
        return square / (4.0 * mu)
    w = math.log1p(z)
    for _ in range(4):
        w = w / (1.0 + w) * (1.0 + math.log(z / w))
    y = 0.5 * w
    if y < MAX_EXPONENT:
        return mu / (2.0 * b) * (2.0 * y * math.exp(y) - math.expm1(y))
    rise = math.exp(MAX_EXPONENT)
    y = 0.5 * z / (rise * rise)
    return mu / (2.0 * b) * (rise * (y + MAX_EXPONENT - 1.0) + 1.0)


@inner(error_model='numpy', fastmath=SAFE_MATH)
def _follow(chunk, g):
    """Let one term of all lanes follow its stress, and add its share g to the total."""
    L = LANES
    E = chunk[0 : _SLOTS * L]
    for b in range(L):
        before = change = square = gained = 0.0
        for k in range(6):
            twice = 1.0 if k < 3 else 2.0
            e, s = twice * E[b + (_STRAIN + k) * L], E[b + (_TERM + k) * L]
            away = E[b + (_RESULT + k) * L] - s
            before += s * e
            s += E[b + _RATE * L] * away
            E[b + (_TERM + k) * L] = s
            E[b + (_TOTAL + k) * L] += g * s
            change += twice * away * away
            square += twice * s * s
            gained += s * e
        E[b + _AWAY * L] = max(E[b + _AWAY * L], change)
        E[b + _SQUARE * L], E[b + _GAINED * L], E[b + _BEFORE * L] = square, gained, before


@inner(error_model='numpy', fastmath=SAFE_MATH)
def _turn_total(chunk):
    """Replace F by R total of all lanes."""
    L = LANES
    E = chunk[0 : _SLOTS * L]
    for b in range(L):
        for i in range(3):
            for j in range(3):
                turned = 0.0
                for k in range(3):
                    at = k if k == j else 2 + k + j
                    turned += E[b + (_MATRIX + 3 * i + k) * L] * E[b + (_TOTAL + at) * L]
                E[b + (3 * i + j) * L] = turned


@inner(error_model='numpy')
def _follow_series(chunk, nodes, low, high, now, series, law, kind):
    """Let all terms of a chunk's nodes follow their stress.

    Args:
        chunk: see `_MATRIX`; its total, energy and loss are written.
        nodes: of which the terms change; and
        now, series, law, kind: see `relieve`.
        low, high: the nodes.
    """
    L = LANES
    for at in range(_TOTAL * L, (_TOTAL + 6) * L):
        chunk[at] = 0.0
    for b in range(L):
        chunk[b + _AWAY * L] = chunk[b + _STORED * L] = chunk[b + _LOST * L] = 0.0
    for term in range(series.shape[0]):
        g, tau, first = series[term, 0], series[term, 1], KEPT * term
        elapsed = rate = 0.0
        for i in range(low, high):
            if now - nodes.since[i] != elapsed:
                elapsed = now - nodes.since[i]
                rate = -math.expm1(-elapsed / tau)
            chunk[i - low + _RATE * L] = rate
            for k in range(6):
                chunk[i - low + (_TERM + k) * L] = nodes.terms[i, first + k]
        _follow(chunk, g)
        for i in range(low, high):
            b = i - low
            for k in range(6):
                nodes.terms[i, first + k] = chunk[b + (_TERM + k) * L]
            square, gained = chunk[b + _SQUARE * L], chunk[b + _GAINED * L]
            own = _conjugate(square, law) if kind == LAW else square / (4.0 * law[0])
            # In the same shape, what the terms store less is lost.
            before = nodes.terms[i, first + 6] - chunk[b + _BEFORE * L]
            chunk[b + _STORED * L] += g * (own - gained)
            chunk[b + _LOST * L] += g * (before - own + gained)
            nodes.terms[i, first + 6] = own


@kernel(error_model='numpy')
def relieve(domains, nodes, spans, u, now, series, law, kind, load):
    """Let the terms of some nodes follow their stress, and the load follow them.

    Args:
        domains: smoothing domains.
        nodes: a `ViscousNodes`, changed at these nodes.
        spans: intervals of nodes, shape (s, 2).
        u: displacement by coordinate [m], shape (3 n,).
        now: simulated time [s]; infinite: relaxed in full.
        series: g and tau [s] of the terms, shape (k, 2).
        law: see `_put_law_stress`; b 0 for a linear law.
        kind: LINEAR, TURNING or LAW.
        load: changed by the change of the nodes' stress [N], shape (3 n,).

    Returns:
        Energy lost [J], and the largest stress still to be relaxed [Pa].
    """
    L = LANES
    chunk, f, p = np.zeros(_SLOTS * L), np.empty(9), np.empty(9)
    lost = away = 0.0
    for s in range(spans.shape[0]):
        for low in range(spans[s, 0], spans[s, 1], L):
            high = min(low + L, spans[s, 1])
            for i in range(low, high):
                rows = smoothed_gradient(domains, u, i)
                _put(rows[0], rows[1], rows[2], nodes.rotation, i, i - low, chunk)
            for b in range(high - low, L):
                _put_rest(chunk, b)
            if kind != LINEAR:
                settle(chunk, _ROTATION_TOLERANCE, 100)
                for i in range(low, high):
                    for k in range(4):
                        nodes.rotation[i, k] = chunk[i - low + (ROTATION + k) * L]
            _put_matrix(chunk)
            _turn_back(chunk)
            _make_deviatoric(chunk, 2.0 * law[0])
            if kind == LAW:
                for b in range(high - low):
                    _put_law_stress(chunk, b, law, f, p)
                _turn_back(chunk)
            _follow_series(chunk, nodes, low, high, now, series, law, kind)
            _turn_total(chunk)
            for i in range(low, high):
                volume, b = domains.volume[i], i - low
                nodes.energy[i] = volume * chunk[b + _STORED * L]
                lost += volume * chunk[b + _LOST * L]
                away = max(away, chunk[b + _AWAY * L])
                nodes.since[i] = now
                for k in range(9):
                    relief = chunk[b + k * L]
                    p[k] = volume * (relief - nodes.relief[i, k])
                    nodes.relief[i, k] = relief
                columns = three(p[0], p[3], p[6]), three(p[1], p[4], p[7])
                add_domain_forces(domains, i, *columns, three(p[2], p[5], p[8]), load)
    return lost, math.sqrt(away)
