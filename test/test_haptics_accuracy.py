"""The force between two frames against a tissue that runs at 1 kHz; the whole table is
`trainer bench haptics-accuracy`.
"""

from dataclasses import replace

import pytest

from bench.haptics.accuracy import MOTIONS, PLACES, Bench, measure, missed_bounds
from cutting_trainer.session.scene_loader import load_scene

pytestmark = pytest.mark.long


@pytest.mark.thorough
def test_default_keeps_its_bar_while_sliding_at_1_hz_and_holding_the_force_does_not():
    sliding = next(motion for motion in MOTIONS if motion.name == 'sliding 1 Hz')
    rows = measure(
        Bench(load_scene('liver')),
        replace(sliding, seconds=1.0),
        places=PLACES[1:],
        laws=('local_stiffness', 'constant'),
    )
    assert missed_bounds(rows) == []
    default, held = rows
    assert default.peak_newton > 0.2
    assert default.median < held.median
    assert held.p95 > 7.0


@pytest.mark.thorough
def test_default_keeps_its_bar_in_a_cut():
    cutting = next(motion for motion in MOTIONS if motion.cuts)
    (row,) = measure(
        Bench(load_scene('liver')), cutting, places=PLACES[1:], laws=('local_stiffness',)
    )
    assert missed_bounds([row]) == []
    assert row.peak_newton > 2.0
    assert row.worst < 20.0
