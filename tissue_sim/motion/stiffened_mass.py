"""Step and masses that follow a stiffening tissue.

The tangent of a stiffened point may be a hundred times the stiffness at rest, at a few nodes. The
step follows it to half its length. Nodes that would need a shorter one are integrated with more
mass, as slivers of a cut are: their motion is slower, their equilibrium is the same.
"""

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.adaptive_law import add_tangent_rows, linear_rows
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, Operands
from cutting_trainer.tissue_sim.elasticity.stiffening import MAX_EXPONENT, MIN_RATIO
from cutting_trainer.tissue_sim.mesh.strain import Strain

MAX_GROWTH = 2.0
"""Largest frequency of the step, as a multiple of that of the unstrained tissue."""
_HEADROOM = 1.3
"""Growth of the tangent that is allowed for until masses are adapted again."""
SUBSTEPS_BETWEEN = 16
"""Substeps between two adaptations."""


@kernel(error_model='numpy')
def _squared(rows, linear, mass, scale, squares):
    for i in range(rows.shape[0]):
        squares[i] = scale * rows[i] / mass[i] if rows[i] > 1.01 * linear[i] else 0.0


@kernel(error_model='numpy')
def _adapted(squares, mass, most, base, inverse, v):
    """Change inverse masses so that no node is faster than a frequency.

    Args:
        squares: squared frequencies without more mass [1/s^2], shape (n,).
        mass: of the nodes [kg], shape (n,).
        most: square of the largest frequency [1/s^2].
        base: inverse masses without strain [1/kg], shape (3 n,).
        inverse: those before, changed [1/kg], shape (3 n,).
        v: velocity [m/s], changed, shape (3 n,); empty: not wanted.

    Returns:
        Number of heavier nodes, and their additional mass [kg].
    """
    heavier, more = 0, 0.0
    for i in range(squares.shape[0]):
        own, needed = base[3 * i], mass[i] * squares[i] / most
        new = own
        if own * needed > 1.0:
            new = 1.0 / needed
            heavier += 1
            more += needed - 1.0 / own
        for k in range(3 * i, 3 * i + 3):
            if v.shape[0] > 0 and new < inverse[k]:
                v[k] *= new / inverse[k]
            inverse[k] = new if base[k] > 0.0 else 0.0
    return heavier, more


class StiffenedMass:
    """Frequency and inverse masses of a tissue with the stiffening law.

    Row sums of the tangent bound its frequencies, some 40 % high or more. They are scaled so that
    the unstrained tissue has the frequency that power iterations found.

    Args:
        model: with a law.
        omega: highest frequency of the unstrained tissue [rad/s].
        free: True where a node can move, shape (n,).
        growth: largest frequency of the step, as a multiple of that; `MAX_GROWTH` at most.
    """

    def __init__(
        self, model: ElasticModel, omega: float, free: np.ndarray, growth: float = MAX_GROWTH
    ) -> None:
        self._model = model
        self._linear = self._linear_rows()
        worst = float((self._linear / model.mass)[free].max(initial=0.0))
        self._scale = omega**2 / worst if worst > 0.0 else 1.0
        self._ceiling = min(growth, MAX_GROWTH) * omega
        self._rows = self._squared = np.zeros(0)
        self._strain = np.zeros(6)
        self._omega = omega
        self._inverse = np.zeros(0)
        self._heavier = 0
        self._added = 0.0

    def _linear_rows(self) -> np.ndarray:
        model, rows = self._model, np.zeros(self._model.mesh.node_count)
        o = model.operands()
        linear_rows(o.law, o.domains, o.elements, o.chunks, rows)
        return rows

    def follow_cut(self) -> None:
        """Compute the rows of the unstrained tissue again."""
        self._linear = self._linear_rows()
        self._inverse = np.zeros(0)

    def _squares(self, u: np.ndarray, o: Operands) -> np.ndarray:
        """Return squared frequencies of strained nodes, 0 elsewhere [1/s^2], shape (n,)."""
        n = len(self._linear)
        if len(self._rows) != n:
            self._rows, self._squared = np.zeros(n), np.zeros(n)
        self._rows[:] = self._linear
        parts = o.law, o.domains, o.elements, o.spans, o.chunks
        add_tangent_rows(*parts, u, self._rows, self._strain)
        _squared(self._rows, self._linear, self._model.mass, _HEADROOM * self._scale, self._squared)
        return self._squared

    def begin(self, u: np.ndarray, base: float, inverse: np.ndarray, operands: Operands) -> None:
        """Choose the frequency of a frame.

        Args:
            u: displacement by coordinate [m], shape (3 n,).
            base: bound of the frequency without strain [rad/s].
            inverse: inverse masses without strain [1/kg], shape (3 n,).
            operands: of the points that have a law.
        """
        free = inverse[::3] > 0.0
        most = float(np.sqrt(self._squares(u, operands)[free].max(initial=0.0)))
        self._omega = max(base, min(most, max(self._ceiling, base)))

    def adapt(
        self,
        u: np.ndarray,
        v: np.ndarray,
        inverse: np.ndarray,
        operands: Operands,
        *,
        begun: bool = False,
    ) -> np.ndarray:
        """Return the inverse masses for the next substeps [1/kg], shape (3 n,).

        A node that becomes heavier keeps its momentum, one that becomes lighter its velocity: no
        energy comes from it.

        Args:
            u: displacement by coordinate [m], shape (3 n,).
            v: velocity [m/s], changed, shape (3 n,).
            inverse: inverse masses without strain [1/kg], shape (3 n,).
            operands: of the points that have a law.
            begun: whether `begin` had the same displacement and operands.
        """
        known = len(self._inverse) == len(inverse)
        if not known:
            self._inverse = inverse.copy()
        if not begun:
            self._squares(u, operands)
        mass = self._model.mass
        heavier, more = _adapted(
            self._squared, mass, self._omega**2, inverse, self._inverse, v if known else v[:0]
        )
        self._heavier, self._added = int(heavier), float(more / mass.sum())
        return self._inverse

    @property
    def omega(self) -> float:
        """Frequency that the step must follow [rad/s]."""
        return self._omega

    def inverse(self, base: np.ndarray) -> np.ndarray:
        """Return the present inverse masses, or `base` before the first adaptation."""
        return self._inverse if len(self._inverse) == len(base) else base

    @property
    def strain(self) -> Strain:
        """Strain at the last adaptation."""
        s = [float(value) for value in self._strain]
        beyond = _beyond(s[2], s[5], self._model.material.stiffening)
        return Strain(
            int(s[0]), int(s[1]), (s[2], s[3]), (s[4], s[5]), self._heavier, self._added, beyond
        )


def _beyond(ratio: float, stretch: float, stiffening: float) -> str:
    if ratio < MIN_RATIO:
        return (
            f'the tissue is pressed to {max(ratio, 0.0):.2g} of its volume; the law holds down to '
            f'{MIN_RATIO:g}'
        )
    if stiffening * (stretch**2 + 2 / stretch - 3) > MAX_EXPONENT:
        return f'the tissue is stretched {stretch:.2g} times, where its law stiffens no further'
    return ''
