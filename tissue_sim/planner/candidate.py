"""Data of the planner: the scene's task, and cost and errors of a method."""

import math
from dataclasses import dataclass, field, replace

from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.planner.budget import Budget


@dataclass(frozen=True)
class ErrorEstimate:
    """Relative errors of displacement under a load, by cause.

    Attributes:
        elements: element size.
        rotation: largest rotation, for models without rotations.
        strain: largest displacement, for the model's strain measure.
        time: step size, at the pace of a palpating hand.
        region: far nodes that move together.
        contact: footprint of the tool.
    """

    elements: float
    rotation: float
    strain: float
    time: float = 0.0
    region: float = 0.0
    contact: float = 0.0

    @property
    def large(self) -> float:
        """Error by large deformation: rotation and strain have one cause, and the larger counts."""
        return max(self.rotation, self.strain)

    @property
    def causes(self) -> dict[str, float]:
        """Error by cause, as a phrase, all that add up."""
        return {
            'by the size of the elements': self.elements,
            'by the footprint of the tool': self.contact,
            'by large deformation': self.large,
            'by the step': self.time,
            'by far nodes that move together': self.region,
        }

    @property
    def total(self) -> float:
        """Total of all causes."""
        return sum(self.causes.values())


@dataclass(frozen=True)
class Cost:
    """Cost of a frame.

    Attributes:
        substeps: required by stability.
        step: each [s].
        fixed: CPU time of a frame without its substeps [s].
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
        """Return the cost of `factor` times the substeps."""
        return Cost(math.ceil(self.substeps * factor), self.step / factor, self.fixed, self.each)


@dataclass(frozen=True)
class Candidate:
    """A method with its errors and cost on the scene.

    Attributes:
        cost: of a frame under a tool that presses.
        cutting: CPU time of a frame in which a blade is drawn [s]; 0: not measured.
    """

    model: ModelName
    integrator: IntegratorName
    errors: ErrorEstimate
    cost: Cost
    active: ActiveSettings = field(default=ActiveSettings())
    cutting: float = 0.0

    @property
    def name(self) -> str:
        """Model, integrator, and the active region if there is one."""
        region = {
            'off': '',
            'on': ', active region on',
            'budget': f', active region of {self.active.nodes} nodes',
        }
        return f'{self.model} by {self.integrator}{region[self.active.mode]}'


@dataclass(frozen=True)
class Task:
    """A scene as input of the planner.

    Attributes:
        mesh, material, resistance: the tissue.
        budget: the requirements.
        stepping: of the scene; its integrator is ignored.
        model: of the scene.
    """

    mesh: TetMesh
    material: Material
    resistance: Resistance
    budget: Budget
    stepping: TimeStepping
    model: ModelName = 'linear_smoothed'

    @property
    def available(self) -> float:
        """Time allowed for a frame: CPU time of one thread, or time of several [s]."""
        return min(self.budget.cores, 1.0) / self.stepping.rate

    def worst(self, candidate: Candidate) -> Cost:
        """Return the cost of a method after cuts have shortened the step as far as allowed.

        A `frequency_growth` below 1 is in the measured cost already: the mesh itself has more mass.
        """
        explicit = candidate.integrator != 'implicit'
        growth = self.stepping.frequency_growth if self.budget.cuts and explicit else 1.0
        return candidate.cost.grown(max(growth, 1.0))

    def dearest(self, candidate: Candidate) -> float:
        """Return the CPU time of the dearest frame of a method [s]."""
        return max(self.worst(candidate).frame, candidate.cutting)

    def in_time(self, candidate: Candidate) -> bool:
        """Return whether a method meets the allowed cost."""
        substeps = self.worst(candidate).substeps
        return substeps <= self.stepping.max_substeps and self.dearest(candidate) <= self.available

    def fits(self, candidate: Candidate) -> bool:
        """Return whether a method meets the allowed cost and error."""
        return self.in_time(candidate) and candidate.errors.total <= self.budget.error

    def stepped_by(self, candidate: Candidate) -> TimeStepping:
        """Return the time stepping of a method."""
        return replace(self.stepping, integrator=candidate.integrator)
