"""A plan that is followed: what it says at start, and whether it still holds as tissue is cut."""

from tissue_sim.contact import Frame
from tissue_sim.plan import Plan
from tissue_sim.plan_reasons import ms, percent
from tissue_sim.simulation import TissueSimulation


class PlanWatch:
    """Holds the plan against the frames.

    Args:
        plan: that the simulation goes by.
        simulation: that goes by it.

    Attributes:
        over: a sentence while cuts have made the tissue dearer than it may be, else empty.
    """

    def __init__(self, plan: Plan, simulation: TissueSimulation) -> None:
        self._plan = plan
        self._simulation = simulation
        self.over = ''

    @property
    def unmet(self) -> str:
        """A sentence if no method fits the budget, else empty."""
        if self._plan.chosen is not None:
            return ''
        model, stepping = self._simulation.model, self._simulation.dynamics.stepping
        return (
            f'no method fits the budget, so {model.name} by {stepping.integrator} is taken; to '
            f'have one: {"; or ".join(self._plan.remedies)}'
        )

    @property
    def warnings(self) -> list[str]:
        """What to say loudly at start."""
        return [sentence for sentence in (self.unmet, self._plan.caution) if sentence]

    def announcement(self) -> list[str]:
        """What is taken, with what was predicted of it, and what is not."""
        said = [f'not {rejection}' for rejection in self._plan.rejected]
        chosen = self._plan.chosen
        if chosen is not None:
            said.append(
                f'method: {chosen.name}; error {percent(chosen.errors.total)}, '
                f'{ms(chosen.cost.frame)} a frame of {ms(self._plan.task.available)}'
            )
        return said

    def follow(self, frame: Frame) -> str:
        """Looks at a frame; returns a sentence when the plan has just ceased to hold."""
        mesh = self._simulation.mesh
        if mesh.topology == 0:
            return ''
        needed = frame.substeps / max(frame.slow_motion, 1e-9)
        before, self.over = self.over, self._plan.over(needed, len(mesh.tetrahedra))
        return '' if before else self.over

    def values(self) -> dict[str, object]:
        """For /diagnostics."""
        chosen = self._plan.chosen
        if chosen is None:
            return {'method': 'no method fits the budget'}
        return {
            'method': chosen.name,
            'predicted_error': chosen.errors.total,
            'predicted_frame': chosen.cost.frame,
            'allowed_frame': self._plan.task.available,
        }
