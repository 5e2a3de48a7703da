"""A blade goes in where the dent has done the work of its slit, and its tip pays for the slit."""

import numpy as np
import pytest

from bench.haptics.puncture import TOUGHNESS, WIDTH, pushed_in
from cutting_trainer.tissue_sim.simulation.within_frame import Dent

SLIT = TOUGHNESS * WIDTH


@pytest.mark.parametrize('youngs_modulus', [10800.0, 43200.0])
def test_a_blade_goes_in_at_2_5_times_the_force_of_its_slit_however_stiff_the_tissue_is(
    youngs_modulus: float,
) -> None:
    """A force that goes with depth^n has done (n + 1)-th of force times depth; Hertz: n = 1.5."""
    peak = pushed_in(0.0075, 480.0, youngs_modulus, until_entry=True).peak
    assert peak == pytest.approx(2.5 * SLIT, rel=0.1)


def test_a_blade_that_goes_deeper_pays_toughness_times_the_width_of_its_slit() -> None:
    entered = pushed_in(0.0075, 60.0, 21600.0)
    assert entered.plateau == pytest.approx(SLIT, rel=0.03)


def test_a_dent_has_the_work_of_its_force_and_none_that_ended() -> None:
    """The force of 100 N/m from 0.9 mm on; the coupling is a thousand times as stiff."""
    up, dent = np.array([0.0, 0.0, 1.0]), Dent()
    for depth in (0.001, 0.002, 0.003, 0.004):
        dent = dent.deepened(100.0 * (depth - 0.0009), -depth * up, up, 1e5)
    assert dent.depth == pytest.approx(0.003 * (1 - 1e-3))
    assert dent.work == pytest.approx((0.01 + 0.31) / 2 * dent.depth)
    assert dent.deepened(0.0, -0.005 * up, up, 1e5).deepened(1.0, 0 * up, up, 1e5).work == 0.0


@pytest.mark.parametrize('turn', [-0.01, 0.01])
def test_a_dent_under_a_normal_that_turns_is_the_same_wherever_the_tissue_is(turn: float) -> None:
    found = []
    for place in (np.zeros(3), np.array([0.5, -0.3, 0.1])):
        dent = Dent()
        for k in range(10):
            normal = np.array([np.sin(turn * k), 0.0, np.cos(turn * k)])
            dent = dent.deepened(0.1 + 0.1 * k, place - [0, 0, 1e-4 * k], normal, 400.0)
        found.append((dent.depth, dent.work))
    assert found[1] == pytest.approx(found[0], rel=1e-9)
