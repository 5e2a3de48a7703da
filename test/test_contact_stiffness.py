"""What a tool is told of the tissue beside the force: stiffness here, ahead, and from afar."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box

from cutting_trainer.tissue_sim.contact.coupling import HOLD, PUSH, Coupling
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName, ToolSprings
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.simulation.local_stiffness import ContactStiffness

SIZE, TOP, RADIUS, SPRING = 0.008, 0.024, 0.004, 200.0
UP, REST = np.array([0.0, 0.0, 1.0]), np.zeros(3)
AT = np.array([0.0265, 0.0225])
"""[m] x and y of the contact, in a triangle of the upper side."""
FRAME = 1 / 30
MATERIAL = Material(3000.0, 0.45, 1000.0, 15.0, 1e-4)


def tissue() -> Dynamics:
    nodes, tets = box((6, 6, 3), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    return Dynamics(mesh, MATERIAL, 'linear_smoothed', None, None)


def springs(dynamics: Dynamics, name: ContactName = 'triangle') -> ToolSprings:
    return ToolSprings(dynamics.mesh, MATERIAL.plane_modulus, name)


def spring_of(dynamics: Dynamics, pressing: ToolContact) -> Coupling:
    """The spring of a contact with a triangle."""
    return springs(dynamics).spring(pressing, 0.0, 0.0)


def touched(mesh: TetMesh, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes of the triangle of the upper side over a place, and its barycentric weights there."""
    for nodes in mesh.triangles[(mesh.rest[mesh.triangles][:, :, 2] > TOP - 1e-9).all(axis=1)]:
        corners = np.vstack([mesh.rest[nodes][:, :2].T, np.ones(3)])
        weights = np.linalg.solve(corners, [*place, 1.0])
        if (weights >= 0).all():
            return nodes.astype(np.int64), weights
    raise AssertionError(f'nothing lies under {place}')


def contact(mesh: TetMesh, gap: float) -> ToolContact:
    """A tool over the place `AT`, by a gap [m]; below 0 it presses."""
    nodes, weights = touched(mesh, AT)
    height = gap + RADIUS
    return ToolContact(
        state=ContactState.TOUCHING if gap < 0 else ContactState.NONE,
        topology=mesh.topology,
        nodes=nodes,
        weights=weights,
        device=np.array([*AT, TOP + height]),
        offset=max(height, RADIUS) * UP,
        normal=UP,
        stiffness=SPRING,
        radius=RADIUS,
        blade_root=REST,
        blade_tip=REST,
    )


def stiffness_at(dynamics: Dynamics, place: np.ndarray) -> float:
    """Of tissue and spring in series under a place, by a static solution [N/m]."""
    nodes, weights = touched(dynamics.mesh, place)
    load = np.zeros_like(dynamics.mesh.rest)
    load[nodes, 2] = weights
    moved = solve_static(dynamics.model, dynamics.masses.inverse > 0, load)
    return 1 / (1 / SPRING + weights @ moved[nodes, 2])


@pytest.mark.parametrize('direction', [(1.0, 0.0), (0.0, 1.0), (-0.6, 0.8), (0.8, -0.6)])
def test_a_sliding_tool_is_told_the_stiffness_of_where_it_will_be(direction) -> None:
    dynamics = tissue()
    pressing = contact(dynamics.mesh, -0.004)
    spring, force, way = spring_of(dynamics, pressing), 0.1 * UP, 2e-3 * np.array([*direction, 0.0])
    told = ContactStiffness(dynamics, springs(dynamics))
    for _ in range(40):
        matrix = told.matrix(spring, pressing, way, force)
    here, ahead = stiffness_at(dynamics, AT), stiffness_at(dynamics, AT + 1.2 * way[:2])
    assert abs(ahead / here - 1) > 0.03
    assert np.trace(matrix) == pytest.approx(here, rel=1e-4)
    # F = k d, so along the way the force changes by d times the change of k.
    drop = -UP @ matrix @ (1.2 * way)
    assert drop == pytest.approx((ahead - here) * 0.1 / here, rel=1e-3)
    np.testing.assert_allclose(matrix @ np.cross(UP, way), 0.0, atol=1e-9)
    np.testing.assert_allclose(matrix[:2], 0.0, atol=1e-9)


@pytest.mark.parametrize('way', [REST, 0.003 * UP, np.array([4e-5, 0.0, 0.0])])
def test_a_tool_that_does_not_go_along_the_surface_is_told_of_no_change_along_it(way) -> None:
    dynamics = tissue()
    pressing = contact(dynamics.mesh, -0.004)
    matrix = ContactStiffness(dynamics, springs(dynamics)).matrix(
        spring_of(dynamics, pressing), pressing, way, 0.1 * UP
    )
    np.testing.assert_array_equal(matrix, matrix[2, 2] * np.outer(UP, UP))


@pytest.mark.parametrize('stiffness', [1.0, SPRING, 1e5])
def test_no_contact_however_forged_makes_it_much_stiffer_than_the_coupling(stiffness) -> None:
    dynamics = tissue()
    pressing = replace(contact(dynamics.mesh, -0.004), stiffness=stiffness)
    way = np.array([0.002, 0.0, 0.0])
    for force in (1e3, 1e6):  # a depth of metres, as no proxy has it
        matrix = ContactStiffness(dynamics, springs(dynamics)).matrix(
            spring_of(dynamics, pressing), pressing, way, force * UP
        )
        assert np.trace(matrix) <= stiffness
        assert matrix[2, 0] != 0
        assert np.abs(matrix).max() <= 4.001 * stiffness


@pytest.mark.long
@pytest.mark.parametrize('model', ['linear', 'linear_smoothed'])
def test_a_splinter_that_nothing_holds_has_a_stiffness_between_none_and_the_spring_s(model) -> None:
    nodes, tets = box((1, 1, 1), SIZE)
    mesh = TetMesh(nodes[tets[0]], np.arange(4)[None], np.zeros(4, bool))
    random = np.random.default_rng(0)
    for _ in range(10):
        dynamics = Dynamics(mesh, MATERIAL, model, None, None)
        told = ContactStiffness(dynamics, springs(dynamics))
        for _ in range(200):
            touched = random.choice(4, random.integers(1, 4), replace=False)
            normal = random.normal(size=3)
            spring = Coupling(
                mode=random.choice([PUSH, HOLD]),
                nodes=touched,
                weights=random.dirichlet(np.ones(len(touched))),
                normal=normal / np.linalg.norm(normal),
                stiffness=SPRING,
            )
            sizes = np.linalg.eigvalsh(told.matrix(spring, None, REST, REST))
            assert sizes.min() >= -1e-6 * SPRING and sizes.max() <= 1.001 * SPRING


def told_after(seconds: float, gap: float, speed: float) -> float:
    """Stiffness [N/m] that a free tool at a gap [m] is told after a while; 0: nothing."""
    dynamics = tissue()
    told, free = ContactStiffness(dynamics, springs(dynamics)), contact(dynamics.mesh, gap)
    for _ in range(round(seconds / FRAME)):
        matrix = told.matrix(Coupling(), free, speed * FRAME * UP, REST)
    return float(np.trace(matrix))


def test_a_free_tool_is_told_what_it_would_meet_if_it_can_be_there_before_it_is_told_more() -> None:
    far, soon = 0.05, 0.2
    assert told_after(0.2, far, 0.0) > 0  # roughly, once, from anywhere
    assert told_after(1.0, far, 0.0) == 0
    assert told_after(1.0, far, 0.05) == 0
    assert told_after(1.0, far, far / soon) == pytest.approx(stiffness_at(tissue(), AT), rel=1e-3)
    assert told_after(1.0, 0.005, 0.0) == pytest.approx(stiffness_at(tissue(), AT), rel=1e-3)


def test_nothing_is_foretold_of_another_connectivity_or_where_no_place_is_named() -> None:
    dynamics = tissue()
    told, free = ContactStiffness(dynamics, springs(dynamics)), contact(dynamics.mesh, 0.005)
    nowhere = replace(free, nodes=free.nodes[:0], weights=free.weights[:0])
    for other in (replace(free, topology=free.topology + 1), nowhere, None):
        assert not told.matrix(Coupling(), other, REST, REST).any()


def pressed_by(dynamics: Dynamics, depth: float) -> float:
    """Force [N] on a footprint at rest at a depth [m]."""
    spring = springs(dynamics, 'footprint').spring(contact(dynamics.mesh, -depth), 0.0, depth)
    load = np.zeros_like(dynamics.mesh.rest)
    load[spring.nodes, 2] = spring.weights
    moved = solve_static(dynamics.model, dynamics.masses.inverse > 0, load)
    soft = spring.weights @ moved[spring.nodes, 2]
    return replace(spring, stiffness=1 / (1 / SPRING + soft)).pushed(depth)


@pytest.mark.parametrize('depth', [5e-4, 2e-3, 4e-3])
@pytest.mark.parametrize('change', [1e-3, -4e-4])
def test_the_stiffness_told_leads_to_the_force_at_the_next_depth(depth, change) -> None:
    """Under a sphere it grows with depth: the tangent would be late by a frame."""
    dynamics = tissue()
    force = pressed_by(dynamics, depth)
    makes = springs(dynamics, 'footprint')
    spring = makes.spring(contact(dynamics.mesh, -depth), force, 0.0)
    told = ContactStiffness(dynamics, makes)
    for _ in range(40):
        matrix = told.matrix(spring, None, -change * UP, force * UP)
    after = force + np.trace(matrix) * change
    assert after == pytest.approx(pressed_by(dynamics, depth + change), rel=0.03)


def test_a_tool_that_slides_on_its_footprint_is_told_of_next_to_no_change() -> None:
    """By triangle the same slide changes the stiffness by several per cent."""
    dynamics = tissue()
    makes = springs(dynamics, 'footprint')
    pressing, way = contact(dynamics.mesh, -0.004), 2e-3 * np.array([1.0, 0.0, 0.0])
    force = pressed_by(dynamics, 0.004)
    told = ContactStiffness(dynamics, makes)
    for _ in range(40):
        matrix = told.matrix(makes.spring(pressing, force, 0.0), pressing, way, force * UP)
    assert abs(UP @ matrix @ (1.2 * way)) < 0.01 * force
