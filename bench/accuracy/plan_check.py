"""Compare the plans of the shipped scenes with measurements: cost and error.

Run `python -m bench.accuracy.plan_check`, or name scenes after it. Cost: frames in which a
tool presses at other places than the planner's. Errors are those of the settlement where the
scene's script presses, against quadratic tetrahedra of scikit-fem on the same mesh: of a linear
tissue under a small load, of the footprint, and of a hyperelastic one as deep as the budget says.
"""

import sys
import time

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench.accuracy.quadratic import QuadraticTissue
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.scene_loader import SCENES, Scene, load_scene
from cutting_trainer.tissue_sim.assembly import make_task
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.candidate import Candidate, Task
from cutting_trainer.tissue_sim.planner.contact_errors import contact_error
from cutting_trainer.tissue_sim.planner.frame_cost import frame_time, tool_depth, uncut
from cutting_trainer.tissue_sim.planner.indentation import Indenter, places, settlement
from cutting_trainer.tissue_sim.planner.plan import plan
from cutting_trainer.tissue_sim.planner.rejection_reasons import percent
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.warm_up import warm_up

Floats = NDArray[np.float64]

_FRAMES = 60
_REPEATS = 3
_SHARES = np.linspace(0.125, 1.0, 8)


def press_at(mesh: TetMesh, place: Floats, radius: float) -> Indenter:
    """Return a press on the free surface that is nearest to a place [m], shape (3,)."""
    corners = mesh.rest[mesh.triangles]
    free = (mesh.fixed[mesh.triangles] == 0).all(axis=1)
    away = np.where(free, np.linalg.norm(corners.mean(axis=1) - place, axis=1), np.inf)
    nearest = int(away.argmin())
    side = np.cross(*(corners[nearest, i] - corners[nearest, 0] for i in (1, 2)))
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    return Indenter(corners[nearest].mean(axis=0), max(radius, edge), -side / np.linalg.norm(side))


def script_presses(scene: Scene, task: Task) -> list[Indenter]:
    """Return a press under each place that the scene's script palpates."""
    spots = [
        w.position
        for p in scene.arm.require_script().phases
        if p.kind == 'palpate'
        for w in p.waypoints
    ]
    top = task.mesh.rest[:, 2].max()
    level = np.unique(np.array(spots)[:, :2], axis=0)
    return [press_at(task.mesh, np.array([*s, top]), task.budget.contact_radius) for s in level]


def settlement_error(
    task: Task, chosen: Candidate, presses: list[Indenter], exact: QuadraticTissue
) -> float:
    """Return largest relative error of the settlement by the size of the elements."""
    smoothed = chosen.model not in ('linear', 'corotational')
    model = ElasticModel(task.mesh, task.material, 'linear_smoothed' if smoothed else 'linear')
    own = [settlement(model, press.load(task.mesh))[0] for press in presses]
    return max(abs(a / exact.settlement(p) - 1) for a, p in zip(own, presses, strict=True))


def deep_error(
    task: Task, chosen: Candidate, presses: list[Indenter], exact: QuadraticTissue
) -> float:
    """Return largest relative error of the settlement where the tissue goes as deep as the budget
    says.

    Infinite where the chosen model gives way; not a number where the reference has no equilibrium.
    """
    depth = task.budget.displacement
    model = ElasticModel(task.mesh, task.material, chosen.model)
    worst = 0.0
    for press in presses:
        try:
            force = exact.force(press, depth)
        except MeshError:
            return float('nan')
        try:
            worst = max(worst, abs(_at(model, force * press.load(task.mesh)) / force / depth - 1))
        except MeshError:
            return float('inf')
    return worst


def footprint_error(task: Task, presses: list[Indenter], exact: QuadraticTissue) -> float:
    """Return largest relative error of a tool's depth by its footprint."""
    depth = task.budget.displacement
    args = task.mesh, task.material
    return max(contact_error(*args, press, depth, exact.settlement) for press in presses)


def _at(model: ElasticModel, load: Floats) -> float:
    """Return the work of a load on the tissue at rest under it [J]."""
    u = np.zeros_like(load)
    for share in _SHARES if model.rotating else _SHARES[-1:]:
        u = equilibrium(model, share * load, start=u, tolerance=1e-4)
    return float(np.sum(load * u))


def measured_frame(task: Task, chosen: Candidate) -> float:
    """Return CPU time of a frame [s]: a tool goes in and out at three places, a second at each.

    All of it some times over, of which each frame's least time counts, as in the plan.
    """
    simulation = TissueSimulation(
        task.mesh,
        task.material,
        uncut(task),
        model=chosen.model,
        stepping=task.stepped_by(chosen),
        active=chosen.active,
    )
    presses = places(task.mesh, task.budget.contact_radius, 4)[1:]
    model = ElasticModel(task.mesh, task.material, 'linear_smoothed')
    softest = max(settlement(model, press.load(task.mesh))[0] for press in presses)
    depths = tool_depth(task, softest) * np.sin(np.linspace(0.0, np.pi, _FRAMES // 2)) ** 2
    contacts = [
        indenter_contact(task.mesh, press.centre, press.direction, depth)
        for press in presses
        for depth in depths
    ]
    times = np.empty((_REPEATS, len(contacts)))
    for stroke in times:
        for number, contact in enumerate(contacts):
            start = time.thread_time()
            simulation.frame(contact)
            stroke[number] = time.thread_time() - start
    return frame_time(chosen.integrator, times.min(axis=0).tolist())


def row(name: str) -> list[str]:
    """Return the row of a scene."""
    scene = load_scene(name)
    task = make_task(scene.tissue)
    start = time.process_time()
    chosen = plan(task).chosen  # anew, whatever is remembered
    took = time.process_time() - start
    if chosen is None:
        return [name, 'none fits']
    cost = measured_frame(task, chosen)
    presses = script_presses(scene, task)
    exact = QuadraticTissue(task.mesh, task.material)
    return [
        name,
        chosen.name,
        f'{took:.1f}',
        f'{1e3 * chosen.cost.frame:.2f}',
        f'{1e3 * cost:.2f}',
        percent(chosen.errors.elements),
        percent(settlement_error(task, chosen, presses, exact)),
        percent(chosen.errors.contact),
        percent(footprint_error(task, presses, exact)),
        percent(chosen.errors.total),
        percent(deep_error(task, chosen, presses, exact)),
    ]


def main() -> None:
    """Print the table."""
    warm_up()
    columns = ('scene', 'method', 'plan [s]', 'frame [ms]', 'measured')
    table = Table(*columns, 'elements', 'measured', 'footprint', 'measured', 'in all', 'measured')
    for name in sys.argv[1:] or sorted(path.stem for path in SCENES.glob('*.yaml')):
        table.add_row(*row(name))
    Console(width=140).print(table)


if __name__ == '__main__':
    main()
