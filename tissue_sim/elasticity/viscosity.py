"""Viscosity by a Prony series: stresses that shear has relaxed from, by node.

The elastic model has the instantaneous moduli. Of the deviatoric stress T of a node's smoothing
domain, in the frame that turns with it, each term follows with its relaxation time, and its share
is taken from the elastic stress:

    s_i' = (T - s_i) / tau_i,    P = P_elastic - R sum of g_i s_i

Volume stays elastic. The s_i are constant for some substeps, in which they are a nodal load; then
they follow the present T. For a linear law no motion whatever gains energy from that: with
a = 1 - exp(-dt / tau), summation by parts of the work leaves - (1 / a - 1 / 2) |change of s|^2.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.node_common.kernels import inner, kernel
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import (
    NodalSmoothing,
    SmoothingDomains,
    add_domain_forces,
    smoothed_gradient,
)
from cutting_trainer.tissue_sim.elasticity.rotation import (
    LANES,
    ORDERED_MATH,
    ROTATION,
    SLOTS,
    settle,
)
from cutting_trainer.tissue_sim.elasticity.simd import three
from cutting_trainer.tissue_sim.elasticity.stiffening import (
    MAX_EXPONENT,
    MIN_RATIO,
    stiffening_stress,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta, Touched, carried_over, grown

KEPT = 7
"""Numbers of a term at a node: s by xx, yy, zz, xy, xz, yz, and its energy alone [Pa]."""
LINEAR, TURNING, LAW = 0, 1, 2
_ROTATION_TOLERANCE = 1e-9
"""[rad]; its square is the error of a stress."""


class ViscousNodes(NamedTuple):
    """State by node.

    Attributes:
        terms: KEPT numbers for each term, shape (n, KEPT k).
        relief: stress that the load stands for, by rows [Pa], shape (n, 9).
        since: simulated time of the last change [s], shape (n,).
        energy: what the terms add to the elastic energy, negative or positive [J], shape (n,).
        rotation: quaternions, shape (n, 4).
    """

    terms: np.ndarray
    relief: np.ndarray
    since: np.ndarray
    energy: np.ndarray
    rotation: np.ndarray


# Rows of arrays are passed by the array and an index: a slice for each node takes longer than the
# arithmetic.


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


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _matrix(rotation, i, r):
    """Compute the matrix of a node's quaternion, by rows."""
    w, x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2], rotation[i, 3]
    r[0], r[1], r[2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[3], r[4], r[5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r[6], r[7], r[8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _turned_back(r, f, out):
    """Compute sym(R^T F) by xx, yy, zz, xy, xz, yz."""
    out[0] = r[0] * f[0] + r[3] * f[3] + r[6] * f[6]
    out[1] = r[1] * f[1] + r[4] * f[4] + r[7] * f[7]
    out[2] = r[2] * f[2] + r[5] * f[5] + r[8] * f[8]
    xy = r[0] * f[1] + r[3] * f[4] + r[6] * f[7] + r[1] * f[0] + r[4] * f[3] + r[7] * f[6]
    xz = r[0] * f[2] + r[3] * f[5] + r[6] * f[8] + r[2] * f[0] + r[5] * f[3] + r[8] * f[6]
    yz = r[1] * f[2] + r[4] * f[5] + r[7] * f[8] + r[2] * f[1] + r[5] * f[4] + r[8] * f[7]
    out[3], out[4], out[5] = 0.5 * xy, 0.5 * xz, 0.5 * yz


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _deviatoric(kind, law, r, f, p, t, e):
    """Compute deviatoric stress t [Pa] and strain e of a gradient F, in its own frame, shape (6,).

    Args:
        kind: LINEAR, TURNING or LAW.
        law: mu, 0, lambda and b, see `stiffening_stress`.
        r: rotation by rows; the identity for LINEAR.
        f: deformation gradient by rows; changed.
        p: scratch, shape (9,).
    """
    _turned_back(r, f, e)
    for k in range(3):
        e[k] -= 1.0
    mean = (e[0] + e[1] + e[2]) / 3.0
    for k in range(3):
        e[k] -= mean
    if kind != LAW:
        for k in range(6):
            t[k] = 2.0 * law[0] * e[k]
        return
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
    off = work / (3.0 * ratio)  # what is left has no part along the change of volume
    p[0], p[1], p[2] = p[0] - off * c0, p[1] - off * c1, p[2] - off * c2
    p[3] -= off * (f[2] * f[7] - f[1] * f[8])
    p[4] -= off * (f[0] * f[8] - f[2] * f[6])
    p[5] -= off * (f[1] * f[6] - f[0] * f[7])
    p[6] -= off * (f[1] * f[5] - f[2] * f[4])
    p[7] -= off * (f[2] * f[3] - f[0] * f[5])
    p[8] -= off * (f[0] * f[4] - f[1] * f[3])
    _turned_back(r, p, t)


@inner(error_model='numpy')
def _conjugate(square, law):
    """Return the energy by volume that belongs to a stress alone: s e - W(e) of its strain e [Pa].

    In a deviatoric strain the law has W = mu / (2 b) (exp(y) - 1) with y = 2 b |e|^2, so that
    2 y exp(2 y) = b |s|^2 / mu^2: Lambert's function, by the iteration of Iacono and Boyd (2017).

    Args:
        square: |s|^2 [Pa^2].
        law: see `_deviatoric`; b 0 for the linear law.
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


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _follow(kind, law, series, rates, t, e, terms, i, total, out):
    """Let the terms of a node follow its stress.

    Args:
        kind, law, t, e: see `_deviatoric`.
        series: g and tau [s] of the terms, shape (k, 2).
        rates: a = 1 - exp(-dt / tau) of the terms, shape (k,).
        terms: KEPT numbers for each term, changed at node i, shape (n, KEPT k).
        total: output: sum of g s [Pa], shape (6,).
        out: added to: energy and loss by volume [Pa]; raised: square of the largest |t - s|,
            shape (3,).
    """
    for k in range(6):
        total[k] = 0.0
    for term in range(rates.shape[0]):
        g, a, at = series[term, 0], rates[term], KEPT * term
        change = square = gained = before = 0.0
        for k in range(6):
            twice = 1.0 if k < 3 else 2.0
            away = t[k] - terms[i, at + k]
            before -= twice * terms[i, at + k] * e[k]
            stress = terms[i, at + k] + a * away
            terms[i, at + k] = stress
            total[k] += g * stress
            change += twice * away * away
            square += twice * stress * stress
            gained += twice * stress * e[k]
        out[2] = max(out[2], change)
        before += terms[i, at + 6]
        own = _conjugate(square, law) if kind == LAW else square / (4.0 * law[0])
        terms[i, at + 6] = own
        # In the same shape, what the terms store less is lost.
        out[0] += g * (own - gained)
        out[1] += g * (before - own + gained)


@inner(error_model='numpy', fastmath=ORDERED_MATH)
def _renew(r, total, relief, i, volume, new):
    """Compute the change of V R total since the last relief, which it becomes."""
    for a in range(3):
        x, y, z = r[3 * a], r[3 * a + 1], r[3 * a + 2]
        px = x * total[0] + y * total[3] + z * total[4]
        py = x * total[3] + y * total[1] + z * total[5]
        pz = x * total[4] + y * total[5] + z * total[2]
        new[3 * a] = volume * (px - relief[i, 3 * a])
        new[3 * a + 1] = volume * (py - relief[i, 3 * a + 1])
        new[3 * a + 2] = volume * (pz - relief[i, 3 * a + 2])
        relief[i, 3 * a], relief[i, 3 * a + 1], relief[i, 3 * a + 2] = px, py, pz


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
        law, kind: see `_deviatoric`.
        load: changed by the change of the nodes' stress [N], shape (3 n,).

    Returns:
        Energy lost [J], and the largest stress still to be relaxed [Pa].
    """
    chunk, out = np.zeros(SLOTS * LANES), np.zeros(3)
    f, r, p, new = np.empty(9), np.zeros(9), np.empty(9), np.empty(9)
    t, e, total, rates = np.empty(6), np.empty(6), np.empty(6), np.zeros(len(series))
    r[0] = r[4] = r[8] = 1.0
    chunk[ROTATION * LANES : (ROTATION + 1) * LANES] = 1.0
    elapsed, lost = 0.0, 0.0
    for s in range(spans.shape[0]):
        for low in range(spans[s, 0], spans[s, 1], LANES):
            high = min(low + LANES, spans[s, 1])
            for i in range(low, high):
                rows = smoothed_gradient(domains, u, i)
                _put(rows[0], rows[1], rows[2], nodes.rotation, i, i - low, chunk)
            if kind != LINEAR:
                settle(chunk, _ROTATION_TOLERANCE, 100)
            for i in range(low, high):
                if now - nodes.since[i] != elapsed:
                    elapsed = now - nodes.since[i]
                    for term in range(len(series)):
                        rates[term] = -math.expm1(-elapsed / series[term, 1])
                for k in range(9):
                    f[k] = chunk[i - low + k * LANES]
                if kind != LINEAR:
                    for k in range(4):
                        nodes.rotation[i, k] = chunk[i - low + (ROTATION + k) * LANES]
                    _matrix(nodes.rotation, i, r)
                _deviatoric(kind, law, r, f, p, t, e)
                out[0] = out[1] = 0.0
                _follow(kind, law, series, rates, t, e, nodes.terms, i, total, out)
                volume = domains.volume[i]
                nodes.energy[i] = volume * out[0]
                lost += volume * out[1]
                nodes.since[i] = now
                _renew(r, total, nodes.relief, i, volume, new)
                columns = three(new[0], new[3], new[6]), three(new[1], new[4], new[7])
                last = three(new[2], new[5], new[8])
                add_domain_forces(domains, i, columns[0], columns[1], last, load)
    return lost, math.sqrt(out[2])


class Viscosity:
    """Viscous state of a mesh under cuts.

    Args:
        model: the elastic model, whose material has a Prony series.
    """

    def __init__(self, model: ElasticModel) -> None:
        self._model, m, n = model, model.material, model.mesh.node_count
        self._series = np.array(m.prony)
        self._law = np.array([m.lame_mu, 0.0, m.lame_lambda, m.stiffening])
        self._kind = LAW if model.lawful else TURNING if model.rotating else LINEAR
        self._own = None
        if model.smoothing is None or len(model.mesh.regions):
            # One state by node: where regions meet, that of their mean strain by stiffness. What
            # relaxes is then never more than the elements store.
            constants = m.lame_lambda, m.lame_mu, m.relative_stiffness
            self._own = NodalSmoothing(model.mesh, *constants, split=False)
        terms = np.zeros((n, KEPT * len(self._series)))
        self.nodes = ViscousNodes(
            terms, np.zeros((n, 9)), np.zeros(n), np.zeros(n), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        )
        self._time = 0.0
        self._left = np.inf
        self.lost = 0.0

    @property
    def shortest(self) -> float:
        """Shortest relaxation time [s]."""
        return float(self._series[:, 1].min())

    @property
    def settled(self) -> bool:
        """Whether nothing is left to relax, but for rounding."""
        return self._left < 1e-9 * self._law[0]

    @property
    def energy(self) -> float:
        """Energy that the terms add to the elastic one [J]: what is stored is the sum."""
        return float(self.nodes.energy[: self._model.mesh.node_count].sum())

    def advance(self, u: np.ndarray, seconds: float, spans: np.ndarray, load: np.ndarray) -> None:
        """Let the terms of some nodes follow their stress.

        Those of other nodes, whose strain does not change, follow once they are among them.

        Args:
            u: displacement by coordinate at the end [m], shape (3 n,).
            seconds: simulated time since the last call [s].
            spans: intervals of nodes, shape (s, 2).
            load: of the model, changed [N], shape (3 n,).
        """
        self._time += seconds
        lost, self._left = self._relieve(u, self._time, spans, load)
        self.lost += lost

    def relax(self, u: np.ndarray, load: np.ndarray) -> None:
        """Relax all stresses in full, as after a long time in this shape.

        Arguments: see `advance`.
        """
        self._relieve(u, np.inf, self._everywhere, load)
        self.nodes.since[:] = self._time
        self._left = 0.0

    def reload(self, u: np.ndarray, load: np.ndarray) -> None:
        """Add the whole relief to a load without it; no time passes.

        Arguments: see `advance`.
        """
        self.nodes.relief[:] = 0.0
        self._relieve(u, self._time, self._everywhere, load)

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Carry the state through a change of connectivity; `reload` must follow.

        Args:
            count: of nodes before it.
            delta: the change, which mesh and model have followed.
            touched: the written slots.
        """
        if self._own is not None:
            self._own.update(touched.nodes)
        total = count + len(delta.node_parents)
        self.nodes = ViscousNodes(*(grown(values, total) for values in self.nodes))
        carried_over(self.nodes.terms, count, delta, touched)
        flat = self.nodes.since[:, None]
        carried_over(flat, count, delta, touched)
        self.nodes.rotation[count:] = self.nodes.rotation[touched.nodes] = (1.0, 0.0, 0.0, 0.0)
        self._left = np.inf

    def kept(self) -> tuple[Any, ...]:
        """Return a copy of the state without the load, for `restore`."""
        copies = tuple(values.copy() for values in self.nodes)
        return ViscousNodes(*copies), self._time, self._left, self.lost

    def restore(self, kept: tuple[Any, ...]) -> None:
        """Return to a state of `kept`; its load must follow."""
        nodes, self._time, self._left, self.lost = kept
        self.nodes = ViscousNodes(*(values.copy() for values in nodes))

    @property
    def domains(self) -> SmoothingDomains:
        """Return the smoothing domains whose strain counts."""
        smoothing = self._own or self._model.smoothing
        assert smoothing is not None
        return smoothing.operands

    @property
    def _everywhere(self) -> np.ndarray:
        return np.array([[0, self._model.mesh.node_count]])

    def _relieve(
        self, u: np.ndarray, now: float, spans: np.ndarray, load: np.ndarray
    ) -> tuple[float, float]:
        lost, left = relieve(
            self.domains, self.nodes, spans, u, now, self._series, self._law, self._kind, load
        )
        return float(lost), float(left)
