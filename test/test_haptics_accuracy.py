"""The force between two frames against a tissue that runs at 1 kHz; the whole table is
`trainer haptics-accuracy`.
"""

from dataclasses import replace

from session.measure.haptics_accuracy import MOTIONS, PLACES, Bench, measure, missed
from session.scene import load_scene


def test_default_keeps_its_bar_while_sliding_at_1_hz_and_holding_the_force_does_not():
    sliding = next(motion for motion in MOTIONS if motion.name == 'sliding 1 Hz')
    rows = measure(
        Bench(load_scene('liver')),
        replace(sliding, seconds=1.0),
        places=PLACES[1:],
        laws=('local_stiffness', 'constant'),
    )
    assert missed(rows) == []
    default, held = rows
    assert default.peak_newton > 0.2
    assert default.median < held.median
    assert held.p95 > 7.0
