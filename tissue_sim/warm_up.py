"""Warm-up: calls the kernels of the tissue once, so that none is compiled or loaded in a session.

A session needs those of one integrator; a plan, which tries all methods, those of all.
"""

from dataclasses import replace
from functools import cache
from itertools import permutations

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling, springs_of
from cutting_trainer.tissue_sim.contact.cut_contact_search import NearFaces
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact
from cutting_trainer.tissue_sim.elasticity.compliance import PointCompliance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel
from cutting_trainer.tissue_sim.elasticity.tensor_mass import TensorMass, packed
from cutting_trainer.tissue_sim.mesh.checks import components
from cutting_trainer.tissue_sim.mesh.locate import (
    closest_triangle,
    distance_to_triangles,
    find_tetrahedra,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import INTEGRATORS, IntegratorName
from cutting_trainer.tissue_sim.motion.parallel_euler import ParallelEuler
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

_FRAMES = 40
_MATERIAL = Material(1000.0, 0.4, 1000.0, 10.0, 5e-4)
_STEPPING = TimeStepping('symplectic_euler')


def warm_up() -> None:
    """Run every model and integrator, far fields, viscosity and threads; move a tool through a
    cube, and remove an element.
    """
    for integrator in INTEGRATORS:
        warm_up_method(integrator)
    warm_up_method(integrator, far_field=True, viscous=True, parallel=True)


def warm_up_method(
    integrator: IntegratorName,
    *,
    far_field: bool = False,
    viscous: bool = False,
    parallel: bool = False,
) -> None:
    """Run every model, and one integrator; move a tool through a cube, and remove an element.

    The kernels of all models come first, and in the same order for all integrators: of a kernel
    inlined in several others, a process runs the copy loaded first, and copies may differ in the
    last bit. A fixed order makes results reproducible. Those that few scenes need come last.

    Args:
        integrator: name.
        far_field, viscous: whether a tissue has a far field or viscosity.
        parallel: whether several threads compute a frame.
    """
    warm_up_models()
    warm_up_frames(integrator)
    if far_field:
        _warm_up_far_field()
    if viscous:
        _warm_up_viscosity()
    if parallel:
        _warm_up_threads()


@cache
def warm_up_frames(integrator: IntegratorName) -> None:
    """Press a tool on a cube until the blade is through, then take elements out.

    Only the first call for an integrator does anything.
    """
    simulation = TissueSimulation(
        small_cube(),
        _MATERIAL,
        Resistance(0.005, 1.0, 0.1),
        stepping=TimeStepping(integrator),
    )
    simulation.frame(None)
    for number in range(_FRAMES):
        depth = 2e-4 * number
        simulation.frame(_press(simulation, depth))
        if simulation.state == ContactState.INSIDE:
            simulation.cut_failed()
    parents = simulation.mesh.tetrahedra[5].astype(np.int64)
    children = np.tile(parents, (4, 1))
    children[range(4), range(4)] = simulation.mesh.node_count
    simulation.apply_cut(
        TopologyDelta(
            node_parents=parents[None],
            node_weights=np.full((1, 4), 0.25),
            removed_tetrahedra=np.array([5], np.int64),
            tetrahedra=children,
            outer_faces=np.array([1, 2, 4, 8], np.uint8),
        )
    )
    simulation.frame(None)
    simulation.apply_cut(TopologyDelta(removed_tetrahedra=np.array([0], np.int64)))
    simulation.frame(None)
    mesh, far = simulation.mesh, np.full(3, 1.0)
    touching = NearFaces(np.arange(4)[None], mesh.rest[None, :4].copy(), np.zeros((1, 3, 3)))
    flat = simulation.displacement.ravel(), simulation.velocity.ravel()
    simulation.dynamics.cut_contact.force(touching, *flat)
    components(mesh.node_count, mesh.triangles[:, :2])
    distance_to_triangles(far, simulation.positions, mesh.triangles)
    closest_triangle(far, mesh.rest, mesh.triangles)
    find_tetrahedra(simulation.positions, mesh.tetrahedra, mesh.neighbors, far[None])


@cache
def warm_up_models() -> None:
    """Move a cube with every model. Only the first call does anything."""
    _move_every_model(ActiveSettings())
    # Further kernels, for a large tissue or one after many cuts.
    cube, n = small_cube(), 8
    nodes, free = np.array([1]), np.ones(3 * n, bool)
    for model in ('linear', 'stiffening'):
        tissue = ElasticModel(cube, _MATERIAL, model)
        PointCompliance(most=4).estimate(tissue, free, nodes, np.ones(1), np.eye(3))
    rows = TensorMass(cube, 1.0, 1.0).tensors
    packed(rows.start, rows.used, rows.room, n, rows.columns, rows.blocks, np.array([1 << 20]))


@cache
def _warm_up_far_field() -> None:
    """Move a cube with a far field by every model. Only the first call does anything."""
    _move_every_model(ActiveSettings('budget', 6))


@cache
def _warm_up_viscosity() -> None:
    """Move a viscous cube. Only the first call does anything."""
    viscous = replace(_MATERIAL, prony=((0.5, 1.0),))
    Dynamics(small_cube(), viscous, 'stiffening', _STEPPING).advance(Coupling())


@cache
def _warm_up_threads() -> None:
    """Move a cube by two threads. Only the first call does anything."""
    cube, n = ElasticModel(small_cube(), _MATERIAL), 8
    springs = springs_of((_touching(),), cube.mesh.rest)
    u, v = np.zeros((2, 3 * n))
    euler = ParallelEuler('symplectic_euler', _MATERIAL.alpha, _MATERIAL.beta, threads=2)
    euler.min_nodes = 0
    euler.step(cube.operands(), np.ones(3 * n), cube.diagonal, springs, u, v, 1e-4, 1)


def _touching() -> Coupling:
    """Return the coupling of a tool that pulls a corner of the cube."""
    top = np.full(3, 0.01)
    return Coupling(PUSH, np.array([7]), np.ones(1), top, top, stiffness=1.0)


def _move_every_model(active: ActiveSettings) -> None:
    for model in MODELS:
        cube = Dynamics(small_cube(), _MATERIAL, model, _STEPPING, active)
        for coupling in (Coupling(), _touching(), Coupling()):
            cube.advance(coupling)


def small_cube() -> TetMesh:
    """Return a 1 cm cube of tissue of six tetrahedra, fixed at its underside."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    tets = []
    for order in permutations(range(3)):
        corner = np.zeros(3, int)
        path = [0]
        for axis in order:
            corner[axis] = 1
            path.append(int(corner @ (4, 2, 1)))
        edges = corners[path[1:]] - corners[path[0]]
        tets.append(path if np.linalg.det(edges) > 0 else [path[0], path[2], path[1], path[3]])
    return TetMesh(corners * 0.01, np.array(tets), corners[:, 2] == 0)


def _press(simulation: TissueSimulation, depth: float) -> ToolContact:
    mesh = simulation.mesh
    heights = mesh.rest[mesh.triangles][:, :, 2].min(axis=1)
    nodes = mesh.triangles[int(np.argmax(heights))].astype(np.int64)
    radius = 0.001
    tip = simulation.positions[nodes].mean(axis=0) + np.array([0.0, 0.0, radius - depth])
    return ToolContact(
        state=ContactState.TOUCHING,
        topology=mesh.topology,
        nodes=nodes,
        weights=np.full(3, 1 / 3),
        device=tip,
        offset=np.array([0.0, 0.0, radius]),
        normal=np.array([0.0, 0.0, 1.0]),
        stiffness=200.0,
        radius=radius,
        blade_root=tip + np.array([0.0, 0.0, 0.02]),
        blade_tip=tip - np.array([0.0, 0.0, radius]),
    )
