"""Identified materials: the fit on known laws, constants that no bag determines, the command."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.fit import Fit, Observation
from cutting_trainer.studies.identification import (
    Linearised,
    Prior,
    estimates_of,
    identifiability,
    prior_of,
    window_means,
)
from cutting_trainer.studies.identify_command import IdentifyOptions, run_identification
from cutting_trainer.studies.refined_mesh import refine

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
TRUTH = {'youngs_modulus': 7000.0, 'toughness': 150.0}
TIMES = np.arange(0.0, 3.0, 0.01)
NOISE = 0.003
PRIORS = {name: Prior(value * 1.6, 1.0, 'test') for name, value in TRUTH.items()}


def law(bag: int, modulus: float, toughness: float) -> np.ndarray:
    """A stiffening press along z and a cut along x, deeper from bag to bag; [N], shape (n, 3)."""
    depth = (1.0 + 0.1 * bag) * np.sin(np.pi * TIMES / 3.0) ** 2
    press = 2e-5 * modulus * depth ** (1.0 + 0.1 * modulus / 7000.0)
    cut = 1e-3 * toughness * np.maximum(depth - 0.5, 0.0)
    return np.stack([cut, 0.0 * cut, press], axis=1)


def compute(wanted: Iterable[tuple[int, tuple[float, ...]]], law: Callable = law) -> dict:
    return {(bag, point): law(bag, *point) for bag, point in wanted}


def fitted(seed: int, bags: int = 6) -> Linearised:
    random = np.random.default_rng(seed)
    clean = [law(bag, *TRUTH.values()) for bag in range(bags)]
    observed = [Observation(TIMES, f + NOISE * random.standard_normal(f.shape)) for f in clean]
    fit = Fit(observed, PRIORS, NOISE, compute)
    return fit.solve(np.log([3000.0, 400.0]), 0.95)


def test_a_known_law_is_found_and_its_intervals_hold_the_truth() -> None:
    inside = dict.fromkeys(TRUTH, 0)
    draws = 40
    for seed in range(draws):
        found = estimates_of(fitted(seed), PRIORS)
        for name, true in TRUTH.items():
            assert found[name].value == pytest.approx(true, rel=0.03)
            inside[name] += found[name].low <= true <= found[name].high
    # Of 40 draws with 95 % each, fewer than 34 are inside once in some thousand.
    assert min(inside.values()) >= 34
    widths = [np.log(e.high / e.low) for e in found.values()]
    assert max(widths) < 0.05


def test_a_point_that_cannot_be_computed_does_not_look_like_a_fit() -> None:
    def failing(wanted: Iterable[tuple[int, tuple[float, ...]]]) -> dict:
        return {
            (bag, point): law(bag, *point) * (np.nan if point[0] > 9000.0 else 1.0)
            for bag, point in wanted
        }

    observed = [Observation(TIMES, law(bag, *TRUTH.values())) for bag in range(3)]
    found = Fit(observed, PRIORS, NOISE, failing).solve(np.log([3000.0, 400.0]), 0.95)
    assert np.exp(found.estimates) == pytest.approx(list(TRUTH.values()), rel=0.02)


def problem(columns: list[np.ndarray], names: tuple[str, ...]) -> Linearised:
    random = np.random.default_rng(0)
    jacobian = np.column_stack(columns)
    return Linearised(
        names=names,
        at=np.zeros(len(names)),
        residuals=[0.3 * random.standard_normal(len(jacobian)) for _ in range(2)],
        jacobians=[jacobian, jacobian],
        prior_mean=np.zeros(len(names)),
        prior_spread=np.ones(len(names)),
    )


def test_what_bags_cannot_tell_is_said_and_what_they_tell_is_not() -> None:
    one, other = np.random.default_rng(1).standard_normal((2, 600))
    both = ('youngs_modulus', 'toughness')
    assert identifiability(problem([one, other], both)) == []
    (said,) = identifiability(problem([one, 0.0 * one], both))
    assert 'do not touch toughness' in said
    said_of_both = identifiability(problem([one, one + 1e-3 * other], both))
    assert 'cannot tell youngs_modulus from toughness' in said_of_both[0]
    assert 'cannot tell toughness from youngs_modulus' in said_of_both[1]


def test_an_error_along_the_change_by_the_mesh_widens_the_interval_and_is_taken_off() -> None:
    one, other = np.random.default_rng(2).standard_normal((2, 600))
    plain = problem([one], ('youngs_modulus',))
    along, across = replace(plain, mesh=[one, one]), replace(plain, mesh=[other, other])
    assert along.covariance[0, 0] > 50 * plain.covariance[0, 0]
    assert across.covariance[0, 0] == pytest.approx(plain.covariance[0, 0], rel=0.05)
    shifted = replace(across, residuals=[r + 4 / 3 * other for r in plain.residuals])
    assert shifted.estimates == pytest.approx(plain.estimates, abs=0.02)


def test_the_mesh_leaves_a_third_of_its_change_after_one_refinement() -> None:
    def coarse(bag: int, modulus: float, toughness: float) -> np.ndarray:
        return law(bag, modulus, toughness) * (1.0 + 0.04 * np.sin(5.0 * TIMES)[:, None])

    exact, refined = law, lambda *of: 0.25 * coarse(*of) + 0.75 * law(*of)  # quadratic
    observed = [Observation(TIMES, exact(bag, *TRUTH.values())) for bag in range(4)]
    for searched, other, is_refined in ((coarse, refined, False), (refined, coarse, True)):
        fit = Fit(observed, PRIORS, NOISE, partial(compute, law=searched))
        found = fit.solve(np.log([3000.0, 400.0]), 0.95)
        forces = [other(bag, *np.exp(found.at)) for bag in range(4)]
        found = fit.with_mesh(found, forces, is_refined=is_refined)
        left = np.concatenate([
            r - found.mesh_share * change
            for r, change in zip(found.residuals, found.mesh, strict=True)
        ])  # fmt: skip
        assert np.abs(left).max() < 0.1 * np.abs(np.concatenate(found.residuals)).max()


def test_bags_that_say_nothing_leave_the_prior() -> None:
    found = problem([np.zeros(600)], ('toughness',))
    estimate = estimates_of(found, {'toughness': PRIORS['toughness']})['toughness']
    assert np.log(estimate.high / estimate.low) == pytest.approx(2 * 1.96, rel=1e-3)


def test_priors_come_from_the_presets_or_from_the_scene() -> None:
    modulus = prior_of('youngs_modulus', 1.0)
    assert 'presets' in modulus.source and 642.55 < modulus.median < 570000
    assert prior_of('blade_friction', 2.0).median == 2.0


def test_window_means_are_those_of_whole_windows() -> None:
    values = np.column_stack([TIMES, 2 * TIMES, 0 * TIMES])
    means = window_means(TIMES, values)
    assert means.shape == (60, 3)
    assert means[1] == pytest.approx([0.07, 0.14, 0.0])


def test_a_refined_mesh_fills_the_same_volume_with_an_eighth_each() -> None:
    random = np.random.default_rng(3)
    points = np.vstack([np.zeros(3), np.eye(3), [[1.0, 1.0, 1.0]]])
    points += random.uniform(-0.1, 0.1, points.shape)
    tetrahedra = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    sides = points[tetrahedra][:, 1:] - points[tetrahedra][:, :1]
    tetrahedra[np.linalg.det(sides) < 0] = tetrahedra[np.linalg.det(sides) < 0][:, [0, 2, 1, 3]]
    finer, children = refine(points, tetrahedra)
    volumes = np.linalg.det(finer[children][:, 1:] - finer[children][:, :1]) / 6
    parents = np.abs(np.linalg.det(sides)) / 6
    assert volumes.reshape(2, 8) == pytest.approx(np.repeat(parents[:, None] / 8, 8, axis=1))
    assert len(finer) == 5 + 9  # the three edges between both are split once
    faces = np.sort(children[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    _, shared = np.unique(faces.reshape(-1, 3), axis=0, return_counts=True)
    assert np.count_nonzero(shared == 1) == 6 * 4 and shared.max() == 2


@pytest.mark.thorough
def test_the_command_finds_the_modulus_of_a_palpation_and_says_that_nothing_was_cut(
    tmp_path: Path,
) -> None:
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'identify', str(SAMPLES / 'palpation')]
    options = ['--parameter', 'youngs_modulus', '--parameter', 'toughness', '--workers', '1']
    ran = subprocess.run(
        [*command, *options, '-o', str(tmp_path / 'out'), '--json'],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    modulus = found['estimates']['youngs_modulus']
    assert modulus['value'] == pytest.approx(5400, rel=0.08)  # recorded on the same mesh
    assert any('do not touch toughness' in note for note in found['notes'])
    assert 'youngs_modulus' in (tmp_path / 'out' / 'material.yaml').read_text()
    assert 'data:image/png' in (tmp_path / 'out' / 'identification.html').read_text()


def test_a_constant_that_there_is_not_is_refused_before_anything_is_computed(
    tmp_path: Path,
) -> None:
    options = IdentifyOptions((str(SAMPLES / 'palpation'),), tmp_path / 'out', ('youngs',))
    with pytest.raises(SessionError, match='--parameter youngs: there are'):
        run_identification(options)
    assert not options.output.exists()
