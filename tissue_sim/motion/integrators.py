"""Integrators with one interface: steps of M u'' + (alpha M + beta K) u' + K u = f in place."""

from typing import Any, Literal, get_args

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import Springs
from cutting_trainer.tissue_sim.contact.cut_contact import NO_CUT_CONTACTS, CutContacts
from cutting_trainer.tissue_sim.elasticity.elastic_force import Operands
from cutting_trainer.tissue_sim.motion.explicit import euler_steps, rk4_steps
from cutting_trainer.tissue_sim.motion.implicit import implicit_steps

IntegratorName = Literal['euler', 'symplectic_euler', 'rk4', 'implicit']
INTEGRATORS: tuple[IntegratorName, ...] = get_args(IntegratorName)


class Integrator:
    """Time steps of one method.

    Args:
        name: of the method.
        alpha, beta: Rayleigh damping [1/s], [s].
        tolerance: of the implicit method's residual, relative to the loads.
    """

    def __init__(
        self, name: IntegratorName, alpha: float, beta: float, *, tolerance: float = 1e-4
    ) -> None:
        self.name = name
        self._damping = np.array([alpha, beta])
        self._tolerance = tolerance
        self._work = np.zeros((7, 0))

    def step(
        self,
        operands: Operands,
        inverse_mass: np.ndarray,
        diagonal: np.ndarray,
        springs: Springs,
        u: np.ndarray,
        v: np.ndarray,
        dt: float,
        steps: int,
        *,
        spans: np.ndarray | None = None,
        first: int = 0,
        total: int | None = None,
        faces: CutContacts = NO_CUT_CONTACTS,
    ) -> float:
        """Advance displacement and velocity in place.

        Args:
            operands: of the model.
            inverse_mass: by coordinate, 0 where fixed [1/kg], shape (3 n,).
            diagonal: `ElasticModel.diagonal` [N/m], shape (3 n,).
            springs: the couplings of the tools.
            u, v: displacement [m] and velocity [m/s], shape (3 n,).
            dt: step [s].
            steps: number of steps.
            spans: intervals of moving nodes, None: all, shape (s, 2).
            first: number of the first step in its frame.
            total: steps of the frame, None: `steps`; the tools move through all of them.
            faces: contacts of cut faces; `implicit` leaves them out.

        Returns:
            Work of the springs on the tissue [J].
        """
        if self._work.shape[1] < len(u):
            self._work = np.zeros((7, len(u)))
        if spans is None:
            spans = np.array([[0, len(u) // 3]])
        count = steps if total is None else total
        head = (operands, spans, inverse_mass, self._damping, springs)
        tail = (u, v, self._work, dt, first, steps, count)
        if self.name == 'implicit':
            return float(implicit_steps(*head, diagonal, self._tolerance, *tail))
        if self.name == 'rk4':
            return float(rk4_steps(*head, faces, *tail))
        return self._euler(*head, faces, *tail, self.name == 'symplectic_euler')

    def _euler(self, *given: Any) -> float:
        """Compute steps of Euler's methods, see `euler_steps`."""
        return float(euler_steps(*given))
