"""A cut exchanges the connectivity of 20,000 triangles under a pressing hand."""

import time

import numpy as np
import pytest
from rig import FRAME, PROFILE, RADIUS, K, Rig

from cutting_trainer.haptic_bridge.proxy.surface import Surface

pytestmark = pytest.mark.long

POINTS, WIDTH, DEPTH = 101, 0.1, 4e-3
BEFORE, CHANGES = 10, 8
"""Frames before the first change, and with one."""
SLEW = 100.0
"""[N/s]: less than what the force would change by in a tick."""


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Nodes [m] and triangles of a level square, its middle in a corner of four squares."""
    line = np.linspace(-WIDTH / 2, WIDTH / 2, POINTS)
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing='ij'))
    i = np.arange(POINTS**2).reshape(POINTS, POINTS)
    a, b, c, d = (n.ravel() for n in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.column_stack([x, y, 0 * x]), triangles.astype(np.int32)


def swapped(place: float, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A press, and a hole beside the tip that grows by 1 mm in every frame.

    Args:
        place: its middle along x [m].
        width: at most, along x [m].

    Returns:
        By tick from before the first change on: z of the force [N], processor time [s], whether a
        new connectivity came in it, each shape (k,).
    """
    nodes, triangles = sheet()
    x, y, _ = abs(nodes[triangles].mean(axis=1) - [place, 0.0, 0.0]).T
    rig = Rig(profile=PROFILE.model_copy(update={'max_slew': SLEW}))
    rig.mesh = False
    rig.surface = Surface(nodes, triangles, revision=0, topology=1)
    spent, new = [], []
    heights = np.append(np.linspace(RADIUS + 1e-3, RADIUS - DEPTH, 200), RADIUS - DEPTH)
    for tick in range((BEFORE + CHANGES) * FRAME):
        frame = tick // FRAME
        change = frame >= BEFORE and tick % FRAME == 0
        if tick % FRAME == 0:
            rig.topology += change
            size = 1e-3 * (frame + 1 - BEFORE)
            left = triangles[(x > min(size, width / 2)) | (y > size)]
            count = {'revision': rig.step, 'topology': rig.topology}
            rig.surface = Surface(nodes, left, **count, previous=rig.surface)
        start = time.thread_time()
        rig.run([heights[min(tick, 200)]])
        spent.append(time.thread_time() - start)
        new.append(change)
    first = BEFORE * FRAME - 1
    return np.array(rig.forces)[first:, 2], np.array(spent)[first:], np.array(new)[first:]


def test_a_slit_beside_the_tool_is_not_felt_while_it_grows() -> None:
    forces, _, new = swapped(place=0.006, width=1e-3)
    assert new.sum() == CHANGES
    np.testing.assert_allclose(forces, K * DEPTH, rtol=1e-6)


def test_a_hole_that_the_tool_falls_through_is_felt_no_faster_than_the_device_may_change() -> None:
    forces, *_ = swapped(place=0.0, width=0.02)
    assert forces[0] == pytest.approx(K * DEPTH)
    assert not forces[-1]
    assert np.abs(np.diff(forces)).max() <= SLEW * 1e-3 + 1e-12


@pytest.mark.parametrize(('place', 'width'), [(0.006, 1e-3), (0.0, 1e-3)])
def test_a_tick_with_a_new_connectivity_costs_a_few_times_one_without(place, width) -> None:
    runs = [swapped(place, width) for _ in range(3)]
    spent, new = np.min([run[1] for run in runs], axis=0), runs[0][2]
    assert np.median(spent[new]) < 10 * np.median(spent[~new])
