"""What every elastic model must do, and where the plain ones are known to fail."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import box, irregular_box
from scipy.spatial.transform import Rotation

from bench.cuts.random_strokes import random_stroke, shuffled_box
from bench.cuts.strokes import results_along
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import (
    MODELS,
    PLAIN_SHARE,
    ElasticModel,
    ModelName,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

LIVER = Material(642.55, 0.47, 1050.0)
TURNING: tuple[ModelName, ...] = ('corotational', 'corotational_smoothed')
STIFF = Material(5400.0, 0.45, 1060.0, stiffening=6.0)
every_model = pytest.mark.parametrize('name', MODELS)


def model_of(
    nodes: np.ndarray, tets: np.ndarray, name: ModelName, material: Material = LIVER
) -> ElasticModel:
    return ElasticModel(TetMesh(nodes, tets), material, name)


def inside(nodes: np.ndarray, cells: tuple[int, int, int], size: float) -> np.ndarray:
    return ((nodes > 1e-9) & (nodes < np.array(cells) * size - 1e-9)).all(axis=1)


@every_model
@pytest.mark.parametrize('nu', [0.0, 0.3, 0.47, 0.499])
def test_an_affine_displacement_leaves_inner_nodes_without_force(name: ModelName, nu) -> None:
    nodes, tets = irregular_box((4, 3, 3), 0.01, 1)
    model = model_of(nodes, tets, name, Material(642.55, nu, 1050.0))
    gradient = np.random.default_rng(1).normal(size=(3, 3)) * 0.01
    force = model.force(nodes @ gradient.T)
    inner = inside(nodes, (4, 3, 3), 0.01)
    assert inner.any()
    assert np.abs(force[inner]).max() < 1e-12 * np.abs(force).max()


@every_model
def test_an_affine_displacement_gives_the_tractions_of_constant_stress(name: ModelName) -> None:
    nodes, tets = irregular_box((3, 3, 3), 0.01, 1)
    model = model_of(nodes, tets, name)
    strain = np.random.default_rng(1).normal(size=(3, 3)) * 0.01
    strain = (strain + strain.T) / 2
    stress = 2 * LIVER.lame_mu * strain + LIVER.lame_lambda * np.trace(strain) * np.eye(3)
    mesh = model.mesh
    corners = mesh.rest[mesh.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    expected = np.zeros_like(nodes)
    for i in range(3):
        np.add.at(expected, mesh.triangles[:, i], areas @ stress / 3)
    force, energy = model.evaluate(nodes @ strain)
    np.testing.assert_allclose(force, expected, atol=1e-12 * np.abs(expected).max())
    assert energy == pytest.approx(27e-6 * np.sum(strain * stress) / 2, rel=1e-12)


@every_model
def test_stiffness_is_symmetric_with_the_six_rigid_motions_and_no_other_zero_mode(
    name: ModelName,
) -> None:
    nodes, tets = irregular_box((3, 3, 3), 0.01, 3)
    stiffness = model_of(nodes, tets, name).dense()
    assert np.abs(stiffness - stiffness.T).max() < 1e-14 * np.abs(stiffness).max()
    values = np.linalg.eigvalsh(stiffness)
    assert np.abs(values[:6]).max() < 1e-10 * values[-1]
    # No spurious mode: never softer than the share of plain elements without lambda.
    shear = Material(2 * PLAIN_SHARE * LIVER.lame_mu, 0.0, 1050.0)
    least = np.linalg.eigvalsh(model_of(nodes, tets, 'linear', shear).dense())
    assert (values[6:] > 0.999 * least[6:]).all()
    assert least[6] > 1e-6 * values[-1]


@pytest.mark.parametrize('name', ['linear_smoothed', 'corotational_smoothed'])
def test_averaging_only_takes_energy_away(name: ModelName) -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 3)
    plain, smoothed = model_of(nodes, tets, 'linear').dense(), model_of(nodes, tets, name).dense()
    assert np.linalg.eigvalsh(plain - smoothed)[0] > -1e-12 * np.abs(plain).max()


@pytest.mark.parametrize('name', TURNING)
@pytest.mark.parametrize('degrees', [1.0, 30.0, 90.0, 135.0, 179.0, 180.0])
def test_a_rigid_rotation_gives_no_force_under_corotation(name: ModelName, degrees: float) -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 2)
    model = model_of(nodes, tets, name)
    reference = np.abs(model.force(0.01 * nodes)).max()
    axis = np.array([0.48, -0.6, 0.64])
    rotation = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    force, energy = model.evaluate(nodes @ rotation.T - nodes + 0.01)
    assert np.abs(force).max() < 1e-10 * reference
    assert abs(energy) < 1e-20


@pytest.mark.parametrize('name', ['linear', 'linear_smoothed'])
def test_a_rigid_rotation_strains_linear_models_by_the_cosine_minus_one(name: ModelName) -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 2)
    model = model_of(nodes, tets, name)
    angle = np.deg2rad(30.0)
    rotation = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    shrunk = nodes * np.array([1, 1, 0]) * (np.cos(angle) - 1)
    expected = model.force(shrunk)
    force = model.force(nodes @ rotation.T - nodes)
    np.testing.assert_allclose(force, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize('name', TURNING)
def test_force_turns_with_the_tissue_and_is_the_gradient_of_the_energy(name: ModelName) -> None:
    nodes, tets = irregular_box((3, 2, 2), 0.01, 4)
    model = model_of(nodes, tets, name)
    rng = np.random.default_rng(4)
    u = rng.normal(size=nodes.shape) * 1e-3
    force, energy = model.evaluate(u)
    rotation = Rotation.random(random_state=4).as_matrix()
    turned, same = model.evaluate((nodes + u) @ rotation.T - nodes)
    np.testing.assert_allclose(turned, force @ rotation.T, atol=1e-9 * np.abs(force).max())
    assert same == pytest.approx(energy, rel=1e-9)
    model.force(u)
    d = rng.normal(size=nodes.shape) * 1e-7
    slope = (model.evaluate(u + d)[1] - model.evaluate(u - d)[1]) / 2
    assert slope == pytest.approx(np.sum(model.force(u) * d), rel=1e-5)


@given(st.integers(0, 10**6), st.sampled_from(TURNING))
@settings(max_examples=25, deadline=None)
def test_rotations_stay_proper_and_settle_wherever_they_come_from(
    seed: int, name: ModelName
) -> None:
    """From any shape, inverted ones too, back to a rigid motion: no force and no energy is left."""
    nodes, tets = box((1, 1, 1), 0.01)
    model = model_of(nodes, tets, name)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        force, energy = model.evaluate(rng.normal(size=nodes.shape) * 0.01)
        assert np.isfinite(force).all() and energy >= 0.0
    rotation = Rotation.random(random_state=seed).as_matrix()
    force, energy = model.evaluate(nodes @ rotation.T - nodes)
    assert np.abs(force).max() < 1e-10 * np.abs(model.force(0.01 * nodes)).max()


@pytest.mark.parametrize('tolerance', [0.0, 0.05, 0.2])
@pytest.mark.parametrize('size', [1e-4, 1e-3, 4e-3])
def test_forces_of_a_law_are_the_gradient_of_its_energy_blended_or_inside_out(
    tolerance: float, size: float
) -> None:
    nodes, tets = irregular_box((3, 2, 2), 0.01, 4)
    model = ElasticModel(TetMesh(nodes, tets), STIFF, 'stiffening', tolerance)
    rng = np.random.default_rng(4)
    u, d = rng.normal(size=(2, *nodes.shape)) * np.array([[[size]], [[1e-8]]])
    force = model.force(u)
    slope = (model.evaluate(u + d)[1] - model.evaluate(u - d)[1]) / 2
    assert slope == pytest.approx(np.sum(force * d), rel=1e-5)
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).max()


@pytest.mark.parametrize('degrees', [30.0, 90.0, 180.0])
def test_a_rigid_rotation_gives_no_force_by_the_law(degrees: float) -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 2)
    model = model_of(nodes, tets, 'stiffening', STIFF)
    reference = np.abs(model.force(0.01 * nodes)).max()
    axis = np.array([0.48, -0.6, 0.64])
    rotation = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    force, energy = model.evaluate(nodes @ rotation.T - nodes + 0.01)
    assert np.abs(force).max() < 1e-10 * reference
    assert abs(energy) < 1e-15


@pytest.mark.parametrize('stretch', [0.75, 1.3])
def test_a_homogeneous_strain_meets_the_law_itself(stretch: float) -> None:
    """Uniaxial strain, J = s: sigma = mu exp(b x) (s - 1 / s) + lambda ln s / s by rest area."""
    nodes, tets = irregular_box((3, 3, 3), 0.01, 1)
    model = model_of(nodes, tets, 'stiffening', STIFF)
    force = model.force(nodes * np.array([0.0, 0.0, stretch - 1]))
    pulled = force[nodes[:, 2] > 0.03 - 1e-9, 2].sum() / 9e-4
    s, log = stretch, np.log(stretch)
    rise = STIFF.lame_mu * np.exp(6.0 * (s * s - 1 - 2 * log))
    expected = rise * (s - 1 / s) + STIFF.lame_lambda * log / s
    assert pulled == pytest.approx(expected, rel=1e-9)


def test_an_element_inside_out_is_driven_back() -> None:
    nodes, tets = box((1, 1, 1), 0.01)
    model = model_of(nodes, tets, 'stiffening', STIFF)
    u = np.zeros_like(nodes)
    top = nodes[:, 2] > 0.005
    energies, drives = [], []
    for depth in np.linspace(0.004, 0.03, 20):  # beyond the underside from 0.01 on
        u[top, 2] = -depth
        force, energy = model.evaluate(u)
        energies.append(energy)
        drives.append(force[top, 2].sum())
    assert (np.diff(energies) > 0).all()
    assert max(drives) < 0 and np.isfinite(drives).all()


def cantilever(name: ModelName, across: int, nu: float) -> float:
    """Deflection of a beam 5 times as long as deep under a load at its tip, over Timoshenko's."""
    length, depth, modulus, load = 0.1, 0.02, 642.55, 1e-3
    nodes, tets = box((5 * across, across, across), depth / across)
    fixed = nodes[:, 0] < 1e-9
    model = ElasticModel(TetMesh(nodes, tets, fixed), Material(modulus, nu, 1050.0), name)
    sides = (nodes[:, 1:] < 1e-9) | (nodes[:, 1:] > depth - 1e-9)
    shares = np.where(nodes[:, 0] > length - 1e-9, 0.5 ** sides.sum(axis=1), 0.0)
    shares /= shares.sum()
    loads = np.zeros_like(nodes)
    loads[:, 2] = -load * shares
    u = solve_static(model, np.repeat(~fixed, 3), loads, 1e-9)
    second, shear = depth**4 / 12, modulus / (2 * (1 + nu))
    factor = 10 * (1 + nu) / (12 + 11 * nu)
    exact = load * length**3 / (3 * modulus * second) + load * length / (factor * shear * depth**2)
    return float(-(u[:, 2] @ shares) / exact)


def test_plain_tetrahedra_lock_and_smoothed_ones_reach_timoshenko() -> None:
    """Two elements over the depth, nu = 0.47; nearly incompressible at 0.499, 4 elements too."""
    assert cantilever('linear', 2, 0.47) == pytest.approx(0.235, abs=0.005)
    assert 0.85 < cantilever('linear_smoothed', 2, 0.47) < 1.0
    assert cantilever('linear', 2, 0.499) < 0.06
    assert cantilever('linear_smoothed', 2, 0.499) > 0.65
    assert cantilever('linear_smoothed', 4, 0.499) > 0.9


def test_a_static_solution_that_is_not_reached_is_refused() -> None:
    nodes, tets = box((2, 1, 1), 0.01)
    model = model_of(nodes, tets, 'linear')
    load = np.zeros_like(nodes)
    load[0, 2] = 1e-3
    with pytest.raises(MeshError, match='held by fixed nodes'):
        solve_static(model, np.ones(nodes.size, bool), load)


@every_model
def test_after_a_cut_every_model_equals_a_rebuild(name: ModelName) -> None:
    for seed in (0, 1, 5):
        rng = np.random.default_rng(seed)
        nodes, tets = shuffled_box(np.array([3, 3, 2]), 0.005, 0.15, rng)
        mesh = TetMesh(nodes, tets)
        model, method = ElasticModel(mesh, LIVER, name), make_method(CuttingSettings())
        path = random_stroke(('plane', 'arc', 'twist')[seed % 3], nodes, 0.005, rng)
        model.force(1e-4 * rng.normal(size=nodes.shape))
        for result in results_along(method, mesh, path):
            if not result.delta.empty:
                model.update(mesh.apply(result.delta))
        fresh = ElasticModel(mesh, LIVER, name)
        assert mesh.topology > 0
        u = 1e-4 * rng.normal(size=mesh.rest.shape)
        ours, theirs = model.force(u), fresh.force(u)
        np.testing.assert_allclose(ours, theirs, atol=1e-12 * np.abs(theirs).max())
        np.testing.assert_allclose(model.mass, fresh.mass, rtol=1e-12)
        np.testing.assert_allclose(model.diagonal, fresh.diagonal, rtol=1e-10)
        every = np.arange(mesh.node_count)
        np.testing.assert_allclose(
            model.frequency_rows(every), fresh.frequency_rows(every), rtol=1e-10
        )


@every_model
def test_the_same_history_gives_the_same_bits(name: ModelName) -> None:
    nodes, tets = irregular_box((3, 3, 2), 0.01, 5)
    outcomes = []
    for _ in range(2):
        model, rng = model_of(nodes, tets, name), np.random.default_rng(5)
        forces = [model.force(rng.normal(size=nodes.shape) * 5e-3) for _ in range(4)]
        outcomes.append(np.array(forces).tobytes())
    assert outcomes[0] == outcomes[1]


def test_the_cantilever_converges_between_first_and_second_order() -> None:
    errors = [abs(1 - cantilever('linear', across, 0.3)) for across in (2, 4)]
    assert 1.0 < np.log2(errors[0] / errors[1]) < 2.0
    errors = [abs(1 - cantilever('linear_smoothed', across, 0.47)) for across in (2, 4)]
    assert 1.0 < np.log2(errors[0] / errors[1]) < 2.0


@pytest.mark.parametrize(('name', 'error'), [('linear', 0.6), ('linear_smoothed', 0.04)])
def test_the_first_bending_frequency_of_a_cantilever(name: ModelName, error: float) -> None:
    """Against a slender beam, 8 times as long as deep: Timoshenko's is slower by one per cent."""
    length, depth, modulus, density = 0.12, 0.015, 5000.0, 1000.0
    nodes, tets = box((16, 2, 2), depth / 2)
    free = np.repeat(nodes[:, 0] > 1e-9, 3)
    model = model_of(nodes, tets, name, Material(modulus, 0.3, density))
    root = 1 / np.sqrt(np.repeat(model.mass, 3))[free]
    stiffness = model.dense()[np.ix_(free, free)]
    # One along each of the equal sides.
    found = np.sqrt(np.linalg.eigvalsh(root[:, None] * stiffness * root)[:2].mean())
    slender = 1.875104**2 / length**2 * np.sqrt(modulus * depth**2 / 12 / density)
    assert found == pytest.approx(slender, rel=error)
    assert (found > 1.2 * slender) == (name == 'linear')
