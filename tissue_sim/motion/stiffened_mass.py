"""Step and masses that follow a stiffening tissue.

The tangent of a stiffened point may be a hundred times the stiffness at rest, at a few nodes. The
step follows it to half its length. Nodes that would need a shorter one are integrated with more
mass, as slivers of a cut are: their motion is slower, their equilibrium is the same.
"""

import numpy as np

from cutting_trainer.node_common.kernels import kernel
from cutting_trainer.tissue_sim.elasticity.adaptive_law import add_tangent_traces, linear_traces
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.stiffening import MAX_EXPONENT, MIN_RATIO
from cutting_trainer.tissue_sim.mesh.strain import Strain
from cutting_trainer.tissue_sim.motion.stability import highest_square

MAX_GROWTH = 2.0
"""Largest frequency of the step, as a multiple of that of the unstrained tissue."""
_STRAINED = 2.0
"""Factor of `StiffenedMass` in a strained tissue: 0.9 to 1.9 in a random mesh with nu 0.3 and 0.45,
pulled, pressed and twisted."""
SUBSTEPS_BETWEEN = 16
"""Substeps between two adaptations."""


@kernel(error_model='numpy')
def _needed(excess, linear, relative, square, inverse, needed):
    """Compute stiffness that bounds the tangent of strained nodes, 0 elsewhere [N/m].

    Args:
        excess: what traces have more than without strain [N/m], shape (n,).
        linear: traces without strain [N/m], shape (n,).
        relative: K <= `relative` times the traces, see `StiffenedMass`.
        square: of the highest frequency without strain, K <= square M [1/s^2].
        inverse: inverse masses without strain [1/kg], shape (3 n,).
        needed: output, shape (n,).

    Returns:
        Square of the highest frequency with these masses [1/s^2].
    """
    most = square
    for i in range(excess.shape[0]):
        needed[i] = 0.0
        if excess[i] > 0.0 and inverse[3 * i] > 0.0:
            rest = min(relative * linear[i], square / inverse[3 * i])
            needed[i] = rest + relative * excess[i]
            most = max(most, needed[i] * inverse[3 * i])
    return most


@kernel(error_model='numpy')
def _adapted(needed, square, base, inverse, v):
    """Change inverse masses so that no mode is faster than a frequency.

    Args:
        needed: stiffness that bounds the tangent [N/m], shape (n,).
        square: of the frequency [1/s^2].
        base: inverse masses without strain [1/kg], shape (3 n,).
        inverse: those before, changed [1/kg], shape (3 n,).
        v: velocity [m/s], changed, shape (3 n,); empty: not wanted.

    Returns:
        Number of heavier nodes, and their additional mass [kg].
    """
    heavier, more = 0, 0.0
    for i in range(needed.shape[0]):
        own, new = base[3 * i], base[3 * i]
        if own * needed[i] > square:
            new = square / needed[i]
            heavier += 1
            more += 1.0 / new - 1.0 / own
        for k in range(3 * i, 3 * i + 3):
            if v.shape[0] > 0 and new < inverse[k]:
                v[k] *= new / inverse[k]
            inverse[k] = new if base[k] > 0.0 else 0.0
    return heavier, more


class StiffenedMass:
    """Frequency and inverse masses of a tissue with the stiffening law.

    Let D have the traces of the 3x3 blocks on the diagonal of K. D follows cuts and strain. Power
    iterations find the least factor with K <= factor D in the unstrained tissue. Strain changes it;
    it is taken as `_STRAINED` at least. This is measured, and proved for no mesh.

    Args:
        model: with a law.
        omega: highest frequency of the unstrained tissue [rad/s].
        inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
        growth: largest frequency of the step, as a multiple of that; `MAX_GROWTH` at most.
    """

    def __init__(
        self,
        model: ElasticModel,
        omega: float,
        inverse_mass: np.ndarray,
        growth: float = MAX_GROWTH,
    ) -> None:
        self._model = model
        self._linear = self._linear_traces()
        inverse = np.where(inverse_mass > 0.0, 1.0 / np.repeat(self._linear, 3), 0.0)
        self._relative = max(highest_square(model.operands(), inverse), _STRAINED)
        self._ceiling = min(growth, MAX_GROWTH) * omega
        self._excess = self._needed = np.zeros(0)
        self._strain = np.zeros(6)
        self._base = self._omega = omega
        self._inverse = np.zeros(0)
        self._heavier = 0
        self._added = 0.0

    def _linear_traces(self) -> np.ndarray:
        model, traces = self._model, np.zeros(self._model.mesh.node_count)
        o = model.operands()
        linear_traces(o.law, o.domains, o.elements, o.chunks, traces)
        return traces

    def follow_cut(self) -> None:
        """Compute the traces of the unstrained tissue again."""
        self._linear = self._linear_traces()
        self._inverse = np.zeros(0)

    def _measure(self, u: np.ndarray, inverse: np.ndarray, o: Operands) -> float:
        """Compute the stiffness that is needed; return the square of its highest frequency."""
        n = len(self._linear)
        if len(self._excess) != n:
            self._excess, self._needed = np.zeros(n), np.zeros(n)
        self._excess[:] = 0.0
        parts = o.law, o.domains, o.elements, o.spans, o.chunks
        add_tangent_traces(*parts, u, self._excess, self._strain)
        rest = self._linear, self._relative, self._base**2, inverse
        return float(_needed(self._excess, *rest, self._needed))

    def begin(self, u: np.ndarray, base: float, inverse: np.ndarray, operands: Operands) -> None:
        """Choose the frequency of a frame.

        Args:
            u: displacement by coordinate [m], shape (3 n,).
            base: bound of the frequency without strain [rad/s].
            inverse: inverse masses without strain [1/kg], shape (3 n,).
            operands: of the points that have a law.
        """
        self._base = base
        most = np.sqrt(self._measure(u, inverse, operands))
        self._omega = max(base, min(float(most), self._ceiling))

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
            self._measure(u, inverse, operands)
        heavier, more = _adapted(
            self._needed, self._omega**2, inverse, self._inverse, v if known else v[:0]
        )
        self._heavier, self._added = int(heavier), float(more / self._model.mass.sum())
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
