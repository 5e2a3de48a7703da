"""Claims about a hand that somebody guides."""

import numpy as np
from arms import make_arm, move, run, script
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation


def test_guided_hand_leaves_its_script_and_comes_to_rest_at_the_goal():
    arm = make_arm(script=script(move((0.0, 0.0, 0.1)), seconds=1.0))
    arm.script_running = True
    before, _ = run(arm, 300)
    turn = Rotation.from_euler('xyz', (20, -30, 60), degrees=True).as_quat()
    arm.guide(np.array([0.05, -0.02, 0.01]), -turn)
    after, _ = run(arm, 1500, start=300)
    assert_allclose(after[-1], (0.05, -0.02, 0.01), atol=1e-6)
    assert_allclose(abs(arm.orientation @ turn), 1, atol=1e-9)
    assert not arm.script_over
    path = np.concatenate([before, after])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    jumps = np.linalg.norm(np.diff(path, n=2, axis=0), axis=1)
    assert steps.max() < 0.75e-3  # the hand keeps below 0.5 m/s, the mass on its spring overshoots
    assert jumps.max() < 1e-4  # and without a jump where the script is left


def test_goal_that_jumps_does_not_throw_the_arm():
    arm = make_arm()
    arm.guide(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    path, _ = run(arm, 1000)
    assert 0.4 < path[-1, 0] < 0.51
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.75e-3
