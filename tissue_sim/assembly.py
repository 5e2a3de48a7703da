"""From what a scene says of its tissue to the tissue."""

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.candidate import Task
from tissue_sim.dynamics import TimeStepping
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.mesh_io import load_tissue
from tissue_sim.plan import Plan, plan
from tissue_sim.settings import TissueSettings
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


def make_simulation(settings: TissueSettings) -> tuple[TissueSimulation, Plan | None]:
    """The simulation that a scene describes, and the plan it goes by if it asks for one.

    Where no method fits the budget, the scene's own model, integrator and active region are taken.

    Args:
        settings: its section `tissue`.

    Raises:
        MeshError: the mesh cannot be used.
    """
    # First of all: of a kernel that several others contain, a process runs the copy that it loaded
    # first, and copies may differ in the last bit. Loaded in one order, they are always the same.
    warm_up()
    task = make_task(settings)
    found = plan(task) if settings.method == 'auto' else None
    model, stepping = settings.model, task.stepping
    active = ActiveSettings(**settings.active_region.model_dump())
    if found is not None and found.chosen is not None:
        model, stepping, active = found.chosen.model, found.stepping, found.chosen.active
    simulation = TissueSimulation(
        task.mesh,
        task.material,
        task.resistance,
        model=model,
        stepping=stepping,
        active=active,
        stretch=settings.stretch,
    )
    return simulation, found
