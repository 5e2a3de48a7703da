"""Stable time step: a bound of the highest frequency, and the stability regions of integrators."""

from collections.abc import Callable

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, Operands, stiffness_product
from cutting_trainer.tissue_sim.mesh.adjacency import PATCH, spans_of, without
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


ALL_ITERATIONS = 48
"""Power iterations after which a bound has converged."""


def highest_square(operands: Operands, inverse_mass: np.ndarray) -> float:
    """Return the largest eigenvalue of M^-1 K [1/s^2], and 6 % more.

    Args:
        operands: of all nodes.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
    """
    x = np.where(inverse_mass > 0.0, np.random.default_rng(0).standard_normal(len(inverse_mass)), 0)
    whole, f = np.array([[0, len(x) // 3]]), np.zeros(len(x))
    square = _power_iterations(operands, whole, inverse_mass, x, f, ALL_ITERATIONS)
    return FrequencyBound.MARGIN**2 * max(float(square), 0.0)


class FrequencyBound:
    """Upper bound of the highest natural frequency of a tissue under cuts.

    Directly after a cut it is the larger of the old bound and Gershgorin's bound on the touched
    rows: rigorous, local, some 40 % high. Power iterations in the next frames reduce it to 3 %
    above the frequency they converge to. In a large tissue they use the PATCH nodes around the cut,
    with the others held. Held nodes only remove low frequencies, and the previous bound still
    counts.

    A cut makes small elements, and one sliver would determine the step of the whole tissue. Nodes
    with a row above a ceiling are therefore integrated with more mass, which reduces the row to the
    ceiling (selective mass scaling): a few milligrams, which otherwise would only shorten the step.

    Args:
        model: the elastic model.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        growth: the ceiling, as a multiple of the bound at the start. Below 1, small elements of the
            mesh itself get more mass too: see `slow_down`.
    """

    MARGIN = 1.03

    def __init__(
        self, model: ElasticModel, inverse_mass: np.ndarray, growth: float = np.inf
    ) -> None:
        self._model = model
        self._ceiling = np.inf
        self._rows_over = 1.0
        self._rows = np.zeros(model.mesh.node_count)
        self._x = np.zeros(0)
        self._settled = 0.0
        self._provisional = 0.0
        self._patch = np.zeros(0, np.int64)
        self._cut: list[np.ndarray] = []
        self._f = np.zeros(0)
        self.update(np.arange(model.mesh.node_count), inverse_mass)
        self.refine(ALL_ITERATIONS)
        self._unscaled = self._settled
        self._ceiling = growth * self._settled
        if growth < 1.0:  # Gershgorin's row of the worst node is that much above its frequency
            worst = self._rows[inverse_mass[::3] > 0.0].max()
            self._rows_over = float(worst) / self._unscaled**2

    @property
    def unscaled(self) -> float:
        """Bound of the frequency at the start, without added mass [rad/s]."""
        return self._unscaled

    def slow_down(self) -> np.ndarray:
        """Return masses with which the nodes of a mesh are no faster than the ceiling [kg],
        shape (n,).

        Rows are scaled so that the worst has the frequency that the iterations found; the caller
        gives the masses to `inverse_mass` and calls `refine` for the frequency that they leave.
        """
        self._done = 0
        every = np.arange(self._model.mesh.node_count)
        self._cut = [every]
        return self.inertia(every)

    def update(self, nodes: np.ndarray, inverse_mass: np.ndarray) -> None:
        """Register the rows touched by a change of connectivity.

        Args:
            nodes: `Touched.nodes` of the batch, shape (r,).
            inverse_mass: as for the constructor, of the mesh after it.
        """
        mesh = self._model.mesh
        self._rows = grown(self._rows, mesh.node_count)
        touched = np.asarray(nodes, np.int64)
        self._rows[touched] = self._model.frequency_rows(touched)
        self._inverse_mass = inverse_mass
        worst = np.sqrt(self._rows[touched].max(initial=0.0))
        ceiling = self._ceiling * np.sqrt(self._rows_over)
        self._provisional = max(self._provisional, min(float(worst), float(ceiling)))
        self._done = 0
        # The touched nodes may have the new highest mode: start with a share of it.
        n = mesh.node_count
        self._x = grown(self._x, 3 * n)
        rows = self._x[: 3 * n].reshape(-1, 3)
        rows[touched] += 0.1 * np.random.default_rng(0).standard_normal((len(touched), 3))
        self._cut.append(touched)

    def _look_around(self) -> None:
        """Select the nodes for the iterations: around cuts whose bound has not converged."""
        n = self._model.mesh.node_count
        before = self._patch[self._patch < n]
        self._patch = np.arange(n)
        if n > PATCH:
            cut = np.concatenate(self._cut)
            self._patch = self._model.neighbours.around(cut[cut < n], 2, PATCH)
        self._x[: 3 * n].reshape(-1, 3)[without(before, self._patch)] = 0.0

    def inertia(self, nodes: np.ndarray) -> np.ndarray:
        """Return the integration masses of some nodes [kg], shape (r,)."""
        share = self._rows[nodes] / (self._rows_over * self._ceiling**2)
        return np.asarray(self._model.mass[nodes] * np.maximum(1.0, share))

    def refine(self, steps: int = 4) -> None:
        """Run some power iterations unless the bound has converged.

        Args:
            steps: number of iterations.
        """
        if self._done >= ALL_ITERATIONS:
            return
        if self._done == 0:
            self._look_around()
        n = self._model.mesh.node_count
        some = len(self._patch) < n
        if len(self._f) != 3 * n:
            self._f = np.zeros(3 * n)
        square = _power_iterations(
            self._model.operands(self._patch if some else None),
            spans_of(self._patch),
            self._inverse_mass,
            self._x[: 3 * n],
            self._f,
            steps,
        )
        self._done += steps
        if self._done >= ALL_ITERATIONS:
            found = self.MARGIN * float(np.sqrt(max(square, 0.0)))
            self._settled = max(found, self._settled) if some else found
            self._provisional = 0.0
            self._cut = []

    @property
    def omega(self) -> float:
        """Bound of the frequency [rad/s]."""
        return max(self._settled, self._provisional)


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
