"""Kernels of the stiffening model: linear forces everywhere, the law where the strain needs it.

Points are the smoothing domains of nodes and the tetrahedra, as in the smoothed models. An element
has its share of mu, which stiffens to a lower limit; a domain has the whole law less that share. A
homogeneous strain therefore meets the law itself, and no single element dictates the step.

Domains are tested at every evaluation, elements every `_EVERY` evaluations: those near the
tolerance are candidates until the next search.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    add_domain_forces,
    smoothed_gradient,
)
from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.simd import three
from cutting_trainer.tissue_sim.elasticity.stiffening import (
    linear_stress,
    tangent_bound,
)
from cutting_trainer.tissue_sim.elasticity.stiffening_simd import (
    GROUP,
    MAX_STRETCH,
    MIN_STRETCH,
    RATIO,
    SLOTS_OF_LAW,
    STRESS,
    VOLUME,
    add_group_forces,
    add_group_traces,
    groups_beyond,
    law_in_lanes,
    tangents_in_lanes,
)

_EVERY = 4
"""Evaluations between two searches for groups of elements beyond the tolerance."""
_NEAR = 0.7
"""Share of the tolerance beyond which an element makes its group a candidate."""
_ENERGY, _FORCE, _IMPLICIT = -1, 1, 3
"""Meanings of `rotation_steps`: exact and with energy; a step; a step, then products."""


class Law(NamedTuple):
    """Operands of the law.

    Attributes:
        domains, elements: a, c, lambda [Pa] and b of their laws, shape (4,); empty: no law.
        tolerance: |F - I| from which the law counts, in domains and in elements, shape (2,).
        counters: evaluations until the next search, number of candidates, shape (2,).
        candidates: first elements of groups, shape (LANES k,).
        implicit: 1 while products need a bound of the tangent instead of the linear stiffness,
            shape (1,).
        domain_bounds, element_bounds: moduli of these products [Pa], 0: linear; shapes (n,) and
            (LANES k,).
    """

    domains: np.ndarray
    elements: np.ndarray
    tolerance: np.ndarray
    counters: np.ndarray
    candidates: np.ndarray
    implicit: np.ndarray
    domain_bounds: np.ndarray
    element_bounds: np.ndarray


@inner(error_model='numpy')
def _full_bound(h, constants, p):
    """Return a modulus that no tangent of the law exceeds in any direction [Pa]."""
    found = np.empty(3)
    mu, lam = constants[0] + constants[1], constants[2]
    plane = tangent_bound(h, constants, found)
    # Beside plane waves, lambda acts on all three axes, and the determinant bends.
    return 3.0 * plane + 2.0 * (mu + lam) * max(found[2], 1.0)


@inner(error_model='numpy')
def _flush(law, domains, waiting, chunk, f):
    """Add the forces of the domains in the lanes; return their energy beyond the linear law [J]."""
    for lane in range(waiting.shape[0], LANES):
        chunk[lane + VOLUME * LANES] = 0.0
    more = law_in_lanes(chunk, law.domains, law.tolerance[0], 1.0)
    for lane in range(waiting.shape[0]):
        p = chunk[lane + STRESS * LANES :: LANES]
        columns = three(p[0], p[3], p[6]), three(p[1], p[4], p[7]), three(p[2], p[5], p[8])
        add_domain_forces(domains, waiting[lane], *columns, f)
    return more


@inner(error_model='numpy')
def _add_domains(law, domains, spans, u, f, mode):
    """Add the forces of the domains; return their energy [J]."""
    chunk, waiting = np.zeros(SLOTS_OF_LAW * LANES), np.empty(LANES, np.int64)
    h, p = np.empty(9), np.empty(9)
    least = law.tolerance[0] * law.tolerance[0]
    total, count = 0.0, 0
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(domains.used.shape[0], spans[s, 1])):
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = smoothed_gradient(domains, u, i)
            square = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz
            square += zx * zx + zy * zy + zz * zz
            volume = domains.volume[i]
            shear = domains.lame[1] * volume
            pressure = domains.lame[0] * volume * (xx + yy + zz)
            pxx, pyy = 2.0 * shear * xx + pressure, 2.0 * shear * yy + pressure
            pzz = 2.0 * shear * zz + pressure
            pxy, pxz, pyz = shear * (xy + yx), shear * (xz + zx), shear * (yz + zy)
            if mode == _ENERGY:
                total += 0.5 * (pxx * xx + pyy * yy + pzz * zz)
                total += 0.5 * (pxy * (xy + yx) + pxz * (xz + zx) + pyz * (yz + zy))
            if mode == _IMPLICIT:
                law.domain_bounds[i] = 0.0
            if square < least:
                columns = three(pxx, pxy, pxz), three(pxy, pyy, pyz), three(pxz, pyz, pzz)
                add_domain_forces(domains, i, *columns, f)
                continue
            lane = chunk[count::LANES]
            lane[0], lane[1], lane[2], lane[3], lane[4] = xx, xy, xz, yx, yy
            lane[5], lane[6], lane[7], lane[8], lane[VOLUME] = yz, zx, zy, zz, volume
            if mode == _IMPLICIT:
                for j in range(9):
                    h[j] = lane[j]
                law.domain_bounds[i] = _full_bound(h, law.domains, p)
            waiting[count] = i
            count += 1
            if count == LANES:
                total += _flush(law, domains, waiting, chunk, f)
                count = 0
    return total + _flush(law, domains, waiting[:count], chunk, f) if count else total


@inner(error_model='numpy')
def _element_gradient(elements, tet, u, g, h):
    """Compute gradients of shape functions, shape (12,), and h; return its square and volume."""
    at = tet // LANES * KEPT * LANES + tet % LANES
    corner = 4 * (tet // LANES) * LANES + tet % LANES
    for i in range(9):
        g[3 + i] = elements.data[at + i * LANES]
        h[i] = 0.0
    for j in range(3):
        g[j] = -g[3 + j] - g[6 + j] - g[9 + j]
    for a in range(4):
        node = elements.corners[corner + a * LANES]
        for i in range(3):
            for j in range(3):
                h[3 * i + j] += u[node + i] * g[3 * a + j]
    square = 0.0
    for i in range(9):
        square += h[i] * h[i]
    return square, elements.data[at + 13 * LANES]


@inner(error_model='numpy')
def _spread(elements, tet, g, p, weight, f):
    """Add the nodal forces of a stress."""
    corner = 4 * (tet // LANES) * LANES + tet % LANES
    for a in range(4):
        node = elements.corners[corner + a * LANES]
        for i in range(3):
            value = 0.0
            for j in range(3):
                value += p[3 * i + j] * g[3 * a + j]
            f[node + i] += weight * value


@inner(error_model='numpy')
def _add_elements(law, elements, chunks, u, f, mode):
    """Add the law of the elements less its linear part; return that energy [J]."""
    tolerance = law.tolerance[1]
    if mode != _FORCE or law.counters[0] <= 0:
        law.counters[1] = groups_beyond(elements, chunks, u, _NEAR * tolerance, law.candidates)
        law.counters[0] = _EVERY
    law.counters[0] -= 1
    groups = law.candidates[: law.counters[1]]
    if mode == _IMPLICIT:
        g, h, p = np.empty(12), np.empty(9), np.empty(9)
        law.element_bounds[:] = 0.0
        for first in groups:
            for tet in range(first, first + GROUP):
                square, stiffness = _element_gradient(elements, tet, u, g, h)
                if square >= tolerance * tolerance and stiffness > 0.0:
                    law.element_bounds[tet] = _full_bound(h, law.elements, p)
    return add_group_forces(law.elements, tolerance, elements, groups, u, f)


@inner(error_model='numpy')
def add_law_forces(law, domains, elements, awake, spans, chunks, u, f, mode):
    """Add the forces of domains and elements; those of the tensors are in f.

    Args:
        law: its operands.
        domains: smoothing domains.
        elements: shape functions and volumes.
        awake: intervals of evaluated nodes, shape (s, 2).
        spans: intervals of evaluated domains, shape (s, 2).
        chunks: evaluated chunks of elements, shape (k,).
        u: displacement by coordinate [m], shape (3 n,).
        f: added to [N], shape (3 n,).
        mode: as `rotation_steps` of `internal_force`: -1: exact, with the whole energy; 1: a step;
            3: before products of an implicit step.

    Returns:
        Elastic energy [J] with mode -1, the tensors' included; else no meaning.
    """
    total = 0.0
    if mode == _ENERGY:
        for s in range(awake.shape[0]):
            for i in range(3 * awake[s, 0], 3 * awake[s, 1]):
                total += 0.5 * u[i] * f[i]
    law.implicit[0] = 1 if mode == _IMPLICIT else 0
    total += _add_domains(law, domains, spans, u, f, mode)
    return total + _add_elements(law, elements, chunks, u, f, mode)


@inner(error_model='numpy')
def add_law_bounds(law, domains, elements, spans, chunks, x, f):
    """Add, to a linear product, the bounds of the tangent where the law counts.

    Arguments: see `add_law_forces`; x is multiplied.
    """
    if law.implicit[0] == 0:
        return
    h, linear, g = np.empty(9), np.empty(9), np.empty(12)
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(domains.used.shape[0], spans[s, 1])):
            bound = law.domain_bounds[i]
            if bound == 0.0:
                continue
            a, b, c = smoothed_gradient(domains, x, i)
            h[0], h[1], h[2] = a
            h[3], h[4], h[5] = b
            h[6], h[7], h[8] = c
            linear_stress(h, law.domains, linear)
            for j in range(9):
                linear[j] = domains.volume[i] * (bound * h[j] - linear[j])
            columns = (
                three(linear[0], linear[3], linear[6]),
                three(linear[1], linear[4], linear[7]),
                three(linear[2], linear[5], linear[8]),
            )
            add_domain_forces(domains, i, *columns, f)
    mu = law.elements[0] + law.elements[1]
    for first in law.candidates[: law.counters[1]]:
        for tet in range(first, first + GROUP):
            bound = law.element_bounds[tet]
            if bound == 0.0:
                continue
            _, stiffness = _element_gradient(elements, tet, x, g, h)
            linear_stress(h, law.elements, linear)
            for j in range(9):
                linear[j] = bound * h[j] - linear[j]
            _spread(elements, tet, g, linear, 0.5 * stiffness / mu, f)


@inner(error_model='numpy')
def _add_trace(domains, i, xx, xy, xz, yy, yz, zz, traces):
    """Add V G^T B G of a domain to the traces of its nodes, B as in `tangents_in_lanes`."""
    volume = domains.volume[i]
    for k in range(domains.start[i], domains.start[i] + domains.used[i]):
        x, y, z = domains.vectors[3 * k], domains.vectors[3 * k + 1], domains.vectors[3 * k + 2]
        off = xy * x * y + xz * x * z + yz * y * z
        square = xx * x * x + yy * y * y + zz * z * z
        traces[domains.columns[k] // 3] += volume * (square + 2.0 * off)


@kernel(error_model='numpy')
def linear_traces(law, domains, elements, chunks, traces):
    """Compute the traces of the 3x3 blocks on the diagonal of the linear stiffness.

    Args:
        law, domains, elements, chunks: see `add_law_forces`.
        traces: output [N/m], shape (n,).
    """
    traces[:] = 0.0
    g, h, u = np.empty(12), np.empty(9), np.zeros(3 * traces.shape[0])
    both = 4.0 * (law.domains[0] + law.domains[1]) + law.domains[2]
    for i in range(domains.used.shape[0]):
        _add_trace(domains, i, both, 0.0, 0.0, both, 0.0, both, traces)
    for k in chunks:
        for tet in range(k * LANES, (k + 1) * LANES):
            _, stiffness = _element_gradient(elements, tet, u, g, h)
            corner = 4 * k * LANES + tet % LANES
            for a in range(4):
                square = g[3 * a] ** 2 + g[3 * a + 1] ** 2 + g[3 * a + 2] ** 2
                traces[elements.corners[corner + a * LANES] // 3] += 2.0 * stiffness * square


@inner(error_model='numpy')
def _flush_traces(law, domains, waiting, chunk, traces, strain):
    """Add what the tangents of the domains in the lanes have more, and note their strain."""
    L = LANES
    tangents_in_lanes(chunk, law.domains)
    for lane in range(waiting.shape[0]):
        b = chunk[lane + STRESS * L :: L]
        _add_trace(domains, waiting[lane], b[0], b[1], b[2], b[3], b[4], b[5], traces)
        ratio = chunk[lane + RATIO * L]
        strain[0] += 1.0
        strain[2], strain[3] = min(strain[2], ratio), max(strain[3], ratio)
        strain[4] = min(strain[4], chunk[lane + MIN_STRETCH * L])
        strain[5] = max(strain[5], chunk[lane + MAX_STRETCH * L])


@kernel(error_model='numpy')
def add_tangent_traces(law, domains, elements, spans, chunks, u, traces, strain):
    """Add what the tangent has more than the linear stiffness to traces of 3x3 blocks.

    Args:
        law, domains, elements, spans, chunks, u: see `add_law_forces`.
        traces: added to [N/m], shape (n,).
        strain: output: number of domains and of elements beyond the tolerance, least and largest J
            of these domains, their least and largest principal stretch, shape (6,).
    """
    chunk, waiting = np.zeros(SLOTS_OF_LAW * LANES), np.empty(LANES, np.int64)
    least, count, n = law.tolerance[0] ** 2, 0, domains.used.shape[0]
    strain[0] = strain[1] = 0.0
    strain[2:] = 1.0
    for s in range(spans.shape[0]):
        for i in range(spans[s, 0], min(n, spans[s, 1])):
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = smoothed_gradient(domains, u, i)
            square = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz
            square += zx * zx + zy * zy + zz * zz
            if square < least:
                continue
            lane = chunk[count::LANES]
            lane[0], lane[1], lane[2], lane[3], lane[4] = xx, xy, xz, yx, yy
            lane[5], lane[6], lane[7], lane[8] = yz, zx, zy, zz
            waiting[count] = i
            count += 1
            if count == LANES:
                _flush_traces(law, domains, waiting, chunk, traces, strain)
                count = 0
    _flush_traces(law, domains, waiting[:count], chunk, traces, strain)
    count = groups_beyond(elements, chunks, u, law.tolerance[1], law.candidates)
    groups = law.candidates[:count]
    strain[1] = add_group_traces(law.elements, law.tolerance[1], elements, groups, u, traces)
    law.counters[0] = 0


NO_LAW = Law(
    np.zeros(0), np.zeros(0), np.zeros(2), np.zeros(2, np.int64), np.zeros(0, np.int64),
    np.zeros(1, np.int64), np.zeros(0), np.zeros(0),
)  # fmt: skip
