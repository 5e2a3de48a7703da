"""Time steps of a frame: the stable step, with the springs of tools; shorter after divergence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.nodal_mass import NodalMass
from cutting_trainer.tissue_sim.motion.stability import step_bound

_FINER, _FINEST = 4, 16
"""Refinement of the steps in the next attempt, and its limit. A frame then does no more work than
21 frames, though frame after frame should need shorter steps; where the bound holds in any shape,
no more than 5: steps shorter than a quarter do not help."""
_CAUTIOUS_FRAMES = 30


@dataclass(frozen=True)
class TimeStepping:
    """Time stepping of frames.

    Attributes:
        integrator: name.
        rate: frames a second [Hz].
        safety: ratio of step to stable step.
        min_substeps, max_substeps: of a frame; when the largest number does not suffice the frame
            simulates less time than it lasts.
        frequency_growth: largest growth of the highest frequency by cuts before small nodes are
            integrated with more mass (see `FrequencyBound`); infinite: no limit. Below 1, those of
            the mesh are too.
    """

    integrator: IntegratorName = 'rk4'
    rate: float = 30.0
    safety: float = 0.8
    min_substeps: int = 1
    max_substeps: int = 200
    frequency_growth: float = 3.0


class TimeSteps:
    """Number and length of the steps of each frame.

    Args:
        stepping: time stepping.
        material: its damping.
        mass: of the nodes.
        bounded: the bound of the step holds in any shape, so that a diverged frame gains nothing
            from steps of a sixteenth.

    Attributes:
        frame_time: [s].

    Raises:
        ValueError: the integrator has no stable step with this damping.
    """

    def __init__(
        self, stepping: TimeStepping, material: Material, mass: NodalMass, *, bounded: bool
    ) -> None:
        self._stepping, self._mass = stepping, mass
        self._damping = material.alpha, material.beta
        self._finest = _FINER if bounded else _FINEST
        self.frame_time = 1.0 / stepping.rate
        self._bounds: dict[float, float] = {}
        self._caution = 1
        self._cautious = 0
        if self.bound() == 0.0:
            raise ValueError(
                f'{stepping.integrator} has no stable step with damping alpha '
                f'{material.alpha:g} 1/s and beta {material.beta:g} s: damp the tissue, or take '
                'another integrator'
            )

    def bound(self, couplings: Sequence[Coupling] = ()) -> float:
        """Return the largest stable step [s], the stiffness of coupling springs included."""
        square = self._mass.omega**2
        inverse = self._mass.inverse
        for coupling in couplings:
            light = coupling.weights * inverse[3 * coupling.nodes]
            load = np.sum(light * coupling.weights)
            if coupling.points is not None:  # each node by its weight alone (Gershgorin)
                load = light.max()
            square += coupling.stiffness * float(load)
        # Rounded up, so that only few different bounds are computed.
        omega = 1.01 ** np.ceil(np.log(np.sqrt(square)) / np.log(1.01))
        if omega not in self._bounds:
            self._bounds[omega] = step_bound(self._stepping.integrator, omega, *self._damping)
        return self._bounds[omega]

    def begin(self, couplings: Sequence[Coupling]) -> tuple[int, float]:
        """Return the number of steps of the next frame, and their length [s].

        Some frames after one that diverged have shorter steps, and are counted here.

        Args:
            couplings: springs of the tools at its start.
        """
        if self._cautious:
            self._cautious -= 1
            self._caution = self._caution if self._cautious else 1
        dt = self._stepping.safety * self.bound(couplings) / self._caution
        substeps = max(int(np.ceil(self.frame_time / dt)), self._stepping.min_substeps)
        substeps = max(substeps, self._caution)
        most = self._stepping.max_substeps * self._caution
        return (most, dt) if substeps > most else (substeps, self.frame_time / substeps)

    def parts(self, couplings: Sequence[Coupling], dt: float) -> int:
        """Return into how many parts a step must be split for a spring that is new in the frame.

        A blade that enters holds fewer nodes than the tool did when the step was chosen: where they
        are light, the frequency of the spring is above that of the tissue.

        Args:
            couplings: springs of the tools.
            dt: step [s].
        """
        bound = self.bound(couplings)
        if dt <= bound or bound == 0.0:
            return 1
        return min(int(np.ceil(dt / (self._stepping.safety * bound))), _FINEST)

    def refine(self) -> int:
        """Take shorter steps for some frames; return the factor, or 0 where there are none shorter:
        the next frame has those of before.
        """
        if self._caution * _FINER > self._finest:
            self._caution = 1
            return 0
        self._caution *= _FINER
        self._cautious = _CAUTIOUS_FRAMES
        return _FINER
