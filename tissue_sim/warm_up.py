"""Calls every kernel of the tissue once, so that none is compiled or loaded in a session."""

from functools import cache
from itertools import permutations

import numpy as np

from tissue_sim.active_region import ActiveSettings
from tissue_sim.blade import Resistance
from tissue_sim.compliance import PointCompliance
from tissue_sim.contact import State, ToolContact
from tissue_sim.coupling import Coupling
from tissue_sim.dynamics import Dynamics, TimeStepping
from tissue_sim.elasticity import MODELS, ElasticModel
from tissue_sim.integrators import INTEGRATORS
from tissue_sim.locate import closest_triangle, distance_to_triangles, locate_points
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh, TopologyDelta
from tissue_sim.simulation import TissueSimulation
from tissue_sim.tensor_mass import TensorMass, packed

_FRAMES = 40


@cache
def warm_up() -> None:
    """Every model and integrator; a tool on a cube until the blade is through; an element out.

    Only the first call does anything.
    """
    _warm_up_models()
    simulation = TissueSimulation(
        small_cube(), Material(1000.0, 0.4, 1000.0, 10.0, 5e-4), Resistance(0.05, 1.0, 0.1)
    )
    simulation.frame(None)
    for number in range(_FRAMES):
        depth = 2e-4 * number
        simulation.frame(_press(simulation, depth))
        if simulation.state == State.INSIDE:
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
    distance_to_triangles(far, simulation.positions, mesh.triangles)
    closest_triangle(far, mesh.rest, mesh.triangles)
    locate_points(
        simulation.positions,
        mesh.tetrahedra,
        mesh.neighbors,
        far[None],
        0,
        np.empty(1, np.int64),
        np.empty((1, 4)),
    )


def _warm_up_models() -> None:
    material = Material(1000.0, 0.4, 1000.0, 10.0, 5e-4)
    region = ActiveSettings('budget', 6)
    for model in MODELS:
        Dynamics(small_cube(), material, model, active=region).advance(Coupling())
    for integrator in INTEGRATORS:
        Dynamics(small_cube(), material, 'linear', TimeStepping(integrator)).advance(Coupling())
    # What else only a large tissue meets, or one that has been cut for a while.
    tissue, n = ElasticModel(small_cube(), material, 'linear'), 8
    some, free = np.arange(n - 1), np.ones(3 * n, bool)
    PointCompliance().estimate(tissue, free, some[-1:], np.ones(1), np.eye(3), some)
    rows = TensorMass(tissue.mesh, 1.0, 1.0).tensors
    packed(rows.start, rows.used, rows.room, n, rows.columns, rows.blocks, np.array([1 << 20]))


def small_cube() -> TetMesh:
    """A centimetre of tissue in six tetrahedra, fixed at its underside."""
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
        state=State.TOUCHING,
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
