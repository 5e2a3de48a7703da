"""Exact answers of a Prony series of the shear modulus, for steps of strain and of stress."""

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.tissue_sim.elasticity.material import Material

Floats = NDArray[np.float64]


def shear_relaxation(material: Material, time: Floats) -> Floats:
    """Return G(t) / G(0) after a step of strain; `time` in [s]."""
    return np.asarray(1 - sum(g * (1 - np.exp(-time / tau)) for g, tau in material.prony))


def uniaxial_relaxation(material: Material, time: Floats) -> Floats:
    """Return E(t) / E(0) after a step of axial strain, with a bulk modulus that stays."""
    above, below = _axial_modulus(material)
    return _response(above, below, time)


def uniaxial_creep(material: Material, time: Floats) -> Floats:
    """Return D(t) / D(0) of the axial compliance after a step of stress."""
    above, below = _axial_modulus(material)
    return _response(below, above, time)


def series_of_creep(
    growths: tuple[float, ...], times: tuple[float, ...]
) -> tuple[tuple[float, float], ...]:
    """Return g and tau [s] of the terms whose shear compliance grows by some shares.

    Args:
        growths: c of the compliance over its first value, 1 + sum of c (1 - exp(-t / rho)).
        times: rho [s].
    """
    below = whole = _product(list(times))
    for i, growth in enumerate(growths):
        below = below + growth * _product([rho for j, rho in enumerate(times) if j != i])
    poles = np.real(below.roots)
    slope = below.deriv()
    return tuple((float(whole(p) / slope(p) / p), float(-1 / p)) for p in poles)


def _axial_modulus(material: Material) -> tuple[np.poly1d, np.poly1d]:
    """Return numerator and denominator of 9 K G / (3 K + G), with s times the transform of G."""
    e, nu = material.youngs_modulus, material.poissons_ratio
    bulk, shear = e / (3 * (1 - 2 * nu)), material.lame_mu
    whole = _product([tau for _, tau in material.prony])
    g = whole
    for i, (share, _) in enumerate(material.prony):
        g = g - share * _product([tau for j, (_, tau) in enumerate(material.prony) if j != i])
    return 9 * bulk * shear * g, 3 * bulk * whole + shear * g


def _product(times: list[float]) -> np.poly1d:
    found = np.poly1d([1.0])
    for tau in times:
        found = found * np.poly1d([tau, 1.0])
    return found


def _response(above: np.poly1d, below: np.poly1d, time: Floats) -> Floats:
    """Return the inverse transform of above / (below s), relative to its start, by residues."""
    found = np.full_like(time, above(0.0) / below(0.0))
    slope = (below * np.poly1d([1.0, 0.0])).deriv()
    for pole in below.roots:
        found += np.real(above(pole) / slope(pole) * np.exp(pole * time))
    return np.asarray(found / (above.coeffs[0] / below.coeffs[0]))
