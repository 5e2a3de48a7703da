"""Published experiments: sources, tolerances, what is printed; the fast cases are run."""

import json

import pytest

from bench.validate.blade import E0, FIRM, drawn
from bench.validate.case import Result
from bench.validate.cases import CASES, NOT_REPRODUCED
from bench.validate.command import run_validate, tables
from bench.validate.homogeneous import Cube, run_fat
from bench.validate.picture import curve, draw
from cutting_trainer.session.errors import SessionError

pytestmark = pytest.mark.long


def test_each_case_has_sources_and_a_tolerance_with_a_reason() -> None:
    assert len(CASES) >= 6
    for name, case in CASES.items():
        assert name == case.name and case.sources and 0 < case.tolerance < 1, name
        assert case.tolerance_reason and all(s.name and s.place for s in case.sources), name
        assert {s.how for s in case.sources} != {'computed'}, name
    assert all(one.reason and one.source.place for one in NOT_REPRODUCED)


def test_the_sphere_is_inside_of_its_tolerance_on_its_footprint_and_outside_on_a_triangle(
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_validate(['sphere'], quick=True, as_json=True)
    (case,) = json.loads(capsys.readouterr().out)['cases']
    inside = {r['model']: r['inside'] for r in case['results']}
    assert inside['linear_smoothed'] and not inside['linear_smoothed, triangle']
    assert all(r['cpu'] > 0 for r in case['results'])


def test_the_cube_has_the_stress_of_the_law_in_tension_and_shear() -> None:
    # mu exp(b x) (s^2 - 1/s) of an incompressible bar, where all points are beyond the tolerance.
    stretch = 1.3
    x = stretch**2 + 2 / stretch - 3
    mu = 5400.0 / 2 / 1.45
    exact = mu * 2.718281828 ** (6 * x) * (stretch**2 - 1 / stretch)
    cube = Cube('stiffening', 5400.0)
    assert cube.tension(stretch) == pytest.approx(exact, rel=0.02)
    assert cube.shear(1.0) == pytest.approx(mu, rel=1e-3)


@pytest.mark.parametrize('cell', [0.0053, pytest.param(0.0044, marks=pytest.mark.thorough)])
def test_the_steady_force_of_a_blade_is_toughness_times_its_depth(cell: float) -> None:
    found = drawn('stiffening', 187.0, E0, cell)
    assert found.force[0] == pytest.approx(187.0 * found.depth, rel=0.07)


@pytest.mark.parametrize(
    ('toughness', 'ratio'), [pytest.param(76.0, 1.5, marks=pytest.mark.thorough), (120.0, 0.5)]
)
def test_a_blade_that_slices_feels_the_force_of_atkins(toughness: float, ratio: float) -> None:
    found = drawn('stiffening', toughness, FIRM, 0.0044, ratio)
    across = toughness * found.depth / (1 + ratio**2)
    assert found.force[0] == pytest.approx(across, rel=0.1)
    assert -found.force[2] == pytest.approx(ratio * across, rel=0.1)


def test_a_result_without_a_value_is_outside_and_its_reason_is_in_the_table() -> None:
    lost = Result('force', 'linear', 6, 'N', 1.0, None, None, 0.1, 'nothing is cut')
    assert not lost.inside(1.0)
    text = tables({'sphere': [lost]})
    assert 'nothing is cut' in text and '0 of 1' in text


def test_the_picture_labels_each_case_at_its_line() -> None:
    rows = run_fat(quick=True)
    figure = draw({'fat': rows})
    assert [text.get_text() for text in figure.axes[0].texts] == ['fat, stiffening']
    assert len(curve(rows, 'linear')) == 1


def test_an_unknown_case_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(SessionError, match='toughness, stiffness, slicing, sawtooth, scissors'):
        run_validate(['spleen'], quick=True)
