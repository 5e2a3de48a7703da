"""Holds the plans of the shipped scenes against measurement: cost, and error.

Run `python -m bench.plan_check`. Cost: frames in which a tool presses at other places than the
planner's. Error: settlement under a load against quadratic tetrahedra of scikit-fem on the same
mesh, and at the largest displacement against the corotational model on a mesh twice as fine.
"""

import time

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from session.scene import SCENES, load_scene
from tissue_sim.assembly import make_task
from tissue_sim.contact import press_triangle
from tissue_sim.elasticity import ElasticModel
from tissue_sim.equilibrium import equilibrium
from tissue_sim.errors import MeshError
from tissue_sim.mesh import TetMesh
from tissue_sim.plan import Plan, frame_time, plan
from tissue_sim.probe import Press, places, settlement
from tissue_sim.refine import refined
from tissue_sim.simulation import TissueSimulation

Floats = NDArray[np.float64]

_FRAMES = 60


def press_at(mesh: TetMesh, place: Floats, radius: float) -> Press:
    """A press on the free surface that is nearest to a place [m], shape (3,)."""
    corners = mesh.rest[mesh.triangles]
    free = (mesh.fixed[mesh.triangles] == 0).all(axis=1)
    away = np.where(free, np.linalg.norm(corners.mean(axis=1) - place, axis=1), np.inf)
    nearest = int(away.argmin())
    side = np.cross(*(corners[nearest, i] - corners[nearest, 0] for i in (1, 2)))
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    return Press(corners[nearest].mean(axis=0), max(radius, edge), -side / np.linalg.norm(side))


def settlement_error(found: Plan, spots: Floats) -> float:
    """Largest relative error of the settlement by the size of the elements.

    Args:
        found: a plan that has chosen.
        spots: where to press [m], shape (k, 3).
    """
    assert found.chosen is not None
    task = found.task
    smoothed = found.chosen.model.endswith('_smoothed')
    model = ElasticModel(task.mesh, task.material, 'linear_smoothed' if smoothed else 'linear')
    presses = [press_at(task.mesh, spot, task.budget.contact_radius) for spot in spots]
    own = [settlement(model, press.load(task.mesh))[0] for press in presses]
    exact = quadratic_settlements(task.mesh, model, presses)
    return max(abs(a / b - 1) for a, b in zip(own, exact, strict=True))


def quadratic_settlements(mesh: TetMesh, model: ElasticModel, presses: list[Press]) -> list[float]:
    """Settlements [m] of quadratic tetrahedra on the same mesh, by scikit-fem."""
    import skfem
    from scipy.sparse.linalg import splu
    from skfem.models.elasticity import linear_elasticity

    whole = skfem.MeshTet(mesh.rest.T.copy(), mesh.tetrahedra.T.astype(np.int64))
    basis = skfem.Basis(whole, skfem.ElementVector(skfem.ElementTetP2()), intorder=3)
    material = model.material
    stiffness = linear_elasticity(material.lame_lambda, material.lame_mu).assemble(basis)
    held = mesh.fixed == 1
    facets = np.flatnonzero(held[whole.facets].all(axis=0))
    fixed = np.unique(np.concatenate([basis.get_dofs(facets).all(), _nodal(basis, held)]))
    free = np.setdiff1d(np.arange(stiffness.shape[0]), fixed)
    factors = splu(stiffness[free][:, free].tocsc())
    surface = basis.boundary()
    found = []
    for press in presses:
        facing = np.asarray(surface.normals)
        towards = np.einsum('iqp,i->qp', facing, press.direction) < 0

        @skfem.LinearForm
        def work(v, w, press=press, towards=towards):
            away = np.sqrt(sum((w.x[i] - press.centre[i]) ** 2 for i in range(3))) / press.radius
            pressure = np.where(away < 1, (1 - away**2) ** 2, 0.0) * towards
            return pressure * sum(press.direction[i] * v[i] for i in range(3))

        load = work.assemble(surface)
        total = sum(press.direction[i] * load[_component(basis, i)].sum() for i in range(3))
        load /= total
        u = np.zeros(len(load))
        u[free] = factors.solve(load[free])
        found.append(float(load @ u))
    return found


def _nodal(basis, held: NDArray[np.bool_]) -> NDArray[np.int64]:
    return basis.nodal_dofs[:, held].ravel()


def _component(basis, axis: int) -> NDArray[np.int64]:
    return np.concatenate([basis.nodal_dofs[axis], basis.edge_dofs[axis]])


def total_error(found: Plan) -> float:
    """Error of the settlement at the largest displacement, by elements and by strain alike.

    Against the smoothed corotational model on a mesh twice as fine, under the load that makes the
    chosen model go as deep as the scene allows; infinite where that tissue gives way.
    """
    assert found.chosen is not None
    task = found.task
    fine = refined(task.mesh)
    press = places(task.mesh, task.budget.contact_radius, 1)[0]
    load, finer = press.load(task.mesh), press.load(fine)
    deep = task.budget.displacement
    own = ElasticModel(task.mesh, task.material, found.chosen.model)
    exact = ElasticModel(fine, task.material, 'corotational_smoothed')
    small = settlement(ElasticModel(task.mesh, task.material, 'linear_smoothed'), load)[0]
    try:
        pair = [_at(model, force * deep / small) for model, force in ((own, load), (exact, finer))]
    except MeshError:
        return float('inf')
    return abs(pair[0] / pair[1] - 1)


def _at(model: ElasticModel, load: Floats) -> float:
    u = np.zeros_like(load)
    for share in (0.25, 0.5, 0.75, 1.0):
        u = equilibrium(model, share * load, start=u, tolerance=1e-4)
    return float(np.sum(load * u))


def measured_frame(found: Plan) -> float:
    """CPU time of a frame [s]: a tool goes in and out at three places, a second at each."""
    assert found.chosen is not None
    task = found.task
    simulation = TissueSimulation(
        task.mesh,
        task.material,
        task.resistance,
        model=found.chosen.model,
        stepping=found.stepping,
    )
    times = []
    for press in places(task.mesh, task.budget.contact_radius, 4)[1:]:
        for number in range(_FRAMES // 2):
            most = min(0.5 * task.budget.displacement, 0.9 * task.resistance.threshold / 200.0)
            depth = most * np.sin(np.pi * number * 2 / _FRAMES) ** 2
            contact = press_triangle(task.mesh, press.centre, press.direction, depth)
            start = time.thread_time()
            simulation.frame(contact)
            times.append(time.thread_time() - start)
    return frame_time(found.chosen.integrator, times)


def main() -> None:
    table = Table('scene', 'method', 'ms a frame', 'measured', 'elements', 'P2', 'in all', 'fine')
    for path in sorted(SCENES.glob('*.yaml')):
        found = plan(make_task(load_scene(path.stem).tissue))
        if found.chosen is None:
            table.add_row(path.stem, 'none fits')
            continue
        script = load_scene(path.stem).arm.script
        spots = np.array(
            [w.position for p in script.phases if p.kind == 'palpate' for w in p.waypoints]
        )
        spots = np.unique(spots[:, :2], axis=0)
        spots = np.column_stack([spots, np.full(len(spots), found.task.mesh.rest[:, 2].max())])
        errors = found.chosen.errors
        table.add_row(
            path.stem,
            found.chosen.name,
            f'{1e3 * found.chosen.cost.frame:.2f}',
            f'{1e3 * measured_frame(found):.2f}',
            f'{100 * errors.elements:.1f} %',
            f'{100 * settlement_error(found, spots):.1f} %',
            f'{100 * errors.total:.1f} %',
            f'{100 * total_error(found):.1f} %',
        )
    console = Console()
    console.print(table)
    console.print('predicted, then measured: cost, error by the elements, error in all')


if __name__ == '__main__':
    main()
