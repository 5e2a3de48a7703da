"""A rigid sphere pressed into a layer on a rigid ground: quadratic axisymmetric elements.

Shape functions and quadrature are scikit-fem's; the sphere is exact, without friction, held out by
a penalty. Published formulas of the same problem stand beside.
"""

import math
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray
from skfem.helpers import grad

Floats = NDArray[np.float64]

_ITERATIONS = 40
_CLOSE = 1e-5
"""Newton step, relative to the depth, at which the equilibrium is converged."""
_MAX_STEP = 0.1
"""Longest Newton step, relative to the sphere's radius."""
_PENALTY = 30.0
"""Stiffness of the penalty, in moduli over the smallest element."""


@dataclass(frozen=True)
class Layer:
    """A round layer, fixed at its underside.

    Attributes:
        thickness, width: height and radius [m].
        youngs_modulus: [Pa].
        poissons_ratio: [-].
    """

    thickness: float
    width: float
    youngs_modulus: float
    poissons_ratio: float

    @property
    def plane_modulus(self) -> float:
        """E / (1 - nu^2) [Pa]."""
        return self.youngs_modulus / (1 - self.poissons_ratio**2)


def hertz(layer: Layer, radius: float, depth: float) -> float:
    """Return Hertz's force on a half-space [N]; lengths in m."""
    return 4 / 3 * layer.plane_modulus * math.sqrt(radius) * depth**1.5


def sneddon(layer: Layer, radius: float, depth: float) -> float:
    """Return the force of a sphere, not a paraboloid, on a half-space [N] (Sneddon 1965)."""
    low, high = 0.0, radius
    for _ in range(80):
        a = (low + high) / 2
        if a / 2 * math.log((radius + a) / (radius - a)) < depth:
            low = a
        else:
            high = a
    log = math.log((radius + a) / (radius - a))
    return layer.plane_modulus * ((a * a + radius * radius) / 2 * log - a * radius)


def thickness_factor(layer: Layer, radius: float, depth: float) -> float:
    """Return how much stiffer a bonded layer is than a half-space (Dimitriadis et al. 2002)."""
    nu, chi = layer.poissons_ratio, math.sqrt(radius * depth) / layer.thickness
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    pi = math.pi
    return (
        1
        - 2 * a / pi * chi
        + 4 * a**2 / pi**2 * chi**2
        - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        + 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    )


class SphereOnLayer:
    """The layer in quadratic triangles, fine under the sphere.

    Args:
        layer: what is pressed.
        radius: of the sphere [m].
        fine: smallest element [m].
        large: neo-Hookean at finite strain (energy as in `hyperelastic.py`), or linear.
    """

    def __init__(self, layer: Layer, radius: float, fine: float, *, large: bool) -> None:
        across = _graded(fine, 1.1 * radius, layer.width)
        down = -_graded(fine, 1.1 * radius, layer.thickness)[::-1]
        mesh = skfem.MeshTri.init_tensor(across, down)
        top = mesh.facets_satisfying(lambda x: x[1] > -1e-12)
        element = skfem.ElementVector(skfem.ElementTriP2())
        self._basis = skfem.Basis(mesh, element, intorder=4)
        self._surface = skfem.FacetBasis(mesh, element, facets=top, intorder=6)
        bottom = self._basis.get_dofs(lambda x: x[1] < -layer.thickness + 1e-12)
        axis = self._basis.get_dofs(lambda x: x[0] < 1e-12).all(['u^1'])
        free = np.ones(self._basis.N, bool)
        free[np.concatenate([bottom.all(), axis])] = False
        self._free = np.flatnonzero(free)
        e, nu = layer.youngs_modulus, layer.poissons_ratio
        self._lame = e * nu / (1 + nu) / (1 - 2 * nu), e / 2 / (1 + nu)
        self._penalty = _PENALTY * e / fine
        self._radius, self._large = radius, large
        self._u = np.zeros(self._basis.N)

    def force(self, depth: float, steps: int = 4) -> float:
        """Return the force at a depth [N], from the depth of the last call on."""
        last = getattr(self, '_depth', 0.0)
        for part in range(1, steps + 1):
            self._press(last + (depth - last) * part / steps)
        self._depth = depth
        return self._reaction

    def _press(self, depth: float) -> None:
        for _ in range(_ITERATIONS):
            residual, tangent = self._assemble(depth)
            free = self._free
            step = np.zeros_like(self._u)
            step[free] = skfem.solve(tangent[free][:, free].tocsc(), -residual[free])
            part = min(1.0, _MAX_STEP * self._radius / max(abs(step).max(), 1e-300))
            before = self._energy(self._u, depth)
            while not self._energy(self._u + part * step, depth) <= before * (1 + 1e-12):
                part /= 2
                if part < 1e-6:
                    break
            self._u += part * step
            if abs(step).max() < _CLOSE * depth:
                return
        raise ValueError(f'no equilibrium at {1e3 * depth:g} mm')

    def _energy(self, u: Floats, depth: float) -> float:
        """Return the energy of layer and penalty [J]; infinite where an element has turned over."""
        lam, mu = self._lame

        @skfem.Functional
        def stored(w):
            f = _shares(w)
            return 2 * np.pi * w.x[0] * _density(f, lam, mu, large=self._large)

        @skfem.Functional
        def held(w):
            return np.pi * w.x[0] * self._penalty * self._gap(w, depth)[0] ** 2

        with np.errstate(invalid='ignore', divide='ignore'):
            inner = stored.assemble(self._basis, last=self._basis.interpolate(u))
        outer = held.assemble(self._surface, last=self._surface.interpolate(u))
        return float(inner + outer) if np.isfinite(inner) else np.inf

    def _gap(self, w, depth: float):
        """Return how far the surface is inside of the sphere [m], its slope, and the root there."""
        last, radius = w['last'], self._radius
        r = np.clip(w.x[0] + (last[0] if self._large else 0.0), 0.0, 0.999 * radius)
        root = np.sqrt(radius**2 - r**2)
        inside = np.where(w.x[0] < 0.999 * radius, last[1] + depth - radius + root, 0.0)
        return np.maximum(inside, 0.0), (-r / root if self._large else 0.0 * r), root

    def _assemble(self, depth: float) -> tuple[Floats, object]:
        lam, mu = self._lame
        large, radius, penalty = self._large, self._radius, self._penalty

        def around(w, pairs):
            """Return the sum of products, times the ring around the axis."""
            return 2 * np.pi * w.x[0] * sum(s * t for s, t in pairs)

        @skfem.LinearForm
        def inner(v, w):
            p = _stress(_shares(w), lam, mu, large=large)
            return around(w, zip(p, _gradient(v, w.x), strict=True))

        @skfem.BilinearForm
        def stiffness(u, v, w):
            dp = _stress_change(_shares(w), _gradient(u, w.x), lam, mu, large=large)
            return around(w, zip(dp, _gradient(v, w.x), strict=True))

        @skfem.LinearForm
        def pushed(v, w):
            g, slope, _ = self._gap(w, depth)
            return 2 * np.pi * w.x[0] * penalty * g * (v[1] + slope * v[0])

        @skfem.BilinearForm
        def pushed_change(u, v, w):
            g, slope, root = self._gap(w, depth)
            bend = -(radius**2) / root**3 if large else 0.0
            both = (u[1] + slope * u[0]) * (v[1] + slope * v[0]) + g * bend * u[0] * v[0]
            return 2 * np.pi * w.x[0] * penalty * (g > 0) * both

        inside = {'last': self._basis.interpolate(self._u)}
        outside = {'last': self._surface.interpolate(self._u)}
        load = pushed.assemble(self._surface, **outside)
        vertical = np.zeros(self._basis.N, bool)
        vertical[self._basis.nodal_dofs[1]] = True
        vertical[self._basis.facet_dofs[1]] = True
        self._reaction = float(load[vertical].sum())
        residual = inner.assemble(self._basis, **inside) + load
        tangent = stiffness.assemble(self._basis, **inside)
        tangent = tangent + pushed_change.assemble(self._surface, **outside)
        return residual, tangent


def _gradient(u, x):
    """Return the displacement gradient in cylindrical coordinates: rr, rz, zr, zz and around."""
    g = grad(u)
    return g[0, 0], g[0, 1], g[1, 0], g[1, 1], u[0] / x[0]


def _shares(w):
    """Return the same parts of the deformation gradient."""
    a, b, c, d, e = _gradient(w['last'], w.x)
    return 1 + a, b, c, 1 + d, 1 + e


def _density(f, lam, mu, *, large):
    """Return the energy by volume."""
    a, b, c, d, e = f
    if not large:
        trace = a + d + e - 3
        normal = (a - 1) ** 2 + (d - 1) ** 2 + (e - 1) ** 2
        return lam / 2 * trace**2 + mu * (normal + (b + c) ** 2 / 2)
    log = np.where(e > 0, np.log((a * d - b * c) * e), np.nan)
    squares = a * a + b * b + c * c + d * d + e * e - 3
    return mu / 2 * squares - mu * log + lam / 2 * log**2


def _stress(f, lam, mu, *, large):
    """Return the same parts of the first Piola-Kirchhoff stress."""
    a, b, c, d, e = f
    if not large:
        trace = lam * (a + d + e - 3)
        shear = mu * (b + c)
        return (
            trace + 2 * mu * (a - 1),
            shear,
            shear,
            trace + 2 * mu * (d - 1),
            trace + 2 * mu * (e - 1),
        )
    plane = a * d - b * c
    log = np.log(plane * e)
    s = lam * log - mu
    return (
        mu * a + s * d / plane,
        mu * b - s * c / plane,
        mu * c - s * b / plane,
        mu * d + s * a / plane,
        mu * e + s / e,
    )


def _stress_change(f, h, lam, mu, *, large):
    """Return the change of the stress by a change of F."""
    a, b, c, d, e = f
    da, db, dc, dd, de = h
    if not large:
        trace = lam * (da + dd + de)
        shear = mu * (db + dc)
        return trace + 2 * mu * da, shear, shear, trace + 2 * mu * dd, trace + 2 * mu * de
    plane = a * d - b * c
    change = da * d + a * dd - db * c - b * dc
    s = lam * np.log(plane * e) - mu
    ds = lam * (change / plane + de / e)
    turn = s * change / plane**2
    return (
        mu * da + ds * d / plane + s * dd / plane - turn * d,
        mu * db - ds * c / plane - s * dc / plane + turn * c,
        mu * dc - ds * b / plane - s * db / plane + turn * b,
        mu * dd + ds * a / plane + s * da / plane - turn * a,
        mu * de + ds / e - s * de / e**2,
    )


def _graded(fine: float, until: float, size: float) -> Floats:
    """Return coordinates from 0 to a size: even steps at first, then wider and wider [m]."""
    at = list(np.linspace(0.0, until, max(round(until / fine), 1) + 1))
    step = at[1]
    while at[-1] < size:
        step *= 1.25
        at.append(at[-1] + step)
    wide = np.array(at)
    first = wide <= until + 1e-12
    wide[~first] = until + (wide[~first] - until) * (size - until) / (wide[-1] - until)
    return wide
