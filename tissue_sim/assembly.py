"""From what a scene says of its tissue to the tissue."""

from dataclasses import asdict, replace

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.candidate import Task
from tissue_sim.dynamics import TimeStepping
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.mesh_io import load_tissue
from tissue_sim.plan import Plan, plan
from tissue_sim.replica import MeshReplica
from tissue_sim.settings import ActiveRegion, TissueSettings
from tissue_sim.simulation import TissueSimulation
from tissue_sim.warm_up import warm_up


def make_task(settings: TissueSettings) -> Task:
    """The scene as the planner sees it.

    Raises:
        MeshError: the mesh cannot be used.
    """
    nodes, tetrahedra, fixed = load_tissue(settings)
    m, d, i = settings.material, settings.damping, settings.integration
    return Task(
        TetMesh(nodes, tetrahedra, fixed),
        Material(m.youngs_modulus, m.poissons_ratio, m.density, d.alpha, d.beta),
        Resistance(settings.cut_threshold, m.toughness, m.blade_friction),
        settings.budget,
        TimeStepping(
            settings.integrator,
            rate=i.rate,
            safety=i.safety,
            min_substeps=i.min_substeps,
            max_substeps=i.max_substeps,
            frequency_growth=i.frequency_growth,
        ),
    )


def make_simulation(
    settings: TissueSettings, before: MeshReplica | None = None
) -> tuple[TissueSimulation, Plan | None]:
    """The simulation that a scene describes, and the plan it goes by if it asks for one.

    Where no method fits the budget, the scene's own model, integrator and active region are taken.

    Args:
        settings: its section `tissue`.
        before: the tissue as another simulation of this scene left it, to go on from.

    Raises:
        MeshError: the mesh cannot be used.
    """
    # First of all: of a kernel that several others contain, a process runs the copy that it loaded
    # first, and copies may differ in the last bit. Loaded in one order, they are always the same.
    warm_up()
    task = make_task(settings)
    found = plan(task) if settings.method == 'auto' else None
    taken = as_planned(settings, found)
    simulation = TissueSimulation(
        task.mesh if before is None else before.mesh(),
        task.material,
        task.resistance,
        model=taken.model,
        stepping=replace(task.stepping, integrator=taken.integrator),
        active=ActiveSettings(**taken.active_region.model_dump()),
        stretch=settings.stretch if before is None else (0.0, 0.0, 0.0),
    )
    if before is not None:
        simulation.resume(before.displacement, before.step)
    return simulation, found


def as_planned(settings: TissueSettings, found: Plan | None) -> TissueSettings:
    """The scene with the method that its simulation takes, given and not to be planned any more.

    Args:
        settings: its section `tissue`.
        found: by the plan, if the scene asks for one.
    """
    method: dict[str, object] = {'method': 'given'}
    if found is not None and found.chosen is not None:
        chosen = found.chosen
        method |= {'model': chosen.model, 'integrator': chosen.integrator}
        method['active_region'] = ActiveRegion(**asdict(chosen.active))
    return settings.model_copy(update=method)
