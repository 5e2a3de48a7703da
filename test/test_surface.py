"""Claims about the snapshot of the surface, its broad phase and the projection onto half-spaces."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import distances, grid

from cutting_trainer.haptic_bridge.proxy import half_spaces
from cutting_trainer.haptic_bridge.proxy.neighbourhood import CAPACITY, NEAR, gather
from cutting_trainer.haptic_bridge.proxy.surface import Surface


def bumpy(points=20, seed=0):
    rng = np.random.default_rng(seed)
    return grid(points, lambda x, y: rng.normal(0, 0.002, x.shape))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000), st.floats(0, 1), st.sampled_from([1, 8, CAPACITY]))
def test_nearest_triangles_are_those_of_brute_force_at_any_blend(seed, blend, most):
    rng = np.random.default_rng(seed)
    positions, triangles = bumpy(seed=seed)
    before = Surface(positions, triangles, revision=0, topology=0)
    moved = positions + rng.normal(0, 0.005, positions.shape)
    surface = Surface(moved, triangles, revision=1, topology=0, previous=before)
    near = np.zeros(1, NEAR)
    point = rng.uniform(-0.06, 0.06, 3)
    gather(surface.geometry, blend, point, 0.03, most, near)
    blended = positions + blend * (moved - positions)
    every = sorted(distances(blended, triangles, point))
    expected = [d for d in every if d < 0.03][:most]
    w = near[0]
    assert w['count'] == len(expected)
    np.testing.assert_allclose(w['distance'][w['order'][: w['count']]], expected, atol=1e-12)
    left_out = every[len(expected) :]
    assert not left_out or left_out[0] >= w['reach'] - 1e-12


def test_surface_starts_where_the_one_before_ends_only_with_the_same_triangles():
    positions, triangles = bumpy()
    first = Surface(positions, triangles, revision=1, topology=1)
    raised = positions + np.array([0, 0, 0.003])
    second = Surface(raised, triangles, revision=2, topology=1, previous=first)
    assert second.continues(first)
    assert second.motion == pytest.approx(0.003)
    np.testing.assert_array_equal(second.geometry.start, positions)
    for topology, faces in ((2, triangles), (1, triangles[::-1]), (1, triangles[:-1])):
        other = Surface(raised, faces, revision=2, topology=topology, previous=first)
        assert not other.continues(first)
        assert other.motion == 0
        np.testing.assert_array_equal(other.geometry.start, raised)


def test_surface_neither_shares_nor_lets_change_its_arrays():
    positions, triangles = bumpy()
    surface = Surface(positions, triangles, revision=0, topology=0)
    positions[:] = 0
    assert surface.geometry.end.any()
    with pytest.raises(ValueError, match='read-only'):
        surface.geometry.end[0] = 0


def test_useless_arrays_are_refused_by_name():
    positions, triangles = bumpy()
    with pytest.raises(ValueError, match='nodes go from 0 to 399'):
        Surface(positions, triangles + 1, revision=3, topology=0)
    positions[7] = np.nan
    with pytest.raises(ValueError, match=r'revision 3: node 7 .* not finite'):
        Surface(positions, triangles, revision=3, topology=0)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 12))
def test_projection_is_the_closest_of_all_points_that_planes_can_define(seed, count):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    bounds = -rng.uniform(0, 1, count)
    goal = rng.normal(size=3) * 3
    spaces = np.zeros(1, half_spaces.SPACES)
    half_spaces.begin(spaces, goal)
    for n, b in zip(normals, bounds, strict=True):
        half_spaces.add(spaces, *n, b)
    best = np.inf
    for size in range(4):
        for chosen in itertools.combinations(range(count), size):
            n, b = normals[list(chosen)], bounds[list(chosen)]
            y = goal + np.linalg.pinv(n) @ (b - n @ goal) if size else goal
            if (normals @ y >= bounds - 1e-9).all():
                best = min(best, np.linalg.norm(y - goal))
    y = spaces['optimum'][0]
    assert spaces['feasible'][0]
    assert (normals @ y >= bounds - 1e-9).all()
    assert np.linalg.norm(y - goal) == pytest.approx(best, abs=1e-7)


def test_contradicting_planes_share_the_violation_and_leave_the_way_along_them():
    spaces = np.zeros(1, half_spaces.SPACES)
    half_spaces.begin(spaces, np.array([0.3, 0.2, 5.0]))
    half_spaces.add(spaces, 1.0, 0.0, 0.0, 1.0)
    half_spaces.add(spaces, -1.0, 0.0, 0.0, 1.0)
    assert not spaces['feasible'][0]
    half_spaces.compromise(spaces)
    np.testing.assert_allclose(spaces['optimum'][0], [0, 0.2, 5], atol=1e-8)
