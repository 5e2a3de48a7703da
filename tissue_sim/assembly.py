"""Assembly of a tissue simulation from the section `tissue` of a scene."""

from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material, RegionMaterial
from cutting_trainer.tissue_sim.mesh.checks import check_mesh, select_fixed
from cutting_trainer.tissue_sim.mesh.files import load_labelled_mesh, load_mesh
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.planner.candidate import Task
from cutting_trainer.tissue_sim.planner.memory import recall, remember
from cutting_trainer.tissue_sim.planner.plan import Plan, plan
from cutting_trainer.tissue_sim.scene_schema import ActiveRegionSettings, TissueSettings
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.warm_up import warm_up, warm_up_method, warm_up_models


def load_tissue(
    settings: TissueSettings,
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.bool_], NDArray[np.uint8]]:
    """Read and check the mesh that a scene names.

    Returns:
        nodes [m], shape (n, 3); tetrahedra, positively oriented, shape (m, 4); which nodes do not
        move, shape (n,); and regions by tetrahedron, shape (m,), (0,) in a scene without regions.

    Raises:
        MeshError: one sentence with the file, the element or node, and the remedy.
    """
    labels = np.zeros(0, np.int64)
    if settings.regions:
        nodes, tetrahedra, labels = load_labelled_mesh(settings.mesh, settings.unit_scale)
    else:
        nodes, tetrahedra = load_mesh(settings.mesh, settings.unit_scale)
    try:
        tetrahedra = check_mesh(nodes, tetrahedra)
        fixed = select_fixed(nodes, tetrahedra, settings.fixed)
        return nodes, tetrahedra, fixed, _regions(settings, labels)
    except MeshError as error:
        raise MeshError(f'{settings.mesh}: {error}') from None


def _regions(settings: TissueSettings, labels: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the region by tetrahedron: 0, or its place in the scene's list, from 1."""
    regions = np.zeros(len(labels) if settings.regions else 0, np.uint8)
    for number, region in enumerate(settings.regions, start=1):
        own = labels == region.label
        if not own.any():
            known = ', '.join(map(str, np.unique(labels)[:20]))
            raise MeshError(
                f'no tetrahedron has the label {region.label} of tissue.regions; there are {known}'
            )
        regions[own] = number
    return regions


def make_task(settings: TissueSettings, mesh: TetMesh | None = None) -> Task:
    """Return the scene as a task for the planner.

    Args:
        settings: section `tissue` of the scene.
        mesh: of the tissue; None: the scene's mesh.

    Raises:
        MeshError: the mesh is not valid.
    """
    m, d, i = settings.material, settings.damping, settings.integration
    of = settings.region_values
    stiffness = zip(of('youngs_modulus'), of('density'), strict=True)
    resistance = zip(of('toughness'), of('blade_friction'), strict=True)
    return Task(
        mesh or TetMesh(*load_tissue(settings)),
        Material(
            m.youngs_modulus,
            m.poissons_ratio,
            m.density,
            d.alpha,
            d.beta,
            m.stiffening,
            m.prony,
            tuple(RegionMaterial(*constants) for constants in stiffness),
        ),
        Resistance(
            settings.cut_threshold,
            m.toughness,
            m.blade_friction,
            settings.tip_width,
            tuple(resistance),
            m.crack_length,
        ),
        settings.budget,
        TimeStepping(
            settings.integrator,
            rate=i.rate,
            safety=i.safety,
            min_substeps=i.min_substeps,
            max_substeps=i.max_substeps,
            frequency_growth=i.frequency_growth,
        ),
        settings.model,
    )


def make_plan(
    task: Task,
    note: Callable[[str], None] = lambda text: None,
    say: Callable[[str], None] = lambda text: None,
    *,
    goes_on: bool = False,
) -> Plan:
    """Return the plan for a scene: that of an earlier start, or a new one, which is kept.

    One by which every method takes too long is made anew: the machine may have been busy.

    Args:
        task: the scene.
        note: gets one sentence if the plan is made anew.
        say: gets the name of the next measurement.
        goes_on: whether a session goes on, by the method that it has.
    """
    known = recall(task, note)
    if known is not None and (goes_on or not known.late):
        return known
    warm_up()  # a kernel that is loaded meanwhile would count as cost
    found = plan(task, say)
    remember(task, found)
    return found


def make_simulation(
    settings: TissueSettings,
    before: MeshReplica | None = None,
    note: Callable[[str], None] = lambda text: None,
    tools: int = 1,
) -> tuple[TissueSimulation, Plan | None]:
    """Return the simulation of a scene, and its plan if the scene asks for one.

    If no method fits the budget, the scene's own model, integrator and active region are used.

    Args:
        settings: its section `tissue`.
        before: state of the tissue in an earlier simulation of this scene, to continue from.
        note: gets one sentence if a plan is made anew, and the name of each measurement.
        tools: number of tools in the tissue.

    Raises:
        MeshError: the mesh is not valid, has no shape at rest under its weight, or continues a
            tissue without the regions of the scene.
    """
    # This comes first, see there.
    warm_up_models() if settings.method == 'auto' else warm_up_method(settings.integrator)
    # A cut mesh has coincident nodes, which the checks of a scene's mesh refuse.
    mesh = None if before is None else before.mesh()
    if mesh is not None and settings.regions and not len(mesh.regions):
        raise MeshError(
            'the tissue to continue from has no regions, and the scene has tissue.regions: begin '
            'anew, or take them out of the scene'
        )
    task = make_task(settings, None if settings.method == 'auto' else mesh)
    known = mesh is not None
    found = make_plan(task, note, note, goes_on=known) if settings.method == 'auto' else None
    taken = as_planned(settings, found)
    load_kernels(taken)
    simulation = TissueSimulation(
        mesh or task.mesh,
        task.material,
        task.resistance,
        model=taken.model,
        stepping=replace(task.stepping, integrator=taken.integrator),
        active=ActiveSettings(**taken.active_region.model_dump()),
        stretch=settings.stretch if before is None else (0.0, 0.0, 0.0),
        contact=settings.contact,
        friction=settings.material.dry_friction,
        gravity=settings.gravity,
        tools=tools,
        threads=settings.budget.threads,
    )
    if before is None:
        simulation.dynamics.settle()
    else:
        simulation.resume(before.displacement, before.step)
    return simulation, found


def load_kernels(settings: TissueSettings) -> None:
    """Load all kernels that a scene needs, in the order that gives the same bits each time.

    Args:
        settings: its section `tissue`, with a known method.
    """
    far_field = settings.active_region.mode == 'budget'
    viscous, parallel = bool(settings.material.prony), settings.budget.threads > 1
    warm_up_method(settings.integrator, far_field=far_field, viscous=viscous, parallel=parallel)


def as_planned(settings: TissueSettings, found: Plan | None) -> TissueSettings:
    """Return the scene settings with the planned method, and planning switched off.

    Args:
        settings: its section `tissue`.
        found: the plan, if the scene asks for one.
    """
    method: dict[str, object] = {'method': 'given'}
    if found is not None and found.chosen is not None:
        chosen = found.chosen
        method |= {'model': chosen.model, 'integrator': chosen.integrator}
        method['active_region'] = ActiveRegionSettings(**asdict(chosen.active))
    return settings.model_copy(update=method)
