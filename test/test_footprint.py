"""The load of a tool goes to its footprint: exact integrals, Hertz's law, no trace of the mesh."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box
from scipy.integrate import quad
from scipy.special import jv

from bench.accuracy.footprint import BLOCK, MATERIAL, Press, block
from bench.accuracy.sphere_contact import Layer, SphereOnLayer, sneddon, thickness_factor
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.contact.footprint import SETTLEMENT, WIDENING, Footprints
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.contact.tool_spring import SPHERE
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

SIZE = 0.004
COARSE, MIDDLE, FINE = (8, 8, 3), (14, 14, 6), (20, 20, 8)
MODULUS, RADIUS = 7000.0, 0.004


def slab(cells=(12, 12, 4)) -> TetMesh:
    nodes, tets = box(cells, SIZE)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


def touched(mesh: TetMesh, place: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    top = mesh.rest[:, 2].max()
    for nodes in mesh.triangles[(mesh.rest[mesh.triangles][:, :, 2] > top - 1e-9).all(axis=1)]:
        weights = np.linalg.solve(np.vstack([mesh.rest[nodes][:, :2].T, np.ones(3)]), [*place, 1.0])
        if (weights >= -1e-9).all():
            return nodes.astype(np.int64), np.maximum(weights, 0.0)
    raise AssertionError(f'nothing lies under {place}')


def spring(**changes: float) -> Coupling:
    hertz = (9 / (16 * MODULUS**2 * RADIUS)) ** (1 / 3)
    return replace(Coupling(mode=PUSH, stiffness=200.0, hertz=hertz), **changes)


def test_the_settlement_under_the_smooth_pressure_is_the_integral_of_its_hankel_transform() -> None:
    def squared(k: float) -> float:
        return float((6 * 8 * jv(3, k) / k**3) ** 2)

    assert quad(squared, 1e-9, 400, limit=2000)[0] / np.pi == pytest.approx(SETTLEMENT, rel=1e-6)


@pytest.mark.parametrize('place', [(0.024, 0.024), (0.0213, 0.0262), (0.0251, 0.0227)])
def test_a_footprint_has_the_moments_of_its_pressure(place: tuple[float, float]) -> None:
    mesh, radius = slab(), 0.007
    found = Footprints(mesh).around(*touched(mesh, place), radius)
    assert found.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert (found.weights > 0).all() and (np.diff(found.nodes) > 0).all()
    away = mesh.rest[found.nodes] - [*place, 4 * SIZE]
    np.testing.assert_allclose(found.weights @ away, 0.0, atol=0.01 * radius)
    assert found.radius == pytest.approx(radius, rel=0.02)
    assert abs(found.height) < 1e-12
    # Linear interpolation in right triangles adds a third of the square of their sides.
    exact = radius**2 / 4 + SIZE**2 / 3
    assert found.weights @ (away**2).sum(axis=1) == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize('place', [(6.5 * SIZE, 6 * SIZE), (6 * SIZE, 6 * SIZE)])
def test_on_an_edge_or_a_corner_of_a_triangle_the_load_is_spread_as_beside_it(place) -> None:
    mesh = slab()
    nodes, weights = touched(mesh, place)
    on = weights > 1e-9
    assert on.sum() < 3
    there = Footprints(mesh).around(nodes[on], weights[on], 0.007)
    beside = Footprints(mesh).around(*touched(mesh, (place[0] + 1e-6, place[1] + 1e-7)), 0.007)
    np.testing.assert_array_equal(there.nodes, beside.nodes)
    np.testing.assert_allclose(there.weights, beside.weights, atol=1e-3)
    assert there.radius == pytest.approx(beside.radius, rel=1e-3)


def test_a_load_at_an_edge_stays_on_the_touched_side() -> None:
    mesh = slab()
    found = Footprints(mesh).around(*touched(mesh, (0.002, 0.024)), 0.007)
    assert (mesh.rest[found.nodes][:, 2] > 4 * SIZE - 1e-9).all()
    assert 0.7 * 0.007 < found.radius < 0.95 * 0.007


def test_a_load_does_not_jump_over_a_gap_to_another_piece() -> None:
    nodes, tets = box((6, 6, 3), SIZE)
    beside = nodes + np.array([6 * SIZE + 1e-4, 0, 0])
    mesh = TetMesh(np.vstack([nodes, beside]), np.vstack([tets, tets + len(nodes)]))
    found = Footprints(mesh).around(*touched(mesh, (6 * SIZE - 0.001, 0.012)), 0.007)
    assert (found.nodes < len(nodes)).all()


def test_nodes_that_do_not_move_carry_nothing() -> None:
    nodes, tets = box((6, 6, 3), SIZE)
    mesh = TetMesh(nodes, tets, nodes[:, 0] < 0.3 * SIZE)
    found = Footprints(mesh).around(*touched(mesh, (0.003, 0.012)), 0.006)
    assert (mesh.fixed[found.nodes] == 0).all()
    assert found.weights.sum() == pytest.approx(1.0)


def test_the_work_space_of_a_footprint_is_used_again_and_leaves_no_trace() -> None:
    mesh = slab()
    footprints = Footprints(mesh)
    footprints.around(*touched(mesh, (0.010, 0.031)), 0.008)
    work = footprints._work()
    found = footprints.around(*touched(mesh, (0.024, 0.024)), 0.007)
    fresh = Footprints(mesh).around(*touched(mesh, (0.024, 0.024)), 0.007)
    assert footprints._work() is work
    assert not work.known.any() and not work.share.any()
    np.testing.assert_array_equal(found.nodes, fresh.nodes)
    np.testing.assert_array_equal(found.weights, fresh.weights)


def test_the_constants_of_a_spring_are_computed_once() -> None:
    law = spring(seen=0.004)
    assert law.scalars is law.scalars
    softer = replace(law, stiffness=50.0)
    assert softer.scalars[0] == 50.0


def test_new_nodes_have_the_size_of_the_elements_that_were_there() -> None:
    """Slivers beside a cut do not make the disc smaller than the elements around resolve."""
    mesh = slab((4, 4, 2))
    footprints, n = Footprints(mesh), mesh.node_count
    parents = mesh.tetrahedra[7].astype(np.int64)
    children = np.tile(parents, (4, 1))
    children[range(4), range(4)] = n
    delta = TopologyDelta(
        node_parents=parents[None],
        node_weights=np.full((1, 4), 0.25),
        removed_tetrahedra=np.array([7], np.int64),
        tetrahedra=children,
        outer_faces=np.array([1, 2, 4, 8], np.uint8),
    )
    before = footprints.radius(parents, np.full(4, 0.25), 0.0)
    footprints.apply_cut(n, delta, mesh.apply(delta))
    assert footprints.radius(np.array([n]), np.ones(1), 0.0) == pytest.approx(before)


def test_alone_the_law_is_that_of_hertz_and_of_a_cylinder_as_wide_as_the_tool() -> None:
    stiff = spring(stiffness=1e12, most=4 / 3 * MODULUS * RADIUS**2)
    for depth in (1e-5, 1e-3, 3e-3):
        assert stiff.pushed(depth) == pytest.approx(
            4 / 3 * MODULUS * np.sqrt(RADIUS) * depth**1.5, rel=1e-6
        )
    slope = (stiff.pushed(0.0061) - stiff.pushed(0.0060)) / 1e-4
    assert slope == pytest.approx(2 * MODULUS * RADIUS, rel=1e-6)


@pytest.mark.parametrize('seen', [0.0, 0.004, 0.02, 0.05])
def test_the_law_is_smooth_and_never_stiffer_than_the_coupling_spring(seen: float) -> None:
    law = spring(seen=seen, bend=SPHERE / RADIUS * spring().hertz, most=0.15)
    stretches = np.linspace(0.0, 0.02, 4001)
    forces = np.array([law.pushed(stretch) for stretch in stretches])
    slopes = np.diff(forces) / np.diff(stretches)
    assert slopes.min() > 0 and slopes.max() <= 200.0 * (1 + 1e-9)
    if np.isfinite(law.scalars[5]):
        corner = law.scalars[6]
        steps = np.diff([law.pushed(corner + d) for d in (-1e-9, 0.0, 1e-9)])
        assert steps[1] == pytest.approx(steps[0], rel=1e-3)
    back = [law.stretch_at(force) for force in forces]
    np.testing.assert_allclose(back, stretches, atol=1e-9)


def test_a_disc_wider_than_hertz_by_the_widening_leaves_the_spring_its_own_stiffness() -> None:
    """Else the explicit step would not be stable: the rest would be stiffer than the spring."""
    assert WIDENING >= 2 * SETTLEMENT


@pytest.mark.parametrize('radius', [0.004, 0.008])
def test_a_press_feels_the_same_whatever_the_elements(radius: float) -> None:
    place, depths = (0.052, 0.049), [0.001, 0.002, 0.003]
    forces = np.array(
        [Press(block(cells)).forces(place, radius, depths) for cells in (COARSE, MIDDLE, FINE)]
    )
    assert (forces.max(axis=0) / forces.min(axis=0)).max() < 1.05
    by_triangle = [
        Press(block(cells), 'triangle').forces(place, radius, depths)[0] for cells in (COARSE, FINE)
    ]
    assert max(by_triangle) / min(by_triangle) > 1.2


@pytest.mark.parametrize('radius', [0.004, 0.008])
def test_a_press_of_a_millimetre_is_that_of_sneddon_on_a_layer(radius: float) -> None:
    layer = Layer(BLOCK[2], 0.0564, MATERIAL.youngs_modulus, MATERIAL.poissons_ratio)
    exact = sneddon(layer, radius, 0.001) * thickness_factor(layer, radius, 0.001)
    found = Press(block(MIDDLE)).forces((0.052, 0.049), radius, [0.001])[0]
    assert found == pytest.approx(exact, rel=0.07)


@pytest.mark.long
def test_a_deep_press_is_that_of_quadratic_neo_hookean_elements() -> None:
    layer = Layer(BLOCK[2], 0.0564, MATERIAL.youngs_modulus, MATERIAL.poissons_ratio)
    reference = SphereOnLayer(layer, 0.008, 0.0016, large=True)
    exact = [reference.force(depth) for depth in (0.001, 0.002, 0.003)][-1]
    found = Press(block(MIDDLE)).forces((0.052, 0.049), 0.008, [0.003])[0]
    assert found == pytest.approx(exact, rel=0.07)


def test_a_sliding_tool_feels_a_flat_slab() -> None:
    press = Press(block(MIDDLE))
    places = np.random.default_rng(5).uniform(0.035, 0.065, (10, 2))
    forces = [press.forces(place, 0.004, [0.003], 200.0)[0] for place in places]
    assert max(forces) / min(forces) < 1.05


def test_a_tool_that_rests_in_a_trembling_hand_keeps_its_footprint() -> None:
    """The footprint is a frame late: if it followed each change, it would keep a tremble alive."""
    nodes, tets = box((10, 10, 4), 0.003)
    mesh, radius, up = TetMesh(nodes, tets, nodes[:, 2] < 1e-9), 0.01, np.array([0.0, 0.0, 1.0])
    simulation = TissueSimulation(
        mesh, Material(5400.0, 0.45, 1060.0, 10.0, 0.0), Resistance(100.0, 200.0, 20.0)
    )
    place, shift, reaches = np.array([0.0155, 0.0145, 0.012]), radius * up, []
    pressed = indenter_contact(mesh, place, -up, 0.0)
    for frame in range(80):
        depth = 0.004 * min(frame / 10, 1.0) + 2e-5 * (-1) ** frame
        tip = pressed.device - depth * up
        contact = replace(pressed, device=tip + shift, offset=shift, radius=radius)
        simulation.frame(contact)
        reaches.append(simulation.tools[0]._pushed_by(contact, simulation.positions).reach)
    assert len(set(reaches[:10])) > 5
    assert len(set(reaches[-30:])) == 1
