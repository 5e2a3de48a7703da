"""The command `trainer plan`: the least method that meets a scene's budget."""

from rich.console import Console
from rich.markup import escape

from session.scene import load_scene
from session.status import Status
from tissue_sim.assembly import make_task
from tissue_sim.plan import Candidate, Plan, plan
from tissue_sim.settings import TissueSettings


def run_plan(scene: str) -> Status:
    """Plans for a scene and prints the answer.

    Args:
        scene: name or path.

    Returns:
        OK if a method meets the budget, else FAILED.

    Raises:
        SessionError, SceneError, MeshError: the scene cannot be used.
    """
    settings = load_scene(scene).tissue
    found = plan(make_task(settings))
    console = Console(soft_wrap=True, highlight=False)
    for line in report(scene, settings, found):
        console.print(escape(line))
    return Status.OK if found.chosen else Status.FAILED


def report(scene: str, settings: TissueSettings, found: Plan) -> list[str]:
    """The lines that are printed."""
    b, task = settings.budget, found.task
    lines = [
        f'{scene}: {found.tetrahedra} tetrahedra; up to {1e3 * b.displacement:g} mm and '
        f'{b.rotation:g} degrees, {"cut" if b.cuts else "not cut"}; '
        f'error at most {100 * b.error:g} %, {1e3 * task.available:.3g} ms a frame at '
        f'{task.stepping.rate:g} Hz'
    ]
    if found.chosen is not None:
        lines += _chosen(found.chosen, found)
    else:
        lines.append('no method meets this budget')
    lines += [f'  not {sentence}' for sentence in found.rejected]
    if found.remedies:
        lines += ['what would have to give:', *(f'  {sentence}' for sentence in found.remedies)]
    given = f'{settings.model} by {settings.integrator}'
    if found.chosen is not None and settings.method == 'given' and given != found.chosen.name:
        lines.append(f'the scene takes {given}; tissue.method: auto would follow the plan')
    return lines


def _chosen(chosen: Candidate, found: Plan) -> list[str]:
    cost, worst, errors = chosen.cost, found.worst, chosen.errors
    lines = [
        f'{chosen.name}',
        f'  error {100 * errors.total:.2g} %: {100 * errors.elements:.2g} % by the size of the '
        f'elements, {100 * max(errors.rotation, errors.depth):.2g} % by linear strain, '
        f'{100 * errors.time:.2g} % by the step',
        f'  {1e3 * cost.frame:.3g} ms a frame: '
        f'{cost.substeps} substeps of {1e3 * cost.step:.3g} ms',
    ]
    if worst is not None and worst != cost:
        lines.append(
            f'  at most {1e3 * worst.frame:.3g} ms when cuts have shortened the step: '
            f'{worst.substeps} substeps'
        )
    return lines
