"""What the planner weighs: the scene's task, and what a method costs it and gets wrong."""

import math
from dataclasses import dataclass, field, replace

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.budget import Budget
from tissue_sim.dynamics import TimeStepping
from tissue_sim.elasticity import ModelName
from tissue_sim.integrators import IntegratorName
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh


@dataclass(frozen=True)
class Errors:
    """Relative errors of displacement under a load, by cause.

    Attributes:
        elements: size of the elements.
        rotation: of the largest rotation, for models whose elements do not turn.
        strain: of the largest displacement: what the model's strain is not.
        time: size of the step, at the pace of a palpating hand.
        region: nodes that are held.
    """

    elements: float
    rotation: float
    strain: float
    time: float = 0.0
    region: float = 0.0

    @property
    def large(self) -> float:
        """By large deformation: rotation and strain are one cause seen twice, the larger counts."""
        return max(self.rotation, self.strain)

    @property
    def total(self) -> float:
        """Of all causes."""
        return self.elements + self.large + self.time + self.region


@dataclass(frozen=True)
class Cost:
    """What a frame costs.

    Attributes:
        substeps: that stability asks for.
        step: each [s].
        fixed: CPU time of a frame whatever the substeps [s].
        each: CPU time of a substep [s].
    """

    substeps: int
    step: float
    fixed: float
    each: float

    @property
    def frame(self) -> float:
        """CPU time of a frame [s]."""
        return self.fixed + self.substeps * self.each

    def grown(self, factor: float) -> 'Cost':
        """With so many times the substeps."""
        return Cost(math.ceil(self.substeps * factor), self.step / factor, self.fixed, self.each)


@dataclass(frozen=True)
class Candidate:
    """A method, with what it does to the scene."""

    model: ModelName
    integrator: IntegratorName
    errors: Errors
    cost: Cost
    active: ActiveSettings = field(default=ActiveSettings())

    @property
    def name(self) -> str:
        """Model and integrator, and which nodes move if not all do."""
        region = {
            'off': '',
            'on': ', active region on',
            'budget': f', active region of {self.active.nodes} nodes',
        }
        return f'{self.model} by {self.integrator}{region[self.active.mode]}'


@dataclass(frozen=True)
class Task:
    """A scene as the planner sees it.

    Attributes:
        mesh, material, resistance: the tissue.
        budget: what is asked.
        stepping: of the scene; its integrator does not count.
    """

    mesh: TetMesh
    material: Material
    resistance: Resistance
    budget: Budget
    stepping: TimeStepping

    @property
    def available(self) -> float:
        """CPU time that a frame may cost [s]."""
        return self.budget.cores / self.stepping.rate

    def worst(self, candidate: Candidate) -> Cost:
        """What a method costs when cuts have shortened the step as far as they may."""
        explicit = candidate.integrator != 'implicit'
        growth = self.stepping.frequency_growth if self.budget.cuts and explicit else 1.0
        return candidate.cost.grown(growth)

    def in_time(self, candidate: Candidate) -> bool:
        """Whether a method costs no more than it may."""
        cost = self.worst(candidate)
        return cost.substeps <= self.stepping.max_substeps and cost.frame <= self.available

    def fits(self, candidate: Candidate) -> bool:
        """Whether a method is in time and accurate."""
        return self.in_time(candidate) and candidate.errors.total <= self.budget.error

    def stepped_by(self, candidate: Candidate) -> TimeStepping:
        """How frames are stepped through by a method."""
        return replace(self.stepping, integrator=candidate.integrator)
