"""Small formulas inside kernels, against their definition and against SciPy."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from meshes import irregular_box
from scipy.linalg import polar
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from cutting_trainer.cutting.local_mesh import _gather as gather_around
from cutting_trainer.cutting.lookup import DONE, EDGES
from cutting_trainer.cutting.snapping import PENDING, _can_join
from cutting_trainer.haptic_bridge.emulated_arm.hand import _tremble
from cutting_trainer.haptic_bridge.force_kernels import _rotate
from cutting_trainer.haptic_bridge.proxy.kernels import _SAME_DIRECTION_COS, STATE, _touched
from cutting_trainer.haptic_bridge.proxy.surface import LEAF_SIZE, _fitted_boxes
from cutting_trainer.tissue_sim.elasticity import stiffening_simd
from cutting_trainer.tissue_sim.elasticity.adaptive_law import add_tangent_traces, linear_traces
from cutting_trainer.tissue_sim.elasticity.corotational import KEPT
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.rotation import (
    LANES,
    ROTATION,
    SLOTS,
    TURN,
    rotation_step,
)
from cutting_trainer.tissue_sim.elasticity.stiffening import MAX_EXPONENT
from cutting_trainer.tissue_sim.elasticity.viscous_stress import _conjugate
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.far_field import _strain_domains

GRADIENT = np.array([[0.3, -0.2, 0.1], [0.05, -0.25, 0.15], [-0.1, 0.2, 0.4]])
"""Of a homogeneous displacement: no two entries are alike."""


@pytest.fixture(scope='module')
def tissue() -> ElasticModel:
    """Of more nodes than a chunk of lanes has."""
    mesh = TetMesh(*irregular_box((4, 4, 3), 0.01, 5))
    return ElasticModel(mesh, Material(3000.0, 0.4, 1000.0, stiffening=6.0), 'stiffening')


def test_a_vector_is_turned_by_the_tools_orientation_and_back() -> None:
    rng = np.random.default_rng(2)
    for rotation in Rotation.random(20, random_state=3):
        v, out = rng.standard_normal(3), np.zeros(3)
        _rotate(rotation.as_quat(), v, 1.0, out)
        np.testing.assert_allclose(out, rotation.apply(v), atol=1e-14)
        _rotate(rotation.as_quat(), v, -1.0, out)
        np.testing.assert_allclose(out, rotation.inv().apply(v), atol=1e-14)


def test_a_step_of_the_rotation_is_newtons_and_ends_at_the_polar_decomposition() -> None:
    rng = np.random.default_rng(4)
    gradients = np.eye(3) + rng.uniform(-0.35, 0.35, (LANES, 3, 3))
    chunk = np.zeros(SLOTS * LANES)
    slots = chunk.reshape(SLOTS, LANES)
    slots[:9], slots[ROTATION] = gradients.reshape(LANES, 9).T, 1.0
    rotation_step(chunk)
    for lane, f in enumerate(gradients):
        axial = np.array([f[2, 1] - f[1, 2], f[0, 2] - f[2, 0], f[1, 0] - f[0, 1]])
        step = np.linalg.solve(np.trace(f) * np.eye(3) - (f + f.T) / 2, axial)
        assert slots[TURN, lane] == pytest.approx((step / 2) @ (step / 2), rel=1e-12)
    for _ in range(8):
        rotation_step(chunk)
    assert slots[TURN].max() < 1e-28
    w, x, y, z = slots[ROTATION : ROTATION + 4]
    found = Rotation.from_quat(np.array([x, y, z, w]).T).as_matrix()
    np.testing.assert_allclose(found, [polar(f)[0] for f in gradients], atol=1e-12)


@pytest.mark.parametrize('exponent', [1e-3, 0.5, 0.9 * MAX_EXPONENT, 1.1 * MAX_EXPONENT, 8.0])
def test_the_energy_of_a_stress_alone_is_legendres_transform_of_the_laws(exponent: float) -> None:
    mu, b = 1800.0, 6.0

    def energy(size: float) -> float:
        y = 2.0 * b * size * size
        beyond = max(y - MAX_EXPONENT, 0.0)
        return mu / (2.0 * b) * (math.exp(y - beyond) * (1.0 + beyond) - 1.0)

    strain = math.sqrt(exponent / (2.0 * b))
    stress = 2.0 * mu * math.exp(min(exponent, MAX_EXPONENT)) * strain
    best = minimize_scalar(
        lambda e: energy(e) - stress * e, bounds=(0.0, 2 * strain), options={'xatol': 1e-9}
    )
    law = np.array([mu, 0.0, 0.0, b])
    assert _conjugate(stress * stress, law) == pytest.approx(-best.fun, rel=1e-6)
    law[3] = 0.0
    assert _conjugate(stress * stress, law) == pytest.approx(stress * stress / (4.0 * mu))


def test_traces_of_the_tangent_are_those_of_differences_of_forces() -> None:
    """Of its 3x3 blocks on the diagonal: stretched, compressed, sheared, and without strain."""
    mesh = TetMesh(*irregular_box((3, 2, 2), 0.01, 5))
    material = Material(3000.0, 0.4, 1000.0, stiffening=6.0)
    model = ElasticModel(mesh, material, 'stiffening', tolerance=0.0)
    flat = (mesh.rest @ GRADIENT.T).ravel()
    flat += np.random.default_rng(3).uniform(-5e-4, 5e-4, len(flat))
    operands, n, step = model.operands(), mesh.node_count, 1e-8
    parts = operands.law, operands.domains, operands.elements
    linear, excess = np.zeros(n), np.zeros(n)
    linear_traces(*parts, operands.chunks, linear)
    np.testing.assert_allclose(linear, np.trace(blocks(model.dense()), axis1=1, axis2=2), rtol=1e-9)
    add_tangent_traces(*parts, operands.spans, operands.chunks, flat, excess, np.zeros(6))
    tangent = np.empty((3 * n, 3 * n))
    for i, way in enumerate(step * np.eye(3 * n)):
        ahead, behind = ((flat + s * way).reshape(-1, 3) for s in (1, -1))
        tangent[i] = (model.force(ahead) - model.force(behind)).ravel() / (2 * step)
    expected = np.trace(blocks(tangent), axis1=1, axis2=2)
    np.testing.assert_allclose(linear + excess, expected, rtol=1e-5)
    assert excess.max() > linear.max()


def blocks(stiffness: np.ndarray) -> np.ndarray:
    """3x3 blocks on the diagonal, shape (n, 3, 3)."""
    n = len(stiffness) // 3
    return stiffness.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


def test_every_domain_of_a_homogeneous_strain_has_it(tissue: ElasticModel) -> None:
    operands, u = tissue.operands(), (tissue.mesh.rest @ GRADIENT.T).ravel()
    count = len(operands.domains.used)
    assert count > LANES
    squares = np.zeros(count)
    _strain_domains(operands.domains, u, squares)
    np.testing.assert_allclose(squares, (GRADIENT**2).sum(), rtol=1e-9)
    traces, strain = np.zeros(tissue.mesh.node_count), np.zeros(6)
    parts = operands.law, operands.domains, operands.elements, operands.spans, operands.chunks
    add_tangent_traces(*parts, u, traces, strain)
    stretches = np.linalg.svd(np.eye(3) + GRADIENT)[1]
    assert strain[0] == count
    ratio = np.prod(stretches)
    np.testing.assert_allclose(strain[2:4], [min(ratio, 1.0), max(ratio, 1.0)], rtol=1e-9)
    np.testing.assert_allclose(strain[4:], [stretches.min(), stretches.max()], rtol=1e-6)
    assert (traces > 0).all()
    for part in np.eye(9).reshape(9, 3, 3):
        add_tangent_traces(*parts, (tissue.mesh.rest @ (0.2 * part).T).ravel(), traces, strain)
        assert strain[0] == count, 'a strain counts whichever way it goes'


def test_every_element_of_a_homogeneous_strain_has_its_gradient_and_volume(
    tissue: ElasticModel,
) -> None:
    elements, u = tissue.operands().elements, (tissue.mesh.rest @ GRADIENT.T).ravel()
    groups = np.array([LANES, 0, 3 * stiffening_simd.GROUP])
    width, mu = len(groups) * stiffening_simd.GROUP, 700.0
    chunk = np.full((stiffening_simd.SLOTS_OF_LAW, LANES), np.nan)
    shapes = np.zeros(stiffening_simd._SLOTS_OF_SHAPES * LANES)
    stiffening_simd._gather(elements, groups, u, mu, chunk.ravel(), shapes)
    found = chunk[:9, :width]
    np.testing.assert_allclose(found, np.tile(GRADIENT.ravel()[:, None], width), atol=1e-12)
    tets = (groups[:, None] + np.arange(stiffening_simd.GROUP)).ravel()
    expected = elements.data[(tets // LANES * KEPT + 13) * LANES + tets % LANES] / (2.0 * mu)
    np.testing.assert_allclose(chunk[stiffening_simd.VOLUME, :width], expected)
    assert (chunk[stiffening_simd.VOLUME, width:] == 0.0).all(), 'lanes without an element'


def test_tremor_is_the_sum_of_its_tones_on_each_axis() -> None:
    rng = np.random.default_rng(8)
    tones, angles = rng.uniform(50, 80, (3, 5)), rng.uniform(0, 6, (3, 5))
    position, velocity = np.ones(3), np.zeros(3)
    _tremble(0.7, 2e-4, tones, angles, position, velocity)
    phase = tones * 0.7 + angles
    np.testing.assert_allclose(position, 1.0 + 2e-4 * np.sin(phase).sum(axis=1))
    np.testing.assert_allclose(velocity, 2e-4 * (tones * np.cos(phase)).sum(axis=1))


def test_boxes_of_the_surface_fit_their_triangles_over_a_frame() -> None:
    rng = np.random.default_rng(9)
    start = rng.uniform(-1, 1, (30, 3))
    end, triangles = (
        start + rng.uniform(-0.1, 0.1, (30, 3)),
        rng.integers(0, 30, (15 * LEAF_SIZE + 3, 3)),
    )
    boxes = _fitted_boxes(start, end, triangles)
    leaves = (len(boxes) + 1) // 2
    for leaf, box in enumerate(boxes[leaves - 1 :]):
        own = triangles[leaf * LEAF_SIZE : (leaf + 1) * LEAF_SIZE]
        both = np.concatenate([start[own], end[own]]).reshape(-1, 3)
        np.testing.assert_array_equal(box, [*both.min(axis=0), *both.max(axis=0)])
    both = np.concatenate([start[triangles], end[triangles]]).reshape(-1, 3)
    np.testing.assert_array_equal(boxes[0], [*both.min(axis=0), *both.max(axis=0)])


def test_touched_triangles_push_in_as_many_directions_as_their_normals_have() -> None:
    state = np.zeros(1, STATE)
    surface = SimpleNamespace(triangles=np.arange(3, 33).reshape(10, 3))
    near = state[0]['near'][0]
    axes = np.array([[1, 1, 0], [1, -1, 0], [0, 1, 1], [0, 1, -1], [1, 0, 1]]) / math.sqrt(2)
    normals = np.repeat(axes, 2, axis=0)
    near['count'], near['order'][:10] = 10, np.arange(10)
    near['triangle'][:10], near['normal'][:, :10] = np.arange(10), normals.T
    records = [
        SimpleNamespace(
            near=[SimpleNamespace(**{n: near[n] for n in near.dtype.names})],
            **{n: state[0][n] for n in ('push_normal', 'push_slot', 'nodes', 'position')},
        )
    ]
    assert _touched(surface, 1.0, records) == len(axes)
    np.testing.assert_allclose(state[0]['push_normal'][: len(axes)], axes)
    assert np.abs(axes @ axes.T - np.eye(5)).max() < _SAME_DIRECTION_COS
    np.testing.assert_array_equal(state[0]['push_slot'][: len(axes)], 2 * np.arange(5))


def test_a_node_joins_the_cut_unless_an_edge_of_it_is_cut() -> None:
    tables = SimpleNamespace(
        counts={EDGES: 3},
        edge_state=[DONE, PENDING, DONE],
        edge_nodes=np.array([[1, 2], [5, 6], [3, 4]]),
    )
    assert [_can_join(tables, node) for node in range(7)] == [
        True, False, False, False, False, True, True,
    ]  # fmt: skip


def test_elements_around_a_line_are_those_reached_within_its_region(tissue: ElasticModel) -> None:
    mesh = tissue.mesh
    line, region = np.array([[0.0, 0.02, 0.015], [0.02, 0.02, 0.015]]), 0.009
    away = np.maximum(np.abs(mesh.rest[:, 0] - 0.01) - 0.01, 0.0)
    distance = np.sqrt(away**2 + ((mesh.rest - line[0])[:, 1:] ** 2).sum(axis=1))
    near = np.flatnonzero(distance < region)
    removed = np.flatnonzero((mesh.tetrahedra == near[0]).any(axis=1))[:2]
    found = gather_around(
        mesh.links, mesh.rest, np.arange(mesh.node_count), removed, line, region, 1
    )
    around = np.flatnonzero(np.isin(mesh.tetrahedra, near).any(axis=1))
    np.testing.assert_array_equal(found, np.setdiff1d(around, removed))
    assert 0 < len(near) < mesh.node_count
    further = gather_around(mesh.links, mesh.rest, near[:1], removed[:0], line, region, 40)
    middles = mesh.rest[mesh.tetrahedra].mean(axis=1)
    away = np.maximum(np.abs(middles[:, 0] - 0.01) - 0.01, 0.0)
    inside = np.sqrt(away**2 + ((middles - line[0])[:, 1:] ** 2).sum(axis=1)) < region
    assert set(np.flatnonzero(inside)) <= set(further)
