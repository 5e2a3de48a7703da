"""Claims about the proxy: what it feels on planes, edges, creases, sheets, and when they move."""

import numpy as np
import pytest
import trimesh
from pairs import thinned
from surfaces import distance, grid, joined, slab

from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface

R = 0.004
UP = np.array([0, 0, 1])
SHEET = slab(0.08, -0.002, 0.0)


def snapshot(mesh, revision=0, topology=0, previous=None):
    return Surface(*mesh, revision=revision, topology=topology, previous=previous)


def moved(mesh, offset):
    return mesh[0] + offset, mesh[1]


def lowered(surface, proxy, device, height=0.02, ticks=50):
    """Brings the device straight down to a place from above."""
    for above in np.linspace(height, 0, ticks):
        touch = proxy.step(surface, 1.0, np.array(device) + above * UP)
    return touch


def test_free_proxy_is_where_the_device_is():
    surface, proxy = snapshot(grid(10)), Proxy(R)
    for device in np.random.default_rng(0).uniform([-0.1, -0.1, R], [0.1, 0.1, 0.1], (50, 3)):
        for _ in range(20):
            touch = proxy.step(surface, 1.0, device)
        np.testing.assert_array_equal(touch.position, device)
        assert not touch.touching
        assert touch.depth == 0


def test_pressing_a_plane_gives_depth_direction_and_place_exactly():
    mesh = grid(10)
    surface, proxy = snapshot(mesh), Proxy(R)
    for depth in (1e-6, 1e-3, 5e-3):
        touch = lowered(surface, proxy, (0.011, -0.007, R - depth))
        assert touch.touching
        assert touch.depth == pytest.approx(depth, abs=1e-12)
        np.testing.assert_allclose(touch.normal, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(touch.contact, [0.011, -0.007, 0], atol=1e-12)
        np.testing.assert_allclose(touch.weights @ mesh[0][touch.nodes], touch.contact, atol=1e-12)
        assert touch.weights.sum() == pytest.approx(1)
        assert touch.weights.min() >= 0


@pytest.mark.parametrize('points', [2, 11, 80])
def test_sliding_on_a_plane_has_no_lag_however_it_is_meshed(points):
    surface, proxy = snapshot(grid(points)), Proxy(R)
    lowered(surface, proxy, (-0.04, -0.03, 0.0))
    for s in np.linspace(0, 1, 400):
        device = np.array([-0.04 + 0.08 * s, -0.03 + 0.05 * s, 0.0])
        touch = proxy.step(surface, 1.0, device)
        np.testing.assert_allclose(touch.position, device + R * UP, atol=1e-9)


def test_sphere_rolls_over_an_edge_without_a_flip_and_comes_off():
    surface, proxy = snapshot(slab(0.04, -0.04, 0.0)), Proxy(R)
    edge, height = 0.02, 0.001
    normal = lowered(surface, proxy, (0.015, 0.001, height)).normal.copy()
    last = 0.0
    for x in np.arange(0.015, edge + R + 1e-3, 5e-5):
        touch = proxy.step(surface, 1.0, np.array([x, 0.001, height]))
        if not touch.touching:
            break
        turned = np.arccos(np.clip(normal @ touch.normal, -1, 1))
        assert turned < 0.08
        angle = np.arctan2(touch.normal[0], touch.normal[2])
        assert angle > last - 1e-6
        normal, last = touch.normal.copy(), angle
    assert np.hypot(x - edge, height) == pytest.approx(R, abs=1e-4)
    np.testing.assert_array_equal(touch.position, [x, 0.001, height])


def test_sphere_slides_around_a_corner_and_stays_out():
    mesh = slab(0.04, -0.04, 0.0)
    surface, proxy = snapshot(mesh), Proxy(R)
    for s in np.linspace(0, 1, 500):
        device = np.array([0.014 + 0.008 * s, 0.013 + 0.009 * s, -0.001 - 0.002 * s])
        touch = proxy.step(surface, 1.0, device if s else device + 0.02 * UP)
        assert distance(*mesh, touch.position) >= R - 1e-9


def test_crease_holds_the_sphere_at_both_sides():
    mesh = grid(21, lambda x, y: np.abs(x))
    surface, proxy = snapshot(mesh), Proxy(R)
    for y in np.linspace(-0.03, 0.03, 100):
        touch = proxy.step(surface, 1.0, np.array([0.002, y, 0.001 if y > -0.03 else 0.03]))
    np.testing.assert_allclose(touch.position, [0, 0.03, R * np.sqrt(2)], atol=1e-7)
    assert distance(*mesh, touch.position) >= R - 1e-9


def lips(gap):
    left, right = (slab(0.03, -0.02, 0.0) for _ in range(2))
    shift = [0.015 + gap / 2, 0, 0]
    return joined(moved(left, -np.array(shift)), moved(right, shift))


def test_sphere_rests_on_both_lips_of_a_cut_narrower_than_itself():
    gap = 0.003
    mesh = lips(gap)
    surface, proxy = snapshot(mesh), Proxy(R)
    lowered(surface, proxy, (0.0005, -0.01, -0.005))
    height = np.sqrt(R**2 - (gap / 2) ** 2)
    for y in np.linspace(-0.01, 0.01, 200):
        touch = proxy.step(surface, 1.0, np.array([0.0005, y, -0.005]))
        np.testing.assert_allclose(touch.position, [0, y, height], atol=1e-6)
        assert touch.touching
    for side in (mesh[1][:12], mesh[1][12:]):
        assert distance(mesh[0], side, touch.position) == pytest.approx(R, abs=1e-7)


def test_sphere_in_a_cut_that_closes_is_between_the_lips_and_can_be_pulled_out():
    radius, device = 0.001, np.array([0.0002, 0.0, -0.004])
    proxy = Proxy(radius)
    surface = snapshot(lips(0.004))
    assert not lowered(surface, proxy, device).touching
    for i, gap in enumerate((0.003, 0.002, 0.0015, 0.001)):
        surface = snapshot(lips(gap), revision=i + 1, previous=surface)
        for blend in np.linspace(0, 1, 33):
            touch = proxy.step(surface, blend, device)
            width = 0.004 if i == 0 else (0.004, 0.003, 0.002, 0.0015)[i]
            assert abs(touch.position[0]) < width / 2
    assert abs(touch.position[0]) < 1e-6
    assert touch.touching
    for z in np.linspace(-0.004, 0.004, 100):
        touch = proxy.step(surface, 1.0, np.array([0.0002, 0.0, z]))
    np.testing.assert_array_equal(touch.position, [0.0002, 0, 0.004])


@pytest.mark.parametrize('seed', range(5))
def test_thin_sheet_is_never_popped_through(seed):
    rng = np.random.default_rng(seed)
    surface, proxy = snapshot(SHEET), Proxy(0.0015)
    device = np.array([0, 0, 0.02])
    target = device
    for _ in range(2000):
        if np.linalg.norm(target - device) < 1e-4:
            target = rng.uniform([-0.03, -0.03, -0.02], [0.03, 0.03, 0.01])
        way = target - device
        device = device + way * min(1, 1e-4 / np.linalg.norm(way))
        assert proxy.step(surface, 1.0, device).position[2] >= 0.0015 - 1e-9


@pytest.mark.parametrize('speed', [0.2, -0.2])
@pytest.mark.parametrize('mesh', [grid(30), SHEET], ids=['grid', 'sheet'])
def test_moving_surface_carries_the_proxy_without_penetration_or_jump(mesh, speed):
    proxy, surface = Proxy(R), snapshot(mesh)
    device = np.array([0.003, 0.002, 0.0 if speed > 0 else -0.03])
    last = lowered(surface, proxy, device, height=0.04).position[2]
    for frame in range(10):
        offset = np.array([0, 0, speed * (frame + 1) / 30])
        surface = snapshot(moved(mesh, offset), frame + 1, previous=surface)
        for tick in range(33):
            blend = (tick + 1) / 33
            touch = proxy.step(surface, blend, device)
            top = speed * (frame + blend) / 30
            assert touch.position[2] >= top + R - 1e-6
            assert abs(touch.position[2] - last) <= 1.02 * abs(speed) / 30 / 33
            last = touch.position[2]


def test_sheet_that_moves_far_in_one_tick_takes_the_proxy_along():
    surface, proxy = snapshot(SHEET), Proxy(R)
    lowered(surface, proxy, (0.003, 0.002, 0.001))
    raised = snapshot(moved(SHEET, [0, 0, 0.015]), 1, previous=surface)
    touch = proxy.step(raised, 1.0, np.array([0.003, 0.002, 0.001]))
    assert touch.position[2] == pytest.approx(0.015 + R, abs=1e-9)


def test_first_update_of_a_surface_continues_the_tick_that_the_last_one_missed():
    surface, proxy = snapshot(grid(30)), Proxy(R)
    device = np.array([0.003, 0.002, 0.0])
    lowered(surface, proxy, device)
    first = snapshot(moved(grid(30), [0, 0, 0.002]), 1, previous=surface)
    proxy.step(first, 0.5, device)
    second = snapshot(moved(grid(30), [0, 0, 0.004]), 2, previous=first)
    assert proxy.step(second, 0.0, device).position[2] == pytest.approx(0.002 + R, abs=1e-9)


def test_change_of_topology_in_contact_changes_nothing_that_is_felt():
    coarse, fine = grid(12), grid(31)
    proxy, device = Proxy(R), np.array([0.003, 0.002, 0.0])
    before = lowered(snapshot(coarse), proxy, device).position.copy()
    touch = proxy.step(snapshot(fine, 1, topology=1), 0.3, device)
    np.testing.assert_allclose(touch.position, before, atol=1e-9)
    np.testing.assert_allclose(touch.weights @ fine[0][touch.nodes], touch.contact, atol=1e-12)
    few = fine[0], fine[1][:3]
    touch = proxy.step(snapshot(few, 2, topology=2), 0.3, device)
    np.testing.assert_array_equal(touch.position, device)


def test_proxy_that_a_change_of_topology_buries_comes_out_at_the_nearest_point():
    proxy, device = Proxy(R), np.array([0.003, 0.002, -0.02])
    lowered(snapshot(SHEET), proxy, device, height=0.05)
    thicker = slab(0.08, -0.03, 0.01)
    touch = proxy.step(snapshot(thicker, 1, topology=1), 1.0, device)
    np.testing.assert_allclose(touch.position, [0.003, 0.002, 0.01 + R], atol=1e-9)


def test_device_that_starts_inside_finds_the_nearest_surface_also_after_a_release():
    surface, proxy = snapshot(SHEET), Proxy(R)
    for z, outside in ((-0.0003, R), (-0.0017, -0.002 - R)):
        touch = proxy.step(surface, 1.0, np.array([0.01, 0.02, z]))
        np.testing.assert_allclose(touch.position, [0.01, 0.02, outside], atol=1e-9)
        assert touch.touching
        proxy.reset()


def test_jump_of_a_metre_neither_tunnels_nor_waits_where_the_way_is_free():
    surface, proxy = snapshot(SHEET), Proxy(R)
    start = np.array([0.01, 0.005, 0.5])
    proxy.step(surface, 1.0, start)
    for _ in range(5):
        touch = proxy.step(surface, 1.0, start - UP)
        assert touch.position[2] >= R - 1e-9
    np.testing.assert_allclose(touch.position, [0.01, 0.005, R], atol=1e-9)
    np.testing.assert_array_equal(proxy.step(surface, 1.0, start).position, start)


@pytest.mark.parametrize('broken', [np.nan, np.inf])
def test_input_that_is_not_finite_changes_nothing_and_is_flagged(broken):
    surface, proxy = snapshot(SHEET), Proxy(R)
    device = np.array([0.01, 0.005, 0.0])
    before = lowered(surface, proxy, device).position.copy()
    for blend, tip in ((1.0, np.array([0, broken, 0])), (broken, device)):
        touch = proxy.step(surface, blend, tip)
        assert not touch.valid
        np.testing.assert_array_equal(touch.position, before)
    assert proxy.step(surface, 1.0, device).valid


def test_triangles_without_area_do_not_matter():
    positions, triangles = grid(21)
    empty = np.array([(0, 1, 2), (5, 5, 5), (7, 7, 8), (210, 220, 230)])
    mesh = positions, np.vstack([empty, triangles, empty])
    surface, proxy = snapshot(mesh), Proxy(R)
    lowered(surface, proxy, (-0.03, 0, 0.001))
    for x in np.linspace(-0.03, 0.03, 200):
        touch = proxy.step(surface, 1.0, np.array([x, 0.0, 0.001]))
        np.testing.assert_allclose(touch.position, [x, 0, R], atol=1e-9)
        np.testing.assert_allclose(touch.normal, [0, 0, 1], atol=1e-9)


def test_rim_of_an_open_surface_lets_the_device_by():
    mesh = grid(11)
    surface, proxy = snapshot(mesh), Proxy(R)
    for angle in np.linspace(0, 2 * np.pi, 500):
        device = np.array([0.05, 0, 0]) + 0.006 * np.array([np.sin(angle), 0, np.cos(angle)])
        touch = proxy.step(surface, 1.0, device)
        assert distance(*mesh, touch.position) >= R - 1e-9
    assert touch.position[2] < 0


@pytest.mark.parametrize('place', [(0.056, 0.001, -0.001), (0.055, 0.055, -0.001)])
def test_device_that_starts_beside_an_open_surface_is_not_inside_of_it(place):
    touch = Proxy(R).step(snapshot(grid(11)), 1.0, np.array(place))
    np.testing.assert_array_equal(touch.position, place)


def test_surface_without_triangles_leaves_the_proxy_free():
    surface, proxy = snapshot((np.zeros((3, 3)), np.zeros((0, 3), int))), Proxy(R)
    np.testing.assert_array_equal(proxy.step(surface, 1.0, np.ones(3)).position, np.ones(3))


def rough(x, y):
    noise = np.random.default_rng(3).uniform(-0.001, 0.001, x.shape)
    return 0.004 * np.sin(200 * x) * np.cos(170 * y) + noise


def ball():
    mesh = trimesh.creation.icosphere(3, radius=0.03)
    return np.array(mesh.vertices), np.array(mesh.faces)


@pytest.mark.parametrize(
    ('mesh', 'radius', 'step'),
    thinned([ball(), grid(30, rough)], [0.001, 0.004, 0.01], [2e-4, 3e-3, 0.05]),
)
def test_sphere_never_enters_the_surface_on_a_random_walk(mesh, radius, step):
    rng = np.random.default_rng(7)
    surface, proxy = snapshot(mesh), Proxy(radius)
    device = np.array([0, 0, 0.05])
    target = device
    for _ in range(400):
        if np.linalg.norm(target - device) < step:
            target = rng.uniform(-0.04, 0.04, 3)
        way = target - device
        device = device + way * min(1, step / max(np.linalg.norm(way), 1e-12))
        touch = proxy.step(surface, 1.0, device)
        assert distance(*mesh, touch.position) >= radius - 1e-9


@pytest.mark.parametrize('radius', [0.0, -1e-3, np.nan])
def test_radius_must_be_a_positive_length(radius):
    with pytest.raises(ValueError, match='must be positive'):
        Proxy(radius)
