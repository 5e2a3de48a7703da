"""The degenerate situations of docs/cutting.md, one by one."""

from itertools import pairwise

import numpy as np
import pytest
from meshes import box, irregular_box
from strokes import draw, mesh_of, method_named, straight, total_area, total_cases

from cutting_trainer.cutting.combined import FOLDED
from cutting_trainer.cutting.cut_invariants import pieces
from cutting_trainer.cutting.geometry import smallest_altitudes
from cutting_trainer.cutting.lookup import EDGES, NODES
from cutting_trainer.cutting.method_interface import CASES
from cutting_trainer.cutting.subdivision_cases import NAMES, STATE
from cutting_trainer.tissue_sim.contact.blade import Sweep

pytestmark = pytest.mark.long

H = 0.005
DOWN = (0.0, 0.0, 0.03)
"""From the tip to the root of a blade that is held upright."""


def block(seed=0, cells=(4, 4, 3)):
    return mesh_of(*irregular_box(cells, H, seed))


def lattice(cells=(4, 4, 3)):
    return mesh_of(*box(cells, H))


def across(y, steps=8, depth=-0.005, slope=0.0):
    """Through a block of four cells along x, in the plane y = const (+ slope x)."""
    return straight(
        (-0.003, y - 0.003 * slope, depth), (0.023, y + 0.023 * slope, depth), DOWN, steps
    )


def count_pieces(mesh):
    return int(pieces(mesh).max()) + 1


def named(results):
    return dict(zip(CASES, total_cases(results).tolist(), strict=True))


@pytest.mark.parametrize('y', [0.01, 0.0101, 0.0125, 0.0099999])
def test_a_blade_through_nodes_edges_or_faces_parts_the_block(y):
    mesh = lattice()
    draw(method_named(), mesh, across(y))
    assert count_pieces(mesh) == 2


def test_a_cut_along_existing_faces_makes_no_new_tetrahedra():
    mesh = lattice()
    before = len(mesh.tetrahedra)
    found = named(draw(method_named(), mesh, across(0.01)))
    assert len(mesh.tetrahedra) == before
    assert found == dict.fromkeys(CASES, 0) | {'separated': 24}


def test_a_cut_along_a_diagonal_plane_of_the_lattice_parts_the_block():
    mesh = lattice((3, 3, 3))
    path = straight((-0.003, -0.003, -0.003), (0.018, 0.018, -0.003), DOWN, 7)
    draw(method_named(), mesh, path)
    assert count_pieces(mesh) == 2


@pytest.mark.parametrize('seed', range(4))
def test_elements_with_all_nodes_on_the_cut_take_the_side_of_their_middle(seed):
    mesh = block(seed)
    draw(method_named(tau=0.49), mesh, across(0.0107, slope=0.2))
    assert count_pieces(mesh) == 2


def test_a_face_cut_within_its_border_stays_closed_and_valid():
    mesh = lattice()
    before = len(mesh.tetrahedra)
    middle = np.array([0.0065, 0.01, 0.0085])
    aside = np.array([0.0002, 0, 0])
    path = straight(middle - aside, middle + aside, (0, 0, 0.0002), 2)
    assert total_area(draw(method_named(), mesh, path)) == 0.0
    assert len(mesh.tetrahedra) == before


def test_the_front_has_one_node_for_each_face_that_it_ends_in():
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * H
    mesh = mesh_of(nodes, np.array([[0, 1, 2, 3]]))
    path = straight((0.5 * H, -0.5 * H, 0.2 * H), (0.5 * H, 0.02 * H, 0.2 * H), (0, 0, -H), 3)
    assert named(draw(method_named(), mesh, path))['C'] == 1
    assert mesh.node_count == 4 + 2 + 2
    assert len(mesh.tetrahedra) == 6


@pytest.mark.parametrize('seed', range(6))
def test_a_stroke_that_begins_at_an_old_front_leaves_no_bridge(seed):
    mesh = block(seed)
    method = method_named()
    path = across(0.0107, steps=12)
    draw(method, mesh, path[:7])
    assert count_pieces(mesh) == 1
    draw(method, mesh, path[6:])
    assert count_pieces(mesh) == 2


@pytest.mark.parametrize('seed', range(3))
def test_cutting_the_pieces_again_and_again_keeps_the_altitude_floor(seed):
    mesh = block(seed)
    floor = 0.02 * np.median(smallest_altitudes(mesh.rest, mesh.tetrahedra))
    rng = np.random.default_rng(seed)
    method = method_named()
    for _ in range(8):
        draw(method, mesh, across(rng.uniform(0.008, 0.012), slope=rng.uniform(-0.3, 0.3), steps=4))
    assert smallest_altitudes(mesh.rest, mesh.tetrahedra).min() > floor


@pytest.mark.parametrize('seed', range(4))
def test_two_strokes_that_cross_make_four_pieces(seed):
    mesh = block(seed)
    method = method_named()
    draw(method, mesh, across(0.0107))
    draw(method, mesh, straight((0.0093, -0.003, -0.005), (0.0088, 0.023, -0.005), DOWN, 8))
    assert count_pieces(mesh) == 4


@pytest.mark.parametrize('seed', range(4))
def test_a_blade_that_goes_back_and_forth_in_its_cut_cuts_nothing_more(seed):
    once, thrice = block(seed), block(seed)
    path = across(0.0107, steps=10)
    area = total_area(draw(method_named(), once, path))
    back = np.concatenate([path[:8], path[6:3:-1], path[5:]])
    assert total_area(draw(method_named(), thrice, back)) == pytest.approx(area, rel=0.02)
    # A node that the blade leaves before it is reached takes a side: its edges are cut.
    assert len(thrice.tetrahedra) <= 1.1 * len(once.tetrahedra)


def test_trembling_within_the_cut_cuts_nothing_twice():
    rng = np.random.default_rng(0)
    mesh, still = block(), block()
    path = across(0.0107, steps=40)
    area = total_area(draw(method_named(), still, path))
    shaky = path + 0.02 * H * rng.normal(size=path.shape) * np.array([0, 1, 0])
    results = draw(method_named(), mesh, shaky)
    assert count_pieces(mesh) == 2
    assert total_area(results) < 1.03 * area
    assert not any(FOLDED in result.report.warnings for result in results)


@pytest.mark.parametrize('steps', [5, 7, 9])
def test_a_blade_that_stops_inside_leaves_a_valid_partial_cut(steps):
    mesh = block()
    method = method_named()
    results = draw(method, mesh, across(0.0107, steps=12, depth=0.006)[: steps + 1])
    assert count_pieces(mesh) == 1
    assert total_area(results) > 0.0
    assert method._tables.counts.tolist() == [0, 0, 0]


def test_tables_are_empty_and_leave_no_trace_after_a_stroke():
    mesh = block()
    method = method_named()
    draw(method, mesh, across(0.0107))
    tables = method._tables
    assert tables.counts[NODES] == tables.counts[EDGES] == 0
    assert (tables.hash_key == -1).all() and (tables.node_row == -1).all()
    assert (tables.owner == -1).all() and (tables.origin == -1).all()


def test_small_steps_add_up_to_the_cut_of_one_large_step():
    small, large = block(), block()
    draw(method_named(), small, across(0.0107, steps=400))
    draw(method_named(), large, across(0.0107, steps=1))
    assert count_pieces(small) == count_pieces(large) == 2
    assert len(small.tetrahedra) == len(large.tetrahedra)


@pytest.mark.parametrize('seed', range(4))
def test_a_blade_faster_than_the_elements_misses_none(seed):
    mesh = block(seed)
    draw(method_named(), mesh, across(0.0107, steps=1))
    assert count_pieces(mesh) == 2


def test_gaps_between_sweeps_of_a_hair_leave_no_bridge():
    mesh = block()
    method = method_named()
    path = across(0.0107, steps=20)
    for before, after in pairwise(path):
        start = before + np.array([1e-5, 0, 0])
        result = method.advance(mesh, mesh.rest, Sweep(start[0], start[1], after[0], after[1]))
        if not result.delta.empty:
            mesh.apply(result.delta)
    result = method.finish(mesh, mesh.rest)
    if not result.delta.empty:
        mesh.apply(result.delta)
    assert count_pieces(mesh) == 2


def test_a_strip_narrower_than_an_element_is_a_star():
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * H
    mesh = mesh_of(nodes, np.array([[0, 1, 2, 3]]))
    # Crosses the edges 01 and 23 in their middle, and neither 02 nor 13, which its plane parts too.
    first, second = np.array([0.5, 0, 0]) * H, np.array([0, 0.5, 0.5]) * H
    along = (second - first) / np.linalg.norm(second - first)
    edge = np.cross(along, [1, 1.2, -0.2])
    edge *= 0.05 * H / np.linalg.norm(edge)
    path = straight(first - 0.2 * H * along - edge, second + 0.2 * H * along - edge, 2 * edge, 4)
    found = named(draw(method_named(), mesh, path))
    assert found['star'] == 1
    assert len(mesh.tetrahedra) == 16


def test_an_unknown_state_is_none_of_the_tables():
    three_edges_of_a_face = 1 << 0 | 1 << 1 | 1 << 3
    assert STATE[three_edges_of_a_face, 0] == -1
    assert set(NAMES) == {'A', 'B', 'C', 'D', 'E', 'F', 'G', 'H', 'star'}


def test_a_corner_cut_free_is_reported():
    mesh = block()
    normal = np.ones(3) / 3**0.5
    along, edge = np.array([1, -1, 0]) / 2**0.5, np.array([1, 1, -2]) / 6**0.5
    middle = 0.0025 * normal
    path = straight(
        middle - 0.02 * along - 0.02 * edge, middle + 0.02 * along - 0.02 * edge, 0.04 * edge, 6
    )
    results = draw(method_named(), mesh, path)
    assert count_pieces(mesh) == 2
    assert any('has come free' in text for r in results for text in r.report.warnings)


def test_copies_of_fixed_nodes_are_fixed_and_fixed_nodes_stay():
    nodes, tets = irregular_box((4, 4, 3), H, 0)
    fixed = nodes[:, 2] < 1e-9
    mesh = mesh_of(nodes, tets, fixed)
    draw(method_named(), mesh, across(0.0107))
    low = mesh.rest[:, 2] < 1e-9
    assert (mesh.fixed[low] == 1).all() and (mesh.fixed[~low] == 0).all()
    assert all((mesh.rest == node).all(axis=1).any() for node in nodes[fixed])


def test_a_blade_that_folds_back_on_its_cut_goes_on_with_a_new_stroke():
    mesh = block(cells=(4, 4, 3))
    path = across(0.0057, steps=8, depth=0.003)[:6]
    aside = path[::-1] + np.array([0, 0.005, 0])
    results = draw(method_named(), mesh, np.concatenate([path, aside]))
    assert total_area(results) > 0.0


def test_an_aborted_stroke_leaves_what_was_done_and_nothing_else():
    mesh = block()
    method = method_named()
    draw(method, mesh, across(0.0107)[:5], finish=False)
    method.abort()
    draw(method, mesh, across(0.0107))
    assert count_pieces(mesh) == 2


def test_a_mesh_that_changed_within_a_stroke_begins_it_anew():
    mesh = block()
    method = method_named()
    draw(method, mesh, across(0.0107)[:5], finish=False)
    other = block(seed=1, cells=(4, 4, 4))
    results = draw(method, other, across(0.0107)[4:])
    assert 'changed' in results[0].report.warnings[0]
