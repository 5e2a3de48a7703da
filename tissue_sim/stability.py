"""How large a step may be: a bound of the highest frequency, and the region of stability of RK4."""

import numpy as np
from numba import njit

from tissue_sim.mesh import grown
from tissue_sim.tensor_mass import TensorMassModel, multiply


@njit(cache=True)
def gershgorin_rows(tensors, links, nodes, out):
    """Row sums of M^-1 K by 3x3 blocks: no eigenvalue of M^-1 K exceeds the largest of all rows.

    A row depends on the mass and the tensors of its own node, so only rows that a cut touched
    change.

    Args:
        tensors: a `tensor_mass.Tensors`.
        links: connectivity.
        nodes: which rows, shape (r,).
        out: squares of frequencies [1/s^2], written at `nodes`, shape (>= n,).
    """
    seen = np.empty(256, np.int64)
    for which in range(len(nodes)):
        node = nodes[which]
        d = tensors.diagonal[node]
        total = np.sqrt(d[0] ** 2 + d[3] ** 2 + d[5] ** 2 + 2 * (d[1] ** 2 + d[2] ** 2 + d[4] ** 2))
        number = 0
        corner = links.first_corner[node]
        while corner >= 0:
            for b in range(4):
                other = links.tetrahedra[corner // 4, b]
                new = other != node
                for k in range(number):
                    if seen[k] == other:
                        new = False
                if new:
                    total += _edge_norm(tensors, min(node, other), max(node, other))
                    if number < 256:
                        seen[number] = other
                        number += 1
            corner = links.corner_next[corner]
        out[node] = total / tensors.mass[node]


@njit(cache=True)
def _edge_norm(tensors, low, high):
    for slot in range(tensors.start[low], tensors.start[low] + tensors.used[low]):
        if tensors.columns[slot] == 3 * high:
            square = 0.0
            for i in range(9):
                square += tensors.blocks[9 * slot + i] ** 2
            return np.sqrt(square)
    return 0.0


@njit(cache=True, error_model='numpy')
def _power_iterations(operands, inverse_mass, x, f, steps):
    """Power iterations of M^-1 K on x in place; returns the last Rayleigh quotient (mass norm)."""
    start, used, columns, blocks, diagonal = operands
    quotient = 0.0
    for _ in range(steps):
        multiply(start, used, columns, blocks, diagonal, x, f)
        above = 0.0
        below = 0.0
        norm = 0.0
        for i in range(x.shape[0]):
            if inverse_mass[i] > 0.0:
                above += x[i] * f[i]
                below += x[i] * x[i] / inverse_mass[i]
            f[i] *= inverse_mass[i]
            norm = max(norm, abs(f[i]))
        if below == 0.0 or norm == 0.0:
            return 0.0
        quotient = above / below
        for i in range(x.shape[0]):
            x[i] = f[i] / norm
    return quotient


class FrequencyBound:
    """Upper bound of the highest natural frequency of a tissue that is cut.

    Right after a cut the bound is that of Gershgorin on the touched rows, or the old bound,
    whichever is higher: rigorous, local, some 40 % high. Power iterations spread over the next
    frames then bring it down to 3 % above the frequency that they converge to.

    A cut makes small elements, and one sliver would dictate the step of the whole tissue. So nodes
    whose row exceeds a ceiling are integrated with as much mass as brings them down to it
    (selective mass scaling): a few milligrams where nothing but a shorter step would be gained.

    Args:
        model: a tensor-mass model.
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        growth: the ceiling, as a multiple of the bound at the start.
    """

    MARGIN = 1.03
    _ENOUGH = 48

    def __init__(
        self, model: TensorMassModel, inverse_mass: np.ndarray, growth: float = np.inf
    ) -> None:
        self._model = model
        self._ceiling = np.inf
        self._rows = np.zeros(model.mesh.node_count)
        self._x = np.zeros(0)
        self._settled = 0.0
        self._provisional = 0.0
        self.update(np.arange(model.mesh.node_count), inverse_mass)
        self.refine(self._ENOUGH)
        self._ceiling = growth * self._settled

    def update(self, nodes: np.ndarray, inverse_mass: np.ndarray) -> None:
        """Takes notice of rows that a change of connectivity touched.

        Args:
            nodes: `Touched.nodes` of the batch, shape (r,).
            inverse_mass: as for the constructor, of the mesh after it.
        """
        mesh = self._model.mesh
        self._rows = grown(self._rows, mesh.node_count)
        touched = np.asarray(nodes, np.int64)
        gershgorin_rows(self._model.tensors, mesh.links, touched, self._rows)
        self._inverse_mass = inverse_mass
        worst = np.sqrt(self._rows[touched].max(initial=0.0))
        self._provisional = max(self._provisional, min(float(worst), self._ceiling))
        self._done = 0
        # What the cut touched may hold the new highest mode: start with a share of it.
        self._x = grown(self._x, 3 * mesh.node_count)
        rows = self._x[: 3 * mesh.node_count].reshape(-1, 3)
        rows[touched] += 0.1 * np.random.default_rng(0).standard_normal((len(touched), 3))

    def inertia(self, nodes: np.ndarray) -> np.ndarray:
        """Masses to integrate some nodes with [kg], shape (r,), for nodes, shape (r,)."""
        return self._model.mass[nodes] * np.maximum(1.0, self._rows[nodes] / self._ceiling**2)

    def refine(self, steps: int = 4) -> None:
        """Spends some power iterations, if the bound is not settled yet.

        Args:
            steps: how many.
        """
        if self._done >= self._ENOUGH:
            return
        x = self._x[: 3 * self._model.mesh.node_count]
        square = _power_iterations(
            self._model.operands, self._inverse_mass, x, np.empty_like(x), steps
        )
        self._done += steps
        if self._done >= self._ENOUGH:
            self._settled = self.MARGIN * float(np.sqrt(max(square, 0.0)))
            self._provisional = 0.0

    @property
    def omega(self) -> float:
        """The bound [rad/s]."""
        return max(self._settled, self._provisional)


def rk4_amplification(omega: np.ndarray, alpha: float, beta: float, dt: float) -> np.ndarray:
    """Largest growth factor of a mode in one RK4 step.

    Args:
        omega: frequencies [rad/s], any shape.
        alpha: mass-proportional damping [1/s].
        beta: stiffness-proportional damping [s].
        dt: step [s].

    Returns:
        |R(lambda dt)| of the worse root of lambda^2 + (alpha + beta omega^2) lambda + omega^2 = 0.
    """
    c = alpha + beta * np.square(omega)
    root = np.sqrt((c * c - 4 * np.square(omega)).astype(complex))
    growth = [
        np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
        for z in ((-c + root) / 2 * dt, (-c - root) / 2 * dt)
    ]
    return np.maximum(*growth)


def rk4_step_bound(omega: float, alpha: float, beta: float) -> float:
    """Largest step at which RK4 lets no mode up to omega grow [s].

    Without damping this is 2.828 / omega; heavy stiffness-proportional damping brings it down to
    2.785 / (beta omega^2).

    Args:
        omega: highest frequency [rad/s].
        alpha, beta: Rayleigh damping [1/s], [s].
    """
    modes = omega * np.geomspace(1e-3, 1.0, 200)
    stable, unstable = 0.0, 4.0 / omega
    for _ in range(40):
        dt = (stable + unstable) / 2
        if rk4_amplification(modes, alpha, beta, dt).max() <= 1 + 1e-12:
            stable = dt
        else:
            unstable = dt
    return stable
