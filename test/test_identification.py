"""Identified materials: the fit on known laws, constants that no bag determines, the command."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.recordings import resimulate_command
from cutting_trainer.recordings.resimulate_command import refuse_lost_changes
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies import cluster, fit, identification
from cutting_trainer.studies.bag_collection import find_bags
from cutting_trainer.studies.cluster import lost
from cutting_trainer.studies.evaluation import Job, Result
from cutting_trainer.studies.fit import Fit, Observation
from cutting_trainer.studies.identification import (
    Linearised,
    Prior,
    estimates_of,
    identifiability,
    prior_of,
    window_means,
)
from cutting_trainer.studies.identify_command import (
    IdentifyOptions,
    _Running,
    identify,
    run_identification,
)
from cutting_trainer.studies.refined_mesh import refine
from cutting_trainer.tissue_sim.simulation.serialisation import ObjectState

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


def fitted(seed: int, true: Callable = law, computed: Callable = law) -> Linearised:
    random = np.random.default_rng(seed)
    clean = [true(bag, *TRUTH.values()) for bag in range(6)]
    observed = [Observation(TIMES, f + NOISE * random.standard_normal(f.shape)) for f in clean]
    fit = Fit(observed, PRIORS, NOISE, partial(compute, law=computed))
    return fit.solve(fit.start(np.log([3000.0, 400.0])), 0.95)


def test_a_known_law_is_found_and_its_intervals_hold_the_truth(monkeypatch) -> None:
    monkeypatch.setattr(identification, 'FORCE_SPREAD', 0.0)
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


def test_a_common_error_of_all_forces_stays_within_the_intervals() -> None:
    def weak(bag: int, modulus: float, toughness: float) -> np.ndarray:
        return 0.93 * law(bag, modulus, toughness)

    found = fitted(0, computed=weak)
    errors = np.abs(found.estimates - np.log(list(TRUTH.values())))
    assert (errors > 0.06).all()
    assert (errors < found.half_widths).all()
    assert found.half_widths == pytest.approx([0.1, 0.1], rel=0.2)


def test_a_point_that_cannot_be_computed_does_not_look_like_a_fit() -> None:
    def failing(wanted: Iterable[tuple[int, tuple[float, ...]]]) -> dict:
        return {
            (bag, point): law(bag, *point) * (np.nan if point[0] > 9000.0 else 1.0)
            for bag, point in wanted
        }

    observed = [Observation(TIMES, law(bag, *TRUTH.values())) for bag in range(3)]
    found = Fit(observed, PRIORS, NOISE, failing).solve(np.log([3000.0, 400.0]), 0.95)
    assert np.exp(found.estimates) == pytest.approx(list(TRUTH.values()), rel=0.02)


def test_a_search_that_stops_where_a_step_away_the_fit_is_better_begins_anew(monkeypatch) -> None:
    begins, search = [], fit.least_squares

    def stops_at_once(objective: Callable, begin: np.ndarray, **options: object) -> object:
        begins.append(np.exp(begin))
        return search(objective, begin, **options) if len(begins) > 1 else SimpleNamespace(x=begin)

    monkeypatch.setattr(fit, 'least_squares', stops_at_once)
    observed = [Observation(TIMES, law(bag, *TRUTH.values())) for bag in range(3)]
    found = Fit(observed, PRIORS, NOISE, compute).solve(np.log([5000.0, 150.0]), 0.95)
    assert np.exp(found.estimates) == pytest.approx(list(TRUTH.values()), rel=0.02)
    assert len(begins) == 2 and begins[1][0] == pytest.approx(5000.0 * np.exp(fit.DIFFERENCE))


def test_a_constant_that_no_bag_touches_at_the_start_is_looked_at_again() -> None:
    def entering(wanted: Iterable[tuple[int, tuple[float, ...]]]) -> dict:
        return {
            (bag, point): law(bag, *point) * [float(point[1] < 200.0), 1.0, 1.0]
            for bag, point in wanted
        }

    observed = [Observation(TIMES, law(bag, *TRUTH.values())) for bag in range(3)]
    found = Fit(observed, PRIORS, NOISE, entering).solve(np.log([6500.0, 400.0]), 0.95)
    assert np.exp(found.estimates) == pytest.approx(list(TRUTH.values()), rel=0.02)


def test_slopes_of_the_coarser_mesh_lead_to_the_solution_of_the_finer_one() -> None:
    asked = []

    def softer(wanted: Iterable[tuple[int, tuple[float, ...]]]) -> dict:
        asked.extend(wanted := list(wanted))
        return {(bag, point): 0.9 * law(bag, *point) for bag, point in wanted}

    observed = [Observation(TIMES, law(bag, *TRUTH.values())) for bag in range(3)]
    coarse = Fit(observed, PRIORS, NOISE, compute)
    begin = coarse.solve(np.log([5000.0, 200.0]), 0.95).estimates
    alone = Fit(observed, PRIORS, NOISE, softer).solve(begin, 0.95)
    sessions = len(asked)
    led = Fit(observed, PRIORS, NOISE, softer, coarse.slopes).solve(begin, 0.95)
    assert led.estimates == pytest.approx(alone.estimates, abs=2e-3)
    assert led.half_widths == pytest.approx(alone.half_widths, rel=0.02)  # by its own slopes
    assert len(asked) - sessions < sessions


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


def test_what_the_mesh_changed_moves_the_estimate_on_and_widens_its_interval() -> None:
    plain = problem([np.ones(600)], ('youngs_modulus',))
    refined = replace(plain, mesh_change=np.array([-0.15]))
    assert refined.estimates - plain.estimates == pytest.approx([-0.05])
    assert refined.half_widths**2 - plain.half_widths**2 == pytest.approx(
        [(1.96 * 0.05) ** 2], 1e-3
    )


def test_two_meshes_give_the_constants_of_a_fine_one() -> None:
    def on_mesh(error: float) -> Callable:
        return lambda bag, modulus, toughness: law(bag, (1 + error) * modulus, toughness)

    coarse = fitted(0, computed=on_mesh(-0.2))
    finer = fitted(0, computed=on_mesh(-0.05))  # quadratic in the size of elements
    found = replace(finer, mesh_change=finer.estimates - coarse.estimates)
    assert np.exp(finer.estimates[0]) > 1.04 * TRUTH['youngs_modulus']
    assert np.exp(found.estimates) == pytest.approx(list(TRUTH.values()), rel=0.01)


def test_jumps_of_a_cut_do_not_make_an_interval_narrow() -> None:
    def jumping(bag: int, modulus: float, toughness: float) -> np.ndarray:
        random = np.random.default_rng([bag, int(modulus * 1e3), int(toughness * 1e3)])
        early = TIMES[:, None] > random.uniform(2.0, 2.5)
        return law(bag, modulus, toughness) * np.where(early, 0.2, 1.0)

    inside = dict.fromkeys(TRUTH, 0)
    for seed in range(20):
        for name, found in estimates_of(fitted(seed, jumping, jumping), PRIORS).items():
            inside[name] += found.low <= TRUTH[name] <= found.high
    # Of 20 draws with 95 % each, fewer than 16 are inside once in some hundred.
    assert min(inside.values()) >= 16


def test_a_rare_draw_of_bags_does_not_decide_an_interval() -> None:
    plain = problem([np.random.default_rng(3).standard_normal(600)], ('toughness',))
    (residuals, *_), (column, *_) = plain.residuals, plain.jacobians
    bags = replace(
        plain,
        residuals=[residuals] * 6 + [0.0 * residuals] * 4,
        jacobians=[column] * 6 + [0.0 * column] * 4,
        prior_mean=np.array([40.0]),  # where a draw without any cut leads
    )
    assert bags.half_widths[0] < 0.1


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


def test_a_material_of_which_nothing_can_be_computed_is_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failed(client: object, jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        for job in jobs:
            yield job, Result({}, 'the tissue has no rest', 0, job.identity, 0.0, 0.0, 0)

    options = IdentifyOptions((str(SAMPLES / 'palpation'),), tmp_path, ('youngs_modulus',))
    bags = find_bags(options.bags, tmp_path)
    monkeypatch.setattr(cluster, 'compute', failed)
    with pytest.raises(
        SessionError, match=r'palpation cannot be computed: \d+ .*: the tissue has no'
    ):
        identify(bags, options, None)


def test_a_session_that_no_worker_could_compute_is_tried_once_more(monkeypatch) -> None:
    options = IdentifyOptions((str(SAMPLES / 'palpation'),), Path(), ('youngs_modulus',))
    bags, tries = find_bags(options.bags, Path()), list[float]()
    felt = np.zeros((3, 3))

    def once(client: object, jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        for job in jobs:
            tries.append(job.setting.changes['tissue.material.youngs_modulus'])
            first = tries.count(tries[-1]) == 1
            found = Result({}, 'gone' if first else '', 0, job.identity, 0.0, 0.0, 0, lost=first)
            yield job, replace(found, series=None if first else felt)

    monkeypatch.setattr(cluster, 'compute', once)
    running = _Running(bags, [Observation(TIMES, felt)], options.parameters, {}, None)
    assert running.compute([(0, (5000.0,))])[0, (5000.0,)] is felt and tries == [5000.0, 5000.0]
    monkeypatch.setattr(
        cluster, 'compute', lambda client, jobs: [(j, lost(j, 'gone')) for j in jobs]
    )
    with pytest.raises(SessionError, match='palpation cannot be computed now: gone'):
        running.compute([(0, (5000.0,))])


def test_a_mesh_cannot_be_changed_where_a_bag_begins_with_one(monkeypatch) -> None:
    bag = open_bag(SAMPLES / 'palpation')
    beginning = find_beginning(bag)
    refuse_lost_changes(bag, ['tissue.mesh'])
    later = replace(beginning, tissue=ObjectState('', b''))
    monkeypatch.setattr(resimulate_command, 'find_beginning', lambda _: later)
    refuse_lost_changes(bag, ['tissue.model'])
    with pytest.raises(SessionError, match=r'tissue\.mesh cannot be changed: the bag begins'):
        refuse_lost_changes(bag, ['tissue.model', 'tissue.mesh'])


def test_a_constant_that_there_is_not_is_refused_before_anything_is_computed(
    tmp_path: Path,
) -> None:
    options = IdentifyOptions((str(SAMPLES / 'palpation'),), tmp_path / 'out', ('youngs',))
    with pytest.raises(SessionError, match='--parameter youngs: there are'):
        run_identification(options)
    assert not options.output.exists()
