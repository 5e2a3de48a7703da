"""Stable time step: a bound of the highest frequency, and the stability regions of integrators."""

from collections.abc import Callable

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands, stiffness_product
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.adjacency import spans_of
from cutting_trainer.tissue_sim.mesh.tetra_mesh import grown
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName


@kernel(error_model='numpy')
def _power_iterations(operands, spans, inverse_mass, x, f, steps):
    """Run power iterations of M^-1 K on x in place; return the last Rayleigh quotient (mass norm).

    Nodes outside of `spans` are held; x is 0 there.
    """
    quotient = 0.0
    for _ in range(steps):
        stiffness_product(operands, x, f)
        above = 0.0
        below = 0.0
        norm = 0.0
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                if inverse_mass[i] > 0.0:
                    above += x[i] * f[i]
                    below += x[i] * x[i] / inverse_mass[i]
                f[i] *= inverse_mass[i]
                norm = max(norm, abs(f[i]))
        if below == 0.0 or norm == 0.0:
            return 0.0
        quotient = above / below
        for s in range(spans.shape[0]):
            for i in range(3 * spans[s, 0], 3 * spans[s, 1]):
                x[i] = f[i] / norm
    return quotient


_ITERATIONS = 48
"""Power iterations after which a quotient has converged."""
_MARGIN = 1.03
"""Factor of a found frequency; power iterations converge from below."""
_LEVELS = 2
"""Neighbours of neighbours around a cut that move as its highest frequency is looked for."""
_ROUNDS = 4
"""Times that masses are raised after a cut, at most."""
_FURTHER = 12
"""Power iterations after each."""
_ROOM = 4.0
"""Room for the stiffening law: square of the frequency to which it raises that of a small element
of a cut within a few substeps, over that at rest."""


def highest_square(operands: Operands, inverse_mass: np.ndarray) -> float:
    """Return the largest eigenvalue of M^-1 K [1/s^2], and 6 % more.

    Args:
        operands: of all nodes.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
    """
    x = np.where(inverse_mass > 0.0, np.random.default_rng(0).standard_normal(len(inverse_mass)), 0)
    whole, f = np.array([[0, len(x) // 3]]), np.zeros(len(x))
    square = _power_iterations(operands, whole, inverse_mass, x, f, _ITERATIONS)
    return _MARGIN**2 * max(float(square), 0.0)


class FrequencyBound:
    """Upper bound of the highest natural frequency of a tissue under cuts.

    Power iterations find the frequency, of the whole tissue at the start, then around each cut with
    the nodes beyond held: that only removes low frequencies, and the bound of before still counts.

    A cut makes small elements, and one sliver would determine the step of the whole tissue. Nodes
    that are faster than a ceiling are therefore integrated with more mass (selective mass scaling):
    a few milligrams, which otherwise would only shorten the step. The mass of a node is in
    proportion to its row in Gershgorin's bound. That bound is too high by a factor, which power
    iterations find in the uncut tissue. Where a cut makes it larger, the masses of that cut are
    raised until the frequency is at the ceiling. With the stiffening law they are four times as
    large: `StiffenedMass` looks at the strain every 16 substeps, and small elements are faster.

    Args:
        model: the elastic model.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        growth: the ceiling, as a multiple of the bound at the start. Below 1, nodes of the mesh
            itself have to be heavier too, see `limit`.
    """

    def __init__(
        self, model: ElasticModel, inverse_mass: np.ndarray, growth: float = np.inf
    ) -> None:
        self._model = model
        self._f = np.zeros(0)
        rows = model.frequency_rows(np.arange(model.mesh.node_count)) * model.mass
        inverse = np.where(inverse_mass > 0.0, 1.0 / np.repeat(rows, 3), 0.0)
        self._share = highest_square(model.operands(), inverse)
        self._omega = float(np.sqrt(highest_square(model.operands(), inverse_mass)))
        self._unscaled = self._omega
        self._ceiling = growth * self._omega

    @property
    def unscaled(self) -> float:
        """Bound of the frequency at the start, without added mass [rad/s]."""
        return self._unscaled

    @property
    def omega(self) -> float:
        """Bound of the frequency [rad/s]."""
        return self._omega

    def limit(self, nodes: np.ndarray, inverse_mass: np.ndarray) -> np.ndarray:
        """Choose masses with which some nodes are no faster than the ceiling.

        Args:
            nodes: all at the start, then `Touched.nodes` of each batch, shape (r,).
            inverse_mass: of the mesh as it is now, written at the nodes, shape (3 n,).

        Returns:
            Masses of the nodes for the integration [kg], shape (r,).
        """
        model, n = self._model, self._model.mesh.node_count
        touched = np.asarray(nodes, np.int64)
        patch = np.arange(n)
        if len(touched) < n:
            patch = model.neighbours.around(touched, _LEVELS)
        operands = model.operands(patch if len(patch) < n else None)
        spans, by_node = spans_of(patch), inverse_mass.reshape(-1, 3)
        x, free = np.zeros((n, 3)), model.mesh.fixed == 0
        self._f = grown(self._f, 3 * n)
        x[patch] = np.random.default_rng(0).standard_normal((len(patch), 3))
        x[~free] = 0.0
        squares, mass = self._share * model.frequency_rows(touched), model.mass[touched]
        free, found, heavier = free[touched], 0.0, mass
        if model.lawful and len(touched) < n:
            squares *= _ROOM
        for steps in [_ITERATIONS] + [_FURTHER] * _ROUNDS:
            heavier = mass * np.maximum(1.0, squares / self._ceiling**2)
            by_node[touched] = np.where(free, 1.0 / heavier, 0.0)[:, None]
            given = operands, spans, inverse_mass, x.reshape(-1), self._f[: 3 * n]
            found = _MARGIN * float(np.sqrt(max(_power_iterations(*given, steps), 0.0)))
            if found <= self._ceiling:
                break
            squares *= _MARGIN * (found / self._ceiling) ** 2
        self._omega = found if len(patch) == n else max(found, self._omega)
        return np.asarray(heavier)


def amplification(
    integrator: IntegratorName, omega: np.ndarray, alpha: float, beta: float, dt: float
) -> np.ndarray:
    """Return the largest growth factor of a mode in one step.

    Args:
        integrator: name.
        omega: frequencies [rad/s], any shape.
        alpha: mass-proportional damping [1/s].
        beta: stiffness-proportional damping [s].
        dt: step [s].

    Returns:
        Of u'' + c u' + omega^2 u = 0 with c = alpha + beta omega^2: the spectral radius of the
        step, which is |R(lambda dt)| of the worse root of lambda^2 + c lambda + omega^2 = 0 for
        methods that step u and v alike.
    """
    c = alpha + beta * np.square(omega)
    if integrator == 'symplectic_euler':
        determinant = 1 - c * dt
        half = 1 - (c * dt + np.square(omega * dt)) / 2
        discriminant = np.square(half) - determinant
        real = np.abs(half) + np.sqrt(np.maximum(discriminant, 0))
        return np.where(discriminant < 0, np.sqrt(np.maximum(determinant, 0)), real)
    factor = _FACTORS[integrator]
    root = np.sqrt((c * c - 4 * np.square(omega)).astype(complex))
    growth = [np.abs(factor(z)) for z in ((-c + root) / 2 * dt, (-c - root) / 2 * dt)]
    return np.maximum(*growth)


_FACTORS: dict[IntegratorName, Callable[[np.ndarray], np.ndarray]] = {
    'euler': lambda z: 1 + z,
    'rk4': lambda z: 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
    'implicit': lambda z: 1 / (1 - z),
}


def step_bound(integrator: IntegratorName, omega: float, alpha: float, beta: float) -> float:
    """Return the largest stable step for all modes up to omega [s]; infinite for the implicit
    integrator.

    Without damping it is 2.828 / omega for RK4, 2 / omega for symplectic Euler, 0 for forward
    Euler. Damping allows forward Euler min(beta + alpha / omega^2, 2 / |lambda|); heavy
    stiffness-proportional damping brings RK4 down to 2.785 / (beta omega^2).

    Args:
        integrator: name.
        omega: highest frequency [rad/s].
        alpha, beta: Rayleigh damping [1/s], [s].
    """
    if integrator == 'implicit':
        return float('inf')
    modes = omega * np.geomspace(1e-3, 1.0, 200)
    stable, unstable = 0.0, 4.0 / omega
    for _ in range(40):
        dt = (stable + unstable) / 2
        if amplification(integrator, modes, alpha, beta, dt).max() <= 1 + 1e-12:
            stable = dt
        else:
            unstable = dt
    return stable if stable > 1e-5 / omega else 0.0
