"""A law that stiffens: energy, stress and bounds of its tangent at one point.

Energy by volume, with x = |F|^2 - 3 - 2 ln J and J = det F:

    W = a / (2 b) (exp(b x) - 1) + c / (2 b) (exp'(b x) - 1) + lambda / 2 (ln J)^2

exp' is continued from a lower exponent on: an element's own strain, which no average smooths,
stiffens it that far and no further. Small strains give linear elasticity with mu = a + c. Below
`MIN_RATIO` the logarithm continues on its tangent, so an element that is inside out has a finite
energy and is driven back. Above `MAX_EXPONENT` the exponential continues on its tangent too: no
force overflows.

Difference form: a point has the linear law where |F - I| is below a tolerance, this law above twice
the tolerance, and in between a blend of the two energies. Stresses are derivatives of the blended
energy, so a point that changes over creates no energy.
"""

import math

from cutting_trainer.node_common.kernels import inner, kernel

MIN_RATIO = 0.25
"""Volume ratio J below which the logarithm is continued."""
MAX_EXPONENT = 3.0
"""Exponent b x above which the exponential is continued: stiffened by exp(3) = 20."""
MAX_OWN_EXPONENT = 3.0
"""The same for the share of mu that belongs to the elements. At 2 they give way too far: a punch of
30 % is 5 % too soft, a twist by 90 degrees 8 %."""


@inner(error_model='numpy')
def _logarithm(ratio):
    """Return the continued ln J and its derivative."""
    if ratio > MIN_RATIO:
        return math.log(ratio), 1.0 / ratio
    return math.log(MIN_RATIO) + ratio / MIN_RATIO - 1.0, 1.0 / MIN_RATIO


@inner(error_model='numpy')
def _exponential(y, most):
    """Return exp(y), continued above an exponent, and its derivative."""
    if y < most:
        e = math.exp(y)
        return e, e
    e = math.exp(most)
    return e * (1.0 + y - most), e


@kernel(error_model='numpy')
def law_factors(square, ratio, constants):
    """Compute factors of the stress, P = g F + q cof F, and the energy.

    Args:
        square: |F|^2.
        ratio: J.
        constants: as for `stiffening_stress`.

    Returns:
        g, q and the energy by volume [Pa].
    """
    a, c, lam, b = constants[0], constants[1], constants[2], constants[3]
    log, slope = _logarithm(ratio)
    x = square - 3.0 - 2.0 * log
    energy = 0.5 * lam * log * log
    g = a + c
    if b > 0.0:
        e, rise = _exponential(b * x, MAX_EXPONENT)
        own, own_rise = e, rise
        if b * x > MAX_OWN_EXPONENT:
            own, own_rise = _exponential(b * x, MAX_OWN_EXPONENT)
        energy += 0.5 / b * (a * (e - 1.0) + c * (own - 1.0))
        g = a * rise + c * own_rise
    else:
        energy += 0.5 * (a + c) * x
    return g, (lam * log - g) * slope, energy


@inner(error_model='numpy')
def stiffening_stress(h, constants, p):
    """Compute the stress of the law.

    Args:
        h: displacement gradient F - I, by rows, shape (9,).
        constants: a, c, lambda [Pa] and b, see the module, shape (4,).
        p: output, first Piola-Kirchhoff stress [Pa], by rows, shape (9,).

    Returns:
        Energy by volume [Pa].
    """
    # No arrays of its own: an allocation takes as long as the logarithm.
    f0, f1, f2, f3, f4 = 1.0 + h[0], h[1], h[2], h[3], 1.0 + h[4]
    f5, f6, f7, f8 = h[5], h[6], h[7], 1.0 + h[8]
    square = f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3 + f4 * f4 + f5 * f5 + f6 * f6 + f7 * f7 + f8 * f8
    c0, c1, c2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
    ratio = f0 * c0 + f1 * c1 + f2 * c2
    g, q, energy = law_factors(square, ratio, constants)
    p[0], p[1], p[2] = g * f0 + q * c0, g * f1 + q * c1, g * f2 + q * c2
    p[3] = g * f3 + q * (f2 * f7 - f1 * f8)
    p[4] = g * f4 + q * (f0 * f8 - f2 * f6)
    p[5] = g * f5 + q * (f1 * f6 - f0 * f7)
    p[6] = g * f6 + q * (f1 * f5 - f2 * f4)
    p[7] = g * f7 + q * (f2 * f3 - f0 * f5)
    p[8] = g * f8 + q * (f0 * f4 - f1 * f3)
    return energy


@inner(error_model='numpy')
def linear_stress(h, constants, p):
    """Compute the stress of linear elasticity with the same small-strain constants.

    Arguments and result: see `stiffening_stress`.
    """
    mu, lam = constants[0] + constants[1], constants[2]
    pressure = lam * (h[0] + h[4] + h[8])
    p[0], p[4], p[8] = (
        2.0 * mu * h[0] + pressure, 2.0 * mu * h[4] + pressure, 2.0 * mu * h[8] + pressure,
    )  # fmt: skip
    p[1] = p[3] = mu * (h[1] + h[3])
    p[2] = p[6] = mu * (h[2] + h[6])
    p[5] = p[7] = mu * (h[5] + h[7])
    energy = 0.0
    for i in range(9):
        energy += 0.5 * p[i] * h[i]
    return energy


@inner(error_model='numpy')
def blended_difference(h, square, constants, tolerance, p, linear):
    """Compute the stress of the blended law less that of the linear one.

    Args:
        h: displacement gradient, by rows, shape (9,).
        square: |h|^2, at least tolerance^2.
        constants: as for `stiffening_stress`.
        tolerance: |h| from which the law counts; 0: everywhere, without a blend.
        p: output [Pa], shape (9,).
        linear: output, stress of the linear law [Pa], shape (9,).

    Returns:
        Blended energy less the linear one, by volume [Pa].
    """
    energy = stiffening_stress(h, constants, p) - linear_stress(h, constants, linear)
    for i in range(9):
        p[i] -= linear[i]
    if square >= 4.0 * tolerance * tolerance:
        return energy
    size = math.sqrt(square)
    t = size / tolerance - 1.0
    share = t * t * (3.0 - 2.0 * t)
    pull = energy * 6.0 * t * (1.0 - t) / (tolerance * size)
    for i in range(9):
        p[i] = share * p[i] + pull * h[i]
    return share * energy


@inner(error_model='numpy')
def series_logarithm(ratio):
    """Return ln of a number without a branch or call, exact to rounding from 0.1 to 10."""
    z = math.sqrt(math.sqrt(math.sqrt(ratio)))
    s = (z - 1.0) / (z + 1.0)
    q = s * s
    series = 1.0 / 9.0 + q * (1.0 / 11.0 + q * (1.0 / 13.0 + q * (1.0 / 15.0)))
    return 16.0 * s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q * series))))


@inner(error_model='numpy')
def series_exponential(y):
    """Return exp of a number without a branch or call, exact to rounding from 0 to 3."""
    t = 0.125 * y
    e = 1.0 + t / 12.0
    e = 1.0 + t * (1.0 / 9.0) * (1.0 + t * 0.1 * (1.0 + t * (1.0 / 11.0) * e))
    e = 1.0 + t * (1.0 / 6.0) * (1.0 + t * (1.0 / 7.0) * (1.0 + t * 0.125 * e))
    e = 1.0 + t * (1.0 / 3.0) * (1.0 + t * 0.25 * (1.0 + t * 0.2 * e))
    e = 1.0 + t * (1.0 + t * 0.5 * e)
    e *= e
    e *= e
    return e * e


@inner(error_model='numpy')
def _above_zero(x):
    """Return max(x, 0). The compiler branches at a limit that is a constant, and uses no lanes."""
    return 0.5 * (x + abs(x))


@inner(error_model='numpy')
def _third_of_angle(c):
    """Return cos(t / 3) of c = cos(t / 2), t from 0 to pi, to 3e-9: a Chebyshev fit."""
    p = -0.01032557821478206 + c * (0.003707725199965414 - c * 0.0006393211422289745)
    p = 0.05328867622550501 + c * (-0.03196135433763967 + c * (0.01967581340316528 + c * p))
    return 0.5000000032511467 + c * (0.5773497201111707 + c * (-0.11109568692104219 + c * p))


@inner(error_model='numpy', inline='always')
def tangent_factors(square, ratio, a, c, lam, b):
    """Compute the factors of the tangent of the law without a branch.

    With C = cof F, A = F - C / J and unit vectors e_i, its part along a vector G is, by i and k,
    `steep` (A G)_i (A G)_k + `volumetric` (C G)_i (C G)_k + g |G|^2 e_i e_k.

    Args:
        square: |F|^2.
        ratio: J.
        a, c, lam, b: constants, see `stiffening_stress`.

    Returns:
        `steep`, `volumetric` and g [Pa], and 1 / J, continued as ln J is.
    """
    inside = max(ratio, MIN_RATIO)
    slope = 1.0 / inside
    log = series_logarithm(inside) + (ratio - inside) * slope
    bent = 1.0 if ratio > MIN_RATIO else 0.0
    bend = -bent * slope * slope
    y = _above_zero(b * (square - 3.0 - 2.0 * log))
    rise = a * series_exponential(y - _above_zero(y - MAX_EXPONENT))
    own = c * series_exponential(y - _above_zero(y - MAX_OWN_EXPONENT))
    g = rise + own
    below, own_below = 1.0 if y < MAX_EXPONENT else 0.0, 1.0 if y < MAX_OWN_EXPONENT else 0.0
    steep = 2.0 * b * (rise * below + own * own_below)
    return steep, lam * (slope * slope + log * bend) - g * bend, g, slope


@inner(error_model='numpy', inline='always')
def tangent_modulus(h0, h1, h2, h3, h4, h5, h6, h7, h8, a, c, lam, b):
    """Compute the modulus of `tangent_bound` without a branch.

    Args:
        h0, h1, h2, h3, h4, h5, h6, h7, h8: displacement gradient, by rows.
        a, c, lam, b: constants, see `stiffening_stress`.

    Returns:
        The modulus [Pa], J, least and largest principal stretch.
    """
    f0, f4, f8 = 1.0 + h0, 1.0 + h4, 1.0 + h8
    ratio = f0 * (f4 * f8 - h5 * h7) + h1 * (h5 * h6 - h3 * f8) + h2 * (h3 * h7 - f4 * h6)
    # C = F^T F and its eigenvalues
    c00, c11 = f0 * f0 + h3 * h3 + h6 * h6, h1 * h1 + f4 * f4 + h7 * h7
    c22 = h2 * h2 + h5 * h5 + f8 * f8
    c01, c02 = f0 * h1 + h3 * f4 + h6 * h7, f0 * h2 + h3 * h5 + h6 * f8
    c12 = h1 * h2 + f4 * h5 + h7 * f8
    mean = (c00 + c11 + c22) / 3.0
    d0, d1, d2 = c00 - mean, c11 - mean, c22 - mean
    off = c01 * c01 + c02 * c02 + c12 * c12
    size = math.sqrt((d0 * d0 + d1 * d1 + d2 * d2 + 2.0 * off) / 6.0)
    det = d0 * (d1 * d2 - c12 * c12) - c01 * (c01 * d2 - c12 * c02) + c02 * (c01 * c12 - d1 * c02)
    scale = max(size, 1e-9 * mean + 1e-30)  # above 0 without volume, too
    half = 0.5 * det / (scale * scale * scale)  # from -1 to 1, but for rounding
    high = mean + 2.0 * size * _third_of_angle(math.sqrt(abs(0.5 + 0.5 * half)))
    low = _above_zero(mean - 2.0 * size * _third_of_angle(math.sqrt(abs(0.5 - 0.5 * half))))
    s1, s3 = math.sqrt(high), math.sqrt(low)
    s2 = math.sqrt(_above_zero(3.0 * mean - high - low))
    steep, volumetric, g, slope = tangent_factors(3.0 * mean, ratio, a, c, lam, b)
    turned = slope if ratio > 0.0 else -slope
    away1, away2, away3 = s1 - turned * s2 * s3, s2 - turned * s1 * s3, s3 - turned * s1 * s2
    most1 = steep * away1 * away1 + volumetric * (s2 * s3) * (s2 * s3)
    most2 = steep * away2 * away2 + volumetric * (s1 * s3) * (s1 * s3)
    most3 = steep * away3 * away3 + volumetric * (s1 * s2) * (s1 * s2)
    most = max(max(most1, most2), max(most3, 0.0))
    return max(g + most, 2.0 * (a + c) + lam), ratio, s3, s1


@inner(error_model='numpy')
def tangent_bound(h, constants, found):
    """Compute the largest tangent modulus of the law for a plane wave, or of the linear law.

    Args:
        h: displacement gradient, by rows, shape (9,).
        constants: as for `stiffening_stress`.
        found: output: J, least and largest principal stretch, shape (3,).

    Returns:
        Largest a_i b_j D_ijkl a_k b_l of unit vectors a and b [Pa]. As the determinant is linear
        along them, and the law's other derivatives share the principal axes, it is met on one.
    """
    modulus, found[0], found[1], found[2] = tangent_modulus(
        h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8],
        constants[0], constants[1], constants[2], constants[3],
    )  # fmt: skip
    return modulus
