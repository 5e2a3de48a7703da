"""Claims about the proxy on a tissue that is cut, opened and taken away under it."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import irregular_box
from strokes import method_named, straight
from surfaces import distance, joined, slab

from cutting_trainer.haptic_bridge.proxy.proxy import Proxy
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

H = 0.005
CELLS = (8, 4, 3)
PLANE, TOP, BOTTOM = 0.0101, 0.015, 0.006
"""[m] of the cut: its plane y, the tissue's top and the depth that the blade's tip is at, z."""
TICKS, LOOK = 8, 4
"""Ticks of a frame, and at how many the place of the proxy is looked at."""
R = 0.004
UP = np.array([0.0, 0.0, 1.0])


class Stage(NamedTuple):
    """The block after a batch of the cut: rest, triangles, tetrahedra and how its lips can open.

    `opened` is the displacement of each node for lips 1 m apart, behind the blade; `as_before` the
    same as far as they were open in the stage before.
    """

    rest: np.ndarray
    triangles: np.ndarray
    tetrahedra: np.ndarray
    topology: int
    opened: np.ndarray
    as_before: np.ndarray


def openings(mesh: TetMesh, front: float) -> np.ndarray:
    """Away from the plane of the cut, most at the top, not at the tip nor ahead of the front."""
    corners, count = mesh.tetrahedra.ravel(), mesh.node_count
    off = np.repeat(mesh.rest[mesh.tetrahedra].mean(axis=1)[:, 1] - PLANE, 4)
    side = np.bincount(corners, off, count) / np.bincount(corners, minlength=count)
    x, y, z = mesh.rest.T
    part = np.clip((z - BOTTOM) / (TOP - BOTTOM), 0, 1) * np.clip((front - 2 * H - x) / 0.01, 0, 1)
    part = part * np.exp(-np.abs(y - PLANE) / 0.006) * np.clip(6 * side / H, -1, 1)
    return part[:, None] * np.array([0.0, 0.5, 0.0])


@pytest.fixture(scope='module')
def cut() -> list[Stage]:
    """A block that a blade goes through from end to end, 9 mm deep."""
    mesh = TetMesh(*irregular_box(CELLS, H, seed=0))
    method = method_named()
    begin, end = (-0.002, PLANE, BOTTOM), (0.043, PLANE, BOTTOM)
    stages, front = [], begin[0]

    def keep(reached):
        stages.append(
            Stage(
                mesh.rest.copy(),
                mesh.triangles.copy(),
                mesh.tetrahedra.copy(),
                mesh.topology,
                openings(mesh, reached),
                openings(mesh, front),
            )
        )
        return reached

    front = keep(front)
    for (root, tip), (next_root, next_tip) in pairwise(straight(begin, end, (0, 0, 0.02), 16)):
        delta = method.advance(mesh, mesh.rest, Sweep(root, tip, next_root, next_tip)).delta
        if not delta.empty:
            mesh.apply(delta)
        front = keep(float(next_tip[0]))
    delta = method.finish(mesh, mesh.rest).delta
    if not delta.empty:
        mesh.apply(delta)
    keep(0.06)
    return stages


def is_inside(positions, tetrahedra, point):
    """Whether a point is in a tetrahedron, by barycentric coordinates of all of them."""
    corners = positions[tetrahedra]
    edges = np.swapaxes(corners[:, :3] - corners[:, 3:], 1, 2)
    shares = np.linalg.solve(edges, (point - corners[:, 3])[:, :, None])[:, :, 0]
    return bool(np.minimum(shares.min(axis=1), 1 - shares.sum(axis=1)).max() > 1e-9)


@settings(max_examples=8, deadline=None, derandomize=True, database=None)
@given(
    radius=st.sampled_from([0.001, R]),
    step=st.sampled_from([1e-4, 5e-4, 2e-3]),
    moving=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_cut_that_is_made_and_opens_and_closes_is_never_entered(cut, radius, step, moving, seed):
    """And nothing is stored in the proxy's spring but what tool and surface have moved.

    A lip that closes on a small sphere squeezes it out, faster than the lip itself moves.
    """
    rng = np.random.default_rng(seed)
    proxy, surface = Proxy(radius), None
    tool = target = np.array([0.02, 0.01, 0.03])
    wide, revision, depth = 0.004, 0, 0.0
    for stage in cut:
        for shape in (stage.as_before, stage.opened, stage.opened):
            if shape is stage.opened and moving:
                wide = rng.uniform(0.0, 0.006)
            revision += 1
            surface = Surface(
                stage.rest + wide * shape,
                stage.triangles,
                revision=revision,
                topology=stage.topology,
                previous=surface,
            )
            for tick in range(TICKS):
                if np.linalg.norm(target - tool) < step:
                    target = rng.uniform([0.0, 0.006, 0.004], [0.04, 0.014, 0.022])
                way = target - tool
                move = way * min(1.0, step / max(float(np.linalg.norm(way)), 1e-12))
                tool = tool + move
                blend = (tick + 1) / TICKS
                touch = proxy.step(surface, blend, tool)
                if tick % LOOK == LOOK - 1:
                    start, end = surface.geometry.start, surface.geometry.end
                    now = start + blend * (end - start)
                    assert distance(now, stage.triangles, touch.position) >= radius - 1e-6
                    assert not is_inside(now, stage.tetrahedra, touch.position)
                moved = float(np.linalg.norm(move)) + surface.motion / TICKS
                if radius == R or surface.motion == 0.0:
                    assert touch.depth <= depth + moved + 1e-6
                depth = touch.depth


def test_a_cut_that_does_not_open_is_not_felt(cut):
    """Neither when it passes under the tool nor on sliding across."""
    proxy = Proxy(R)
    tool = np.array([0.02, PLANE + 1e-4, TOP + R - 0.003])
    surface = None
    for revision, stage in enumerate(cut):
        topology = stage.topology
        surface = Surface(
            stage.rest, stage.triangles, revision=revision, topology=topology, previous=surface
        )
        for height in (0.01, 0.0) if revision == 0 else (0.0,):
            touch = proxy.step(surface, 1.0, tool + height * UP)
        np.testing.assert_allclose(touch.position, [*tool[:2], TOP + R], atol=1e-7)
        np.testing.assert_allclose(touch.normal, [0, 0, 1], atol=1e-6)
    for y in np.linspace(0.004, 0.016, 60):
        touch = proxy.step(surface, 1.0, np.array([0.02, y, tool[2]]))
        np.testing.assert_allclose(touch.position, [0.02, y, TOP + R], atol=1e-7)


def lips(gap):
    left, right = (slab(0.03, -0.02, 0.0) for _ in range(2))
    for (positions, _), sign in ((left, -1), (right, 1)):
        positions[:, 0] += sign * (0.015 + gap / 2)
    return joined(left, right)


def test_a_sphere_sinks_between_lips_that_open_as_their_edges_let_it():
    """From one update to the next at 30 Hz, tick by tick, on a tool that is held."""
    proxy, surface = Proxy(R), Surface(*lips(0.0), revision=0, topology=0)
    tool = np.array([0.0, 0.001, R - 0.004])
    for height in (0.01, 0.0):
        proxy.step(surface, 1.0, tool + height * UP)
    gaps = np.linspace(0.0, 1.6 * R, 9)
    for revision, (before, after) in enumerate(pairwise(gaps), start=1):
        surface = Surface(*lips(after), revision=revision, topology=0, previous=surface)
        for tick in range(33):
            blend = (tick + 1) / 33
            touch = proxy.step(surface, blend, tool)
            gap = before + blend * (after - before)
            height = np.sqrt(R**2 - gap**2 / 4)
            np.testing.assert_allclose(touch.position, [0, 0.001, height], atol=2e-6)
            np.testing.assert_allclose(touch.normal, [0, 0, 1], atol=1e-3)


def test_a_way_into_an_open_cut_along_both_lips_and_out_is_felt_by_each_lip_alone():
    radius, gap = 0.001, 0.004
    mesh = lips(gap)
    surface, proxy = Surface(*mesh, revision=0, topology=0), Proxy(radius)
    places = [
        (-0.003, 0.002),  # over the left lip
        (-0.003, -0.0005),  # on it
        (0.0, -0.0005),  # over its edge
        (0.0, -0.010),  # into the cut
        (-0.002, -0.010),  # against the left side
        (-0.002, -0.005),
        (0.002, -0.005),  # across to the right side
        (0.002, -0.012),
        (0.0, -0.012),
        (0.0, 0.004),  # and out
    ]
    normals, depth, tool = {}, 0.0, np.array([places[0][0], 0.0, places[0][1]])
    for i, (a, b) in enumerate(pairwise(places)):
        for s in np.linspace(0, 1, 100):
            before = tool
            tool = np.array([a[0] + s * (b[0] - a[0]), 0.0, a[1] + s * (b[1] - a[1])])
            touch = proxy.step(surface, 1.0, tool)
            assert distance(*mesh, touch.position) >= radius - 1e-9
            # It may slip off the edge in one tick, but only nearer to the tool.
            assert touch.depth <= depth + np.linalg.norm(tool - before) + 1e-9
            depth = touch.depth
            if touch.touching:
                normals[i] = touch.normal.copy()
    np.testing.assert_allclose(normals[0], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(normals[4], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(normals[6], [-1, 0, 0], atol=1e-9)
    assert not touch.touching
    np.testing.assert_array_equal(touch.position, tool)


@pytest.mark.parametrize('seed', range(4))
def test_a_piece_that_vanishes_under_the_sphere_lets_it_nearer_and_never_into_the_rest(seed):
    rng = np.random.default_rng(seed)
    nodes, tetrahedra = irregular_box(CELLS, H, seed)
    proxy = Proxy(R)
    tool = np.array([0.02, 0.01, TOP + R - 0.006])
    for height in (0.01, 0.0):
        mesh = TetMesh(nodes, tetrahedra)
        surface = Surface(mesh.rest, mesh.triangles, revision=0, topology=0)
        depth = proxy.step(surface, 1.0, tool + height * UP).depth
    assert depth == pytest.approx(0.006)
    for topology in range(1, 12):
        middles = nodes[tetrahedra].mean(axis=1)
        near = np.argsort(np.linalg.norm(middles - tool, axis=1))[:24]
        keep = np.ones(len(tetrahedra), bool)
        keep[rng.choice(near, 16, replace=False)] = False
        tetrahedra = tetrahedra[keep]
        mesh = TetMesh(nodes, tetrahedra)
        surface = Surface(mesh.rest, mesh.triangles, revision=topology, topology=topology)
        touch = proxy.step(surface, 0.3, tool)
        assert touch.depth <= depth + 1e-9
        assert distance(mesh.rest, mesh.triangles, touch.position) >= R - 1e-6
        assert not is_inside(mesh.rest, tetrahedra, touch.position)
        depth = touch.depth
    assert depth < 0.005
