"""Monitor of a plan: its report at start, and whether it still holds after cuts."""

from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.tissue_sim.planner.plan import Plan
from cutting_trainer.tissue_sim.planner.rejection_reasons import by_cause, ms, percent
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation


class PlanMonitor:
    """Compares the frames with the plan.

    Args:
        plan: of the simulation.
        simulation: the simulation.

    Attributes:
        over: a sentence if cuts have raised the cost above the budget, else ''.
    """

    def __init__(self, plan: Plan, simulation: TissueSimulation) -> None:
        self._plan = plan
        self._simulation = simulation
        self.over = ''

    @property
    def unmet(self) -> str:
        """A sentence if no method fits the budget, else ''."""
        if self._plan.chosen is not None:
            return ''
        model, stepping = self._simulation.model, self._simulation.dynamics.stepping
        return (
            f'no method fits the budget, so {model.name} by {stepping.integrator} is taken; to '
            f'have one: {"; or ".join(self._plan.remedies)}'
        )

    @property
    def warnings(self) -> list[str]:
        """Return the warnings at start."""
        return [sentence for sentence in (self.unmet, self._plan.caution) if sentence]

    def announcement(self) -> list[str]:
        """Return the chosen method with its prediction, and the rejected ones."""
        said = [f'not {rejection}' for rejection in self._plan.rejected]
        chosen = self._plan.chosen
        if chosen is not None:
            said.append(
                f'method: {chosen.name}; '
                f'error {percent(chosen.errors.total)} ({by_cause(chosen.errors)}), '
                f'{ms(chosen.cost.frame)} a frame of {ms(self._plan.available)}'
                + (f', {ms(chosen.cutting)} in a cut' if chosen.cutting else '')
            )
        return said

    def follow(self, frame: Frame) -> str:
        """Check a frame; return a sentence when the plan has just ceased to hold."""
        mesh = self._simulation.mesh
        if mesh.topology == 0:
            return ''
        needed = frame.substeps / max(frame.slow_motion, 1e-9)
        before, self.over = self.over, self._plan.over(needed, len(mesh.tetrahedra))
        return '' if before else self.over

    def values(self) -> dict[str, object]:
        """Return the values for /diagnostics."""
        chosen = self._plan.chosen
        if chosen is None:
            return {'method': 'no method fits the budget'}
        return {
            'method': chosen.name,
            'predicted_error': chosen.errors.total,
            'predicted_frame': chosen.cost.frame,
            'predicted_cut_frame': chosen.cutting,
            'allowed_frame': self._plan.available,
        }
