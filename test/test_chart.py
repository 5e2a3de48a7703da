"""The chart: references against formulas, fronts, what it writes; limits of stability."""

import csv
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from bench.accuracy import chart
from bench.accuracy import integrator_limits as stability_report
from bench.accuracy.chart import THESIS, cost_for, sentence, write_chart
from bench.accuracy.contact_problems import FootprintPress, Sliding
from bench.accuracy.front import read_points, reasons_off_front, scenes, standing
from bench.accuracy.integrator_limits import highest_mode, measured_limit
from bench.accuracy.measure import Point, cpu_per_second, with_front
from bench.accuracy.panels import static_problems
from bench.accuracy.peer_points import peer_points
from bench.accuracy.problems import AfterCut, Cantilever
from bench.accuracy.reference import HexGrid, Solid, exact_beam, extrapolated, graded
from bench.accuracy.region import LocalPalpation, describe
from bench.accuracy.reproduction import block_100, block_258, efficiency, orders
from bench.accuracy.vibration import Vibration
from bench.common.meshes import end_load, kuhn_block
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_task
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

pytestmark = pytest.mark.long

BEAM = Solid((0.10, 0.02, 0.02), 5000.0, 0.3)


def test_the_exact_beam_is_timoshenkos_under_a_small_load_and_the_elastica_when_slender() -> None:
    length, width, height = BEAM.size
    load, modulus = 1e-6, BEAM.youngs_modulus
    inertia, area = width * height**3 / 12, width * height
    shear = 10 * 1.3 / (12 + 11 * 0.3) * modulus / 2.6 * area
    small = load * length**3 / (3 * modulus * inertia) + load * length / shear
    assert exact_beam(BEAM, load).down == pytest.approx(small, rel=1e-5)
    slender = Solid((0.10, 1e-4, 1e-4), 5000.0, 0.0)
    # Bisshopp and Drucker 1945, P L^2 / E I = 2.
    found = exact_beam(slender, 2 * 5000.0 * 1e-16 / 12 / 0.01)
    assert found.down == pytest.approx(0.04935, rel=1e-3)
    assert found.slope == pytest.approx(0.7817, rel=1e-3)


def test_the_reference_solver_stretches_a_bar_exactly() -> None:
    solid = Solid((0.03, 0.01, 0.01), 5000.0, 0.3)
    grid = HexGrid(solid, (graded(0.03, 2), graded(0.01, 1), graded(0.01, 2, (0.0,))))
    x = grid.places
    held = [grid.components(x[:, axis] < 1e-9, axis) for axis in range(3)]
    pulled = grid.components(x[:, 0] > 0.03 - 1e-9, 0)
    dofs = np.unique(np.concatenate([*held, pulled]))
    u = grid.solve(np.zeros(len(x)), dofs, np.where(np.isin(dofs, pulled), 3e-4, 0.0))
    assert (grid.stiffness @ u)[pulled].sum() == pytest.approx(5000.0 * 1e-4 * 0.01, rel=1e-9)


@pytest.mark.thorough
def test_the_reference_beam_vibrates_as_euler_and_bernoulli_say_for_slender_ones() -> None:
    omega, _ = Vibration().reference
    slender = 1.875104**2 * np.sqrt(5000.0 * 0.02**2 / 12 / 1050.0) / 0.1**2
    assert 0.95 * slender < omega < slender  # shear and the section's inertia slow it


def test_extrapolation_finds_the_limit_of_a_geometric_sequence() -> None:
    found = extrapolated(*(3.0 - 0.4 * 0.3**k for k in range(3)))
    assert found.value == pytest.approx(3.0, rel=1e-12)


def test_loads_and_meshes_of_the_chart_are_what_they_say() -> None:
    mesh = kuhn_block((5, 2, 2), BEAM.size)
    assert mesh.volumes().min() > 0
    assert mesh.volumes().sum() == pytest.approx(np.prod(BEAM.size))
    np.testing.assert_allclose(end_load(mesh, BEAM, 0.5).sum(axis=0), [0, 0, -0.5], atol=1e-12)


@pytest.mark.thorough
def test_smoothed_strains_cure_the_locking_that_plain_elements_show() -> None:
    problem = Cantilever(0.47)
    # The reference of the full chart; computed there, and here from two coarser grids only.
    vars(problem)['reference'] = extrapolated(*(problem._half(k) for k in (2, 3, 4)))
    plain, smoothed = (problem.rest(m, 2).errors for m in ('linear', 'linear_smoothed'))
    assert 0.70 < plain.displacement < 0.80
    assert smoothed.displacement < 0.15


def test_the_notched_block_of_the_chart_is_cut_half_through_and_moves() -> None:
    problem = AfterCut()
    mesh = problem.whole(6)
    assert problem.cut(mesh)
    lips = mesh.rest[mesh.triangles[mesh.triangle_kind == 1]]
    sides = np.cross(lips[:, 1] - lips[:, 0], lips[:, 2] - lips[:, 0])
    area = np.linalg.norm(sides, axis=1).sum() / 4
    assert area == pytest.approx(0.02 * 0.02, rel=0.3)
    dynamics = problem.dynamics('linear', 6, TimeStepping('symplectic_euler'))
    dynamics.velocity[dynamics.mesh.fixed == 0] = 1e-4
    cost, step, substeps = cpu_per_second(dynamics)
    assert cost > 0 and step * substeps == pytest.approx(1 / 30)


def point(model: str, integrator: str, resolution: int, cost: float, error: float) -> Point:
    return Point('cantilever_0.47', model, integrator, resolution, 6 * resolution**3, 1.0, 30, cost,
                 error, error)  # fmt: skip


POINTS = [
    point('linear', 'rk4', 2, 0.1, 0.4),
    point('linear', 'rk4', 4, 1.6, 0.1),
    point('linear_smoothed', 'symplectic_euler', 2, 0.05, 0.1),
    point('linear_smoothed', 'symplectic_euler', 4, 0.8, 0.0251),
]


def test_only_what_nothing_beats_in_both_is_on_the_front() -> None:
    front = [p.front for p in with_front(POINTS)]
    assert front == [False, False, True, True]


@functools.cache
def charted() -> tuple[list[Point], dict[str, TissueSettings]]:
    """The points of the chart, and the shipped scenes."""
    return read_points(Path(__file__).parents[1] / 'docs' / 'charts' / 'points.csv'), scenes()


@pytest.mark.parametrize('scene', scenes())
def test_the_method_of_each_shipped_scene_lies_on_the_front_of_the_chart(scene: str) -> None:
    points, shipped = charted()
    found = standing(points, scene, shipped[scene])
    assert found and not any(found.values()), found


def test_a_method_that_another_beats_is_named_with_what_beats_it() -> None:
    points = with_front([*POINTS, point('corotational', 'symplectic_euler', 2, 0.04, 0.09)])
    why = reasons_off_front(points, 'cantilever_0.47', ('linear_smoothed', 'symplectic_euler'))
    assert why == ['corotational by symplectic_euler is faster and as near with 48 tetrahedra']
    why = reasons_off_front(points, 'cantilever_0.47', ('linear', 'rk4'))
    assert 'another method on another mesh is faster and as near' in why[-1]
    assert reasons_off_front(points, 'indentation', ('linear', 'rk4')) == [
        'it has not been measured there'
    ]


def test_the_cost_of_an_error_is_read_off_the_line_of_a_method() -> None:
    line = POINTS[:2]
    assert cost_for(line, 0.2) == pytest.approx(0.4)
    assert cost_for(line, 0.5) == pytest.approx(0.1)
    assert cost_for(line, 0.05) is None
    text = sentence(POINTS)
    assert '10 % costs at most 0.05 s a second, with linear_smoothed by symplectic_euler' in text
    assert '1 % was not reached' in text


@pytest.mark.thorough
def test_page_table_and_a_picture_by_panel_are_written(tmp_path: Path) -> None:
    from dataclasses import replace

    names = [problem.name for problem in (*static_problems(), Vibration())]
    points = with_front([replace(p, problem=name) for name in names for p in POINTS])
    names.append(LocalPalpation.name)
    points += with_front(
        [replace(POINTS[3], problem=names[-1], region=r) for r in ('off', 'on 0.001', 'budget 9')]
    )
    write_chart(tmp_path, points, (6.0, 6.1))
    page = (tmp_path / 'charts.md').read_text()
    for name in names:
        assert f'(charts/{name}.png)' in page
        assert (tmp_path / 'charts' / f'{name}.png').stat().st_size > 10_000
    with (tmp_path / 'charts' / 'points.csv').open() as table:
        rows = list(csv.DictReader(table))
    assert len(rows) == len(points)
    assert {(row['model'], row['integrator']) for row in rows} >= {THESIS}


def test_peers_that_came_to_rest_are_on_the_cantilevers_eight_curves_at_most() -> None:
    for name in ('cantilever_0.3', 'cantilever_0.47'):
        peers = peer_points(name)
        assert {text.split()[0] for text in peers} == {'mujoco-core', 'newton'}
        assert len(MODELS) + 1 + len(peers) <= 8
        for line in peers.values():
            assert [p.tetrahedra for p in line] == sorted(p.tetrahedra for p in line)
            assert all(0 < p.displacement_error < 1 and p.cpu_per_second > 0 for p in line)
    assert not peer_points('indentation')


@pytest.mark.thorough
def test_a_sphere_on_scattered_nodes_is_the_quadratic_one_and_slides_without_ripple() -> None:
    press = FootprintPress().rest('linear_smoothed', 4).errors
    assert press.force < 0.05 and press.displacement < press.force
    assert Sliding().rest('linear_smoothed', 4).errors.force < 0.10


def test_the_chart_prints_the_points_for_machines_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(chart, 'measure', lambda progress, coarse: POINTS)
    monkeypatch.setattr(chart, 'reference_cost', lambda: 6.0)
    monkeypatch.setattr(chart, 'write_chart', lambda folder, points, yardsticks: None)
    chart.run_chart(tmp_path, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told['nanoseconds_a_tetrahedron'] == {'before': 6.0, 'after': 6.0}
    assert [Point(**point) for point in told['points']] == POINTS


@pytest.mark.thorough
def test_an_active_region_errs_less_with_a_smaller_tolerance_and_with_more_nodes() -> None:
    problem = LocalPalpation()
    regions = {describe(active): active for active in problem.regions(2)}
    errors = {name: problem.palpate(2, active)[0] for name, active in regions.items()}
    on, budget = ([e for n, e in errors.items() if n.startswith(k)] for k in ('on', 'budget'))
    assert on[0].displacement > on[1].displacement
    assert on[2].displacement == pytest.approx(errors['off'].displacement, rel=0.2)
    assert budget[0].displacement > budget[1].displacement > budget[2].displacement
    assert errors['off'].displacement < 0.06


@pytest.mark.parametrize('model', ['linear', 'corotational_smoothed'])
@pytest.mark.parametrize('integrator', ['euler', 'symplectic_euler', 'rk4', 'implicit'])
def test_the_measured_limit_of_stability_is_that_of_theory(model: str, integrator: str) -> None:
    task = make_task(load_scene('block').tissue)
    elastic = ElasticModel(task.mesh, task.material, model)
    limit = measured_limit(task, elastic, integrator, *highest_mode(elastic))
    if integrator == 'implicit':
        assert limit.measured == limit.theory == np.inf
    else:
        assert limit.measured == pytest.approx(limit.theory, rel=0.01)
        assert limit.used <= 1.001 * limit.theory


def test_the_limits_are_printed_with_their_unit_and_whole_names(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setattr(stability_report, 'MODELS', ('corotational_smoothed',))
    stability_report.run_stability('block')
    said = capsys.readouterr().out
    assert 'Largest stable step of block, in ms' in said and '96 tetrahedra' in said
    for name in ('corotational_smoothed', 'symplectic_euler'):
        assert name in said


def test_the_limits_are_printed_for_machines_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stability_report, 'MODELS', ('linear',))
    stability_report.run_stability('block', as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert (told['scene'], told['tetrahedra'], told['beta']) == ('block', 96, 3e-3)
    limits = {limit['integrator']: limit for limit in told['limits']}
    assert limits['rk4']['measured'] == pytest.approx(limits['rk4']['theory'], rel=0.01)
    steps = told['frame'] / (told['safety'] * limits['rk4']['used'])
    assert limits['rk4']['substeps'] == np.ceil(steps)
    assert limits['implicit'] == {
        'model': 'linear', 'integrator': 'implicit',
        'used': None, 'theory': None, 'measured': None, 'substeps': 1,
    }  # fmt: skip


def test_the_blocks_of_the_thesis_have_its_numbers_of_nodes_and_tetrahedra() -> None:
    for mesh, nodes, tetrahedra in ((block_100(), 50, 100), (block_258(), 85, 258)):
        assert (mesh.node_count, len(mesh.tetrahedra)) == (nodes, tetrahedra)
        size = mesh.rest.max(axis=0) - mesh.rest.min(axis=0)
        assert mesh.volumes().sum() == pytest.approx(np.prod(size), rel=1e-9)


def test_table_4_1_of_the_thesis_holds() -> None:
    euler, rk4 = orders('euler'), orders('rk4')
    assert (euler.single, euler.total) == pytest.approx((2, 1), abs=0.05)
    assert (rk4.single, rk4.total) == pytest.approx((5, 4), abs=0.05)


def test_table_4_2_of_the_thesis_does_not_follow_from_its_constants() -> None:
    euler, rk4 = efficiency('euler'), efficiency('rk4')
    assert euler.theory == pytest.approx(2e-5, rel=1e-3)  # printed: 0.0016
    assert 0.004 < rk4.theory < 0.005  # printed: 0.032
    assert euler.measured == pytest.approx(euler.theory, rel=0.01)
    assert rk4.measured == pytest.approx(rk4.theory, rel=0.01)
