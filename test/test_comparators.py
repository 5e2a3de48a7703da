"""Where other ways of contact fail, and the proxy does not, on the same path."""

import numpy as np
import pytest
from surfaces import grid, slab

from bench.haptics.comparators import CONTACTS, GodObject, Penalty
from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface

pytestmark = pytest.mark.thorough

RADIUS = 1e-3


def surface(mesh, revision=0, previous=None):
    return Surface(*mesh, revision=revision, topology=0, previous=previous)


def walk(contact, ground, points):
    """Depth and normal along a path [m], normal zero where nothing is touched, shape (k, 4)."""
    found = []
    for point in points:
        touch = contact.step(ground, 1.0, np.array(point, float))
        normal = touch.normal if touch.touching else np.zeros(3)
        found.append([touch.depth if touch.touching else 0.0, *normal])
    return np.array(found)


def down(to, steps=200, x=0.0, start=0.004):
    return [(x, 0.002, z) for z in np.linspace(start, to, steps)]


@pytest.mark.parametrize('name', CONTACTS)
def test_pressing_a_plane_is_the_same_by_all(name):
    ground = surface(grid(9))
    radius = 0.0 if name == 'god_object' else RADIUS
    contact = CONTACTS[name](RADIUS)
    way = down(-1e-3)
    found = walk(contact, ground, way)
    depth = np.maximum(radius - np.array(way)[:, 2], 0.0)
    np.testing.assert_allclose(found[:, 0], depth, atol=1e-6)
    np.testing.assert_allclose(found[-1, 1:], [0, 0, 1], atol=1e-4)
    touch = contact.touch
    assert touch.weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(touch.contact, [0, 0.002, 0], atol=1e-6)


def test_penalty_pops_through_a_sheet_of_2_mm_and_the_proxy_and_the_god_object_do_not():
    sheet = surface(slab(0.1, -2e-3, 0.0))
    path = down(-4e-3)
    up = {name: walk(CONTACTS[name](RADIUS), sheet, path) for name in CONTACTS}
    # Behind the middle of the sheet the nearest way out is the far side: it pushes on through.
    assert up['penalty'][:, 3].min() == pytest.approx(-1)
    assert up['penalty'][-1, 0] == 0.0
    for name in ('proxy', 'god_object'):
        assert up[name][:, 3].min() >= 0
        assert up[name][-1, 3] == pytest.approx(1, abs=1e-4)
        assert (np.diff(up[name][:, 0]) >= -1e-9).all()


def test_penalty_flips_at_an_edge_and_the_proxy_turns_with_the_tool():
    """Down along the side of a box, 2 mm in: the top is near first, then the side is nearer."""
    box = surface(slab(0.1, -0.05, 0.0))
    path = [(0.048, 0.002, z) for z in np.linspace(0.004, -0.006, 400)]
    penalty = walk(Penalty(RADIUS), box, path)
    proxy = walk(Proxy(RADIUS), box, path)
    turns = [
        (found[1:, 1:] * found[:-1, 1:]).sum(axis=1)[(found[1:, 0] > 0) & (found[:-1, 0] > 0)]
        for found in (penalty, proxy)
    ]
    assert turns[0].min() < 0.1  # by a right angle in one tick
    assert turns[1].min() > 0.999
    assert proxy[-1, 3] == pytest.approx(1)


def test_god_object_slides_over_facets_without_leaving_the_surface():
    hill = surface(grid(17, lambda x, y: 0.01 * np.cos(30 * x) * np.cos(30 * y)))
    contact = GodObject(RADIUS)
    path = [(x, 0.001, 0.01 * np.cos(30 * x) - 2e-3) for x in np.linspace(-0.02, 0.02, 400)]
    found = walk(contact, hill, [(-0.02, 0.001, 0.02), *path])[1:]
    assert (found[:, 0] > 5e-4).all()
    assert (found[:, 3] > 0.5).all()


def test_a_surface_that_passes_over_a_god_object_has_lost_it_and_carries_the_proxy():
    flat = grid(9)
    first = surface(flat)
    raised = surface((flat[0] + [0, 0, 5e-3], flat[1]), 1, first)
    tip = np.array([0.0, 0.002, 2e-3])
    god, proxy = GodObject(RADIUS), Proxy(RADIUS)
    for contact in (god, proxy):
        contact.step(first, 1.0, tip)
        contact.step(raised, 1.0, tip)
    assert not god.touch.touching
    assert proxy.touch.touching
    assert proxy.touch.depth == pytest.approx(5e-3 + RADIUS - 2e-3, abs=1e-6)
