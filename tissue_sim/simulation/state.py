"""Whole state of a tissue simulation: frames computed from it are identical bit by bit."""

from types import SimpleNamespace

import numpy as np

from cutting_trainer.tissue_sim.contact import (
    anchor,
    blade,
    blade_law,
    coupling,
    cut_contact,
    facing,
    footprint,
    fracture,
    friction,
    immersion,
    tool_spring,
)
from cutting_trainer.tissue_sim.contact import tool as contact
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity import (
    adaptive_law,
    coarse_rows,
    compliance,
    corotational,
    elastic_force,
    local_rows,
    material,
    tensor_mass,
    viscosity,
)
from cutting_trainer.tissue_sim.elasticity import models as elasticity
from cutting_trainer.tissue_sim.elasticity import nodal_smoothing as domains
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh import adjacency as rings
from cutting_trainer.tissue_sim.mesh import tetra_mesh as mesh
from cutting_trainer.tissue_sim.mesh import topology
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion import (
    active_region,
    coarse_grid,
    coarse_stiffness,
    dynamics,
    elastic_state,
    far_field,
    integrators,
    loads,
    nodal_mass,
    parallel_euler,
    stability,
    stiffened_mass,
    time_steps,
)
from cutting_trainer.tissue_sim.motion import divergence as guard
from cutting_trainer.tissue_sim.simulation import local_stiffness as contact_stiffness
from cutting_trainer.tissue_sim.simulation import simulation, tool_state, within_frame
from cutting_trainer.tissue_sim.simulation.serialisation import (
    ObjectState,
    capture,
    classes_of,
    rebuild,
)
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state_checks import check_simulation, checked

_MODULES = (
    active_region,
    adaptive_law,
    anchor,
    blade,
    coarse_grid,
    coarse_rows,
    coarse_stiffness,
    compliance,
    contact,
    contact_stiffness,
    corotational,
    coupling,
    cut_contact,
    domains,
    dynamics,
    blade_law,
    elastic_force,
    elastic_state,
    elasticity,
    facing,
    far_field,
    footprint,
    fracture,
    friction,
    guard,
    immersion,
    integrators,
    loads,
    local_rows,
    material,
    mesh,
    nodal_mass,
    parallel_euler,
    rings,
    simulation,
    stability,
    stiffened_mass,
    tensor_mass,
    time_steps,
    tool_spring,
    tool_state,
    topology,
    viscosity,
    within_frame,
)
MESH_CLASSES = classes_of((mesh, topology))
_CLASSES = classes_of(_MODULES)


def state_of(simulation: TissueSimulation) -> ObjectState:
    """Return the state that all later frames depend on, apart from contacts and cuts."""
    return capture(simulation, _CLASSES)


def from_state(state: ObjectState) -> TissueSimulation:
    """Return the simulation of a state.

    Args:
        state: as returned by `state_of`.

    Raises:
        StateError: the state is not valid, is of another version, or has an index out of range.
    """
    material, resistance = Material(1e4, 0.4, 1e3, 1.0, 1e-3), Resistance(1.0, 1.0, 1.0)
    like = TissueSimulation(smallest_mesh(), material, resistance)
    restored: TissueSimulation = rebuild(state, _CLASSES, like)
    checked(check_simulation, restored)
    return restored


def smallest_mesh() -> TetMesh:
    """Return one tetrahedron fixed at one face, of this version's classes."""
    nodes = 0.01 * np.vstack([np.eye(3), np.zeros((1, 3))])
    fixed = np.array([0, 1, 1, 1], np.uint8)
    return TetMesh(nodes, np.array([[3, 0, 1, 2]]), fixed)


def shape_of(simulation: TissueSimulation) -> MeshReplica:
    """Return mesh, displacement and frame of a simulation, without its dynamics."""
    m = simulation.mesh
    shape = MeshReplica()
    shape.load(
        SimpleNamespace(
            rest=m.rest.ravel(),
            displacement=simulation.displacement.ravel(),
            fixed=m.fixed,
            tetrahedra=m.tetrahedra.ravel(),
            triangles=m.triangles.ravel(),
            triangle_kind=m.triangle_kind,
            region=m.regions,
            revision=0,
            topology=m.topology,
            step=simulation.step,
        )
    )
    return shape
