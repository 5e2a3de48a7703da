"""The stiffening law at one point: derivatives, exact solutions, and no failure inside out."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cutting_trainer.tissue_sim.elasticity.rotation import LANES
from cutting_trainer.tissue_sim.elasticity.stiffening import (
    MAX_EXPONENT,
    MIN_RATIO,
    blended_difference,
    linear_stress,
    stiffening_stress,
    tangent_bound,
)
from cutting_trainer.tissue_sim.elasticity.stiffening_simd import (
    MAX_STRETCH,
    MIN_STRETCH,
    RATIO,
    SLOTS_OF_LAW,
    STRESS,
    VOLUME,
    law_in_lanes,
    tangents_in_lanes,
)

MU, LAMBDA, B = 1862.0, 16760.0, 6.0
CONSTANTS = np.array([MU, -0.3 * MU, LAMBDA, B])
LAW = np.array([MU, 0.0, LAMBDA, B])


def total(h: np.ndarray, tolerance: float, constants: np.ndarray) -> tuple[float, np.ndarray]:
    """Energy and stress of the blended law."""
    p, linear = np.zeros(9), np.zeros(9)
    energy = linear_stress(h, constants, linear)
    square = float(h @ h)
    if square >= tolerance**2:
        energy += blended_difference(h, square, constants, tolerance, p, linear)
    return energy, p + linear


@pytest.mark.parametrize('tolerance', [0.0, 0.05, 0.4])
@given(seed=st.integers(0, 10**6), size=st.sampled_from([0.03, 0.07, 0.3, 1.0]))
@settings(max_examples=60, deadline=None)
def test_stress_is_the_derivative_of_the_energy_blended_or_inside_out(
    tolerance: float, seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    h, d = rng.normal(size=9) * size, rng.normal(size=9)
    step = 1e-6
    slope = (total(h + step * d, tolerance, CONSTANTS)[0]
             - total(h - step * d, tolerance, CONSTANTS)[0]) / (2 * step)  # fmt: skip
    expected = total(h, tolerance, CONSTANTS)[1] @ d
    scale = np.linalg.norm(total(h, tolerance, CONSTANTS)[1]) * np.linalg.norm(d)
    assert slope == pytest.approx(expected, abs=2e-4 * scale + 1e-6)


def stress_of(f: np.ndarray, constants: np.ndarray = LAW) -> np.ndarray:
    p = np.zeros(9)
    stiffening_stress((f - np.eye(3)).ravel(), constants, p)
    return p.reshape(3, 3)


@pytest.mark.parametrize('stretch', [0.7, 0.9, 1.2, 1.4])
def test_uniaxial_shear_and_volumetric_stress_are_those_worked_out_by_hand(stretch: float) -> None:
    s, t = stretch, 0.95
    x = s**2 + 2 * t**2 - 3 - 2 * math.log(s * t * t)
    rise, log = MU * math.exp(B * x), math.log(s * t * t)
    p = stress_of(np.diag([s, t, t]))
    assert p[0, 0] == pytest.approx(rise * (s - 1 / s) + LAMBDA * log / s, rel=1e-12)
    assert p[1, 1] == pytest.approx(rise * (t - 1 / t) + LAMBDA * log / t, rel=1e-12)
    k = stretch - 1
    sheared = np.eye(3)
    sheared[0, 1] = k
    assert stress_of(sheared)[0, 1] == pytest.approx(MU * math.exp(B * k * k) * k, rel=1e-12)
    x = 3 * s**2 - 3 - 6 * math.log(s)
    expected = MU * math.exp(3 * x) * (s - 1 / s) + 3 * LAMBDA * math.log(s) / s
    assert 3 * x < MAX_EXPONENT
    milder = np.array([MU, 0.0, LAMBDA, 3.0])
    assert stress_of(s * np.eye(3), milder)[2, 2] == pytest.approx(expected, rel=1e-12)


def test_small_strains_are_linear_and_rotations_free() -> None:
    rng = np.random.default_rng(1)
    h = rng.normal(size=9) * 1e-6
    p, linear = np.zeros(9), np.zeros(9)
    stiffening_stress(h, CONSTANTS, p)
    linear_stress(h, CONSTANTS, linear)
    np.testing.assert_allclose(p, linear, atol=2e-5 * np.abs(linear).max())
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert np.abs(stress_of(turn)).max() < 1e-10 * MU


def test_the_energy_is_finite_at_any_shape_and_rises_towards_inside_out() -> None:
    p = np.zeros(9)
    shares = np.linspace(1.0, -1.5, 200)
    energies = [stiffening_stress(np.array([s - 1, 0, 0, 0, 0, 0, 0, 0, 0]), CONSTANTS, p)
                for s in shares]  # fmt: skip
    assert np.isfinite(energies).all()
    assert (np.diff(energies) > 0).all()
    assert min(shares) < 0 < MIN_RATIO
    for h in (np.zeros(9), -np.eye(3).ravel(), 1e3 * np.ones(9)):
        assert np.isfinite(stiffening_stress(h, CONSTANTS, p)) and np.isfinite(p).all()


@given(seed=st.integers(0, 10**6), size=st.sampled_from([0.02, 0.1, 0.3]))
@settings(max_examples=60, deadline=None)
def test_no_plane_wave_is_stiffer_than_the_bound_of_the_tangent(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    h = rng.normal(size=9) * size
    f = np.eye(3) + h.reshape(3, 3)
    if np.linalg.det(f) < 0.3:
        return
    found = np.zeros(3)
    bound = tangent_bound(h, CONSTANTS, found)
    assert found[0] == pytest.approx(np.linalg.det(f))
    np.testing.assert_allclose(found[1:], np.linalg.svd(f)[1][[2, 0]], rtol=1e-6)
    left, _, right = np.linalg.svd(f)
    waves = [np.outer(left[:, i], right[i]) for i in range(3)]
    waves += [np.outer(a / np.linalg.norm(a), b / np.linalg.norm(b))
              for a, b in rng.normal(size=(20, 2, 3))]  # fmt: skip
    stiffness = []
    for wave in waves:
        ahead, behind = (stress_of(f + s * 1e-5 * wave, CONSTANTS) for s in (1, -1))
        stiffness.append(np.sum((ahead - behind) * wave) / 2e-5)
    assert max(stiffness) < bound * (1 + 1e-3) + 1.0
    if bound > 1.001 * (2 * 0.7 * MU + LAMBDA):  # that of the law, which one of the axes meets
        assert max(stiffness) > 0.98 * bound


def in_lanes(h: np.ndarray) -> np.ndarray:
    """A chunk of gradients, shape (LANES, 9), each of 1 m^3."""
    chunk = np.ones((SLOTS_OF_LAW, LANES))
    chunk[:9] = h.T
    assert VOLUME >= 9
    return chunk.ravel()


@pytest.mark.parametrize('constants', [CONSTANTS, LAW, np.array([0.0, 0.3 * MU, 0.0, B]),
                                       np.array([MU, 0.0, LAMBDA, 0.0])])  # fmt: skip
@pytest.mark.parametrize('tolerance', [0.0, 0.05])
@pytest.mark.parametrize('size', [0.02, 0.05, 0.2, 0.8])
def test_vector_lanes_give_the_stress_energy_and_stretch_of_each_point(
    constants: np.ndarray, tolerance: float, size: float
) -> None:
    rng = np.random.default_rng(2)
    h = rng.normal(size=(LANES, 9)) * size
    h[0], h[1] = 0.0, -np.eye(3).ravel()  # unstrained; without volume
    expected, energy = np.zeros((LANES, 9)), 0.0
    for point, p in zip(h, expected, strict=True):
        linear = np.zeros(9)
        if np.linalg.norm(point) >= tolerance:
            energy += blended_difference(point, point @ point, constants, tolerance, p, linear)
    chunk = in_lanes(h)
    assert law_in_lanes(chunk, constants, tolerance, 0.0) == pytest.approx(energy, rel=1e-10)
    found = chunk.reshape(-1, LANES)[STRESS : STRESS + 9].T
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())
    chunk = in_lanes(h)
    tangents_in_lanes(chunk, constants)
    slots = chunk.reshape(-1, LANES)
    for lane, point in enumerate(h):
        f = np.eye(3) + point.reshape(3, 3)
        stretches = np.linalg.svd(f)[1]
        assert slots[RATIO, lane] == pytest.approx(np.linalg.det(f), abs=1e-12)
        assert slots[MAX_STRETCH, lane] == pytest.approx(stretches[0], rel=1e-6)
        assert slots[MIN_STRETCH, lane] == pytest.approx(stretches[2], abs=1e-3)
