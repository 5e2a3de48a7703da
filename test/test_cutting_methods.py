"""What the methods of cutting are good for, and how each fails."""

import numpy as np
import pytest
from meshes import box, irregular_box
from strokes import draw, mesh_of, method_named, straight, total_area

from cutting_trainer.cutting.cut_invariants import pieces
from cutting_trainer.cutting.geometry import smallest_altitudes
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import interpolated

H = 0.005
TISSUE = Material(5000.0, 0.45, 1050.0)
NORMAL = np.cross([0.0, 0.2, 1.0], [1.0, 0.15, 0.0])
NORMAL /= np.linalg.norm(NORMAL)
POINT = np.array([0.0, 0.0093, 0.0])


def block(seed):
    return mesh_of(*irregular_box((6, 4, 3), H, seed))


def path(steps=24):
    begin, end = np.array([-0.002, 0, -0.003]), np.array([0.032, 0, -0.003])
    for point in (begin, end):
        point[1] = POINT[1] + 0.15 * point[0] + 0.2 * point[2]
    return straight(begin, end, (0.0, 0.2 * 0.025, 0.025), steps)


def distances(mesh):
    """Of the nodes of the cut from the blade's plane, in units of the element size."""
    on_lips = np.unique(mesh.triangles[mesh.triangle_kind == 1])
    return np.abs((mesh.rest[on_lips] - POINT) @ NORMAL) / H


@pytest.mark.parametrize('seed', range(5))
def test_combined_parts_a_block_in_the_plane_of_the_blade(seed):
    mesh = block(seed)
    volume = mesh.volumes().sum()
    area = total_area(draw(method_named(), mesh, path()))
    assert int(pieces(mesh).max()) == 1
    assert np.sqrt(np.square(distances(mesh)).mean()) < 0.01
    assert abs(mesh.volumes().sum() / volume - 1) < 1e-12
    lip = mesh.rest[mesh.triangles[mesh.triangle_kind == 1]]
    twice = np.linalg.norm(np.cross(lip[:, 1] - lip[:, 0], lip[:, 2] - lip[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(twice / 2, rel=1e-9)


@pytest.mark.parametrize('seed', range(3))
def test_midpoints_leave_the_surface_jagged_and_every_child_well_shaped(seed):
    mesh = block(seed)
    before = np.median(smallest_altitudes(mesh.rest, mesh.tetrahedra))
    draw(method_named('combined_midpoint'), mesh, path())
    assert int(pieces(mesh).max()) == 1
    assert 0.05 < np.sqrt(np.square(distances(mesh)).mean()) < 0.25
    assert smallest_altitudes(mesh.rest, mesh.tetrahedra).min() > 0.1 * before


def test_subdivision_alone_is_exact_and_makes_slivers():
    combined, subdivided = block(0), block(0)
    draw(method_named(), combined, path())
    draw(method_named('subdivide'), subdivided, path())
    assert distances(subdivided).max() < 0.01
    assert len(subdivided.tetrahedra) > 1.3 * len(combined.tetrahedra)
    worst = [smallest_altitudes(m.rest, m.tetrahedra).min() for m in (subdivided, combined)]
    assert worst[0] < 0.1 * worst[1]


def test_separation_alone_makes_no_elements_and_a_jagged_cut():
    mesh = block(0)
    before = len(mesh.tetrahedra)
    draw(method_named('separate'), mesh, path())
    assert len(mesh.tetrahedra) == before
    assert int(pieces(mesh).max()) == 1
    assert np.sqrt(np.square(distances(mesh)).mean()) > 0.15


@pytest.mark.long
def test_deletion_loses_mass_and_leaves_a_gap():
    mesh = block(0)
    volume = mesh.volumes().sum()
    results = draw(method_named('delete'), mesh, path())
    lost = sum(result.report.removed_volume for result in results)
    assert lost > 0.05 * volume
    # It reports no area: else a stroke that was applied would seem to have cut nothing.
    assert total_area(results) == 0.0
    assert f'removed {1e6 * lost:.2f} cm^3' in results[-1].report.warnings[0]
    assert mesh.volumes().sum() == pytest.approx(volume - lost, rel=1e-12)
    assert distances(mesh).max() > 0.5


def test_a_cut_that_the_tissue_moves_under_lies_where_the_blade_went():
    mesh = block(0)

    def sheared(mesh):
        return mesh.rest + 0.1 * mesh.rest[:, [2, 0, 1]]

    bent = path() + 0.1 * path()[..., [2, 0, 1]]
    draw(method_named(), mesh, bent, positions=sheared)
    assert np.sqrt(np.square(distances(mesh)).mean()) < 0.01


@pytest.mark.parametrize('name', ['combined', 'combined_midpoint', 'subdivide', 'separate'])
def test_tensors_and_masses_follow_a_cut_as_if_rebuilt(name):
    mesh = mesh_of(*irregular_box((3, 3, 2), H, 0))
    model = ElasticModel(mesh, TISSUE)
    method = method_named(name)
    applied = mesh.apply
    mesh.apply = lambda delta: model.update(applied(delta))  # type: ignore[method-assign]
    draw(method, mesh, path(10))
    fresh = ElasticModel(mesh, TISSUE)
    assert np.abs(model.dense() - fresh.dense()).max() < 1e-12 * np.abs(fresh.dense()).max()
    assert np.allclose(model.mass, fresh.mass, rtol=1e-12)


def test_a_cut_gives_the_tissue_no_kick():
    mesh = block(0)
    rng = np.random.default_rng(0)
    velocity = rng.normal(size=(mesh.node_count, 3))
    method = method_named('combined_midpoint')
    momentum = ElasticModel(mesh, TISSUE).mass @ velocity
    applied = mesh.apply

    def follow(delta):
        nonlocal velocity
        new = interpolated(velocity, delta.node_parents, delta.node_weights)
        velocity = np.concatenate([velocity, new])
        for target, source in applied(delta).renumbered:
            velocity[target] = velocity[source]
        velocity = velocity[: mesh.node_count]

    mesh.apply = follow  # type: ignore[method-assign]
    draw(method, mesh, path())
    after = ElasticModel(mesh, TISSUE).mass @ velocity
    assert np.abs(after - momentum).max() < 1e-12 * np.abs(velocity).max()


def test_the_outer_shape_of_a_block_is_kept():
    mesh = block(1)
    draw(method_named(), mesh, path())
    outer = mesh.rest[mesh.triangles[mesh.triangle_kind == 0]]
    walls = [(axis, at) for axis, top in enumerate((0.03, 0.02, 0.015)) for at in (0.0, top)]
    flat = np.any(
        [(np.abs(outer[..., axis] - at) < 1e-15).all(axis=1) for axis, at in walls], axis=0
    )
    assert flat.all()


def test_a_stroke_does_the_same_in_a_larger_mesh():
    small, large = mesh_of(*box((6, 4, 3), H)), mesh_of(*box((6, 14, 3), H))
    found = [
        sum(r.report.cases for r in draw(method_named(), mesh, path())) for mesh in (small, large)
    ]
    assert (found[0] == found[1]).all()


def test_the_default_method_is_the_best_one():
    assert CuttingSettings().method == 'combined'
