"""A crack that runs in steps: the force is a sawtooth whose mean is the steady force."""

import pytest

from bench.validate.blade import DEPTH, SLICED
from bench.validate.sawtooth import CRACK, felt_by_hand, teeth

pytestmark = pytest.mark.long

STEADY = SLICED * DEPTH


@pytest.mark.parametrize(
    ('cell', 'rate'),
    [
        (0.0045, 30.0),
        *(pytest.param(0.004, rate, marks=pytest.mark.thorough) for rate in (20.0, 60.0)),
    ],
)
def test_the_teeth_are_as_long_as_the_steps_and_cost_what_a_steady_cut_does(cell, rate) -> None:
    found = teeth(cell, rate)
    assert found.length == pytest.approx(CRACK, rel=0.1)
    assert found.mean == pytest.approx(STEADY, rel=0.1)
    assert found.swing > 0.2 * STEADY


@pytest.mark.thorough
def test_the_hand_feels_each_tooth_fall_from_one_tick_to_the_next() -> None:
    found, fall = felt_by_hand(0.004)
    assert found.length == pytest.approx(CRACK, rel=0.1)
    assert found.mean == pytest.approx(STEADY, rel=0.1)
    assert fall > 0.5 * found.swing
