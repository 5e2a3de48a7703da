"""The tissue is on another machine: what the hand feels behind delay, jitter and loss."""

import numpy as np
import pytest

from bench.haptics.stability_map import (
    COUPLING_STIFFNESS,
    Cell,
    Outcome,
    Place,
    block,
    counts,
    run_once,
    run_place,
    tip_over,
)
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, HapticsSettings, ToolSettings
from cutting_trainer.session.in_process import TICK_S, InProcess, LinkSettings, Tissue

pytestmark = pytest.mark.long

WORST = LinkSettings(delay=0.05, loss=0.05, jitter=0.01, seed=1)


def pressed(
    tissue: float, link: LinkSettings, *, start: float, depth: float = 0.006, seconds: float = 0.15
) -> np.ndarray:
    """Forces on a hand that goes straight to a depth and stays there [N], shape (k,).

    Args:
        tissue: stiffness of the pressed point [N/m].
        link: to it.
        start: height over the touch from which it sets out [m].
        depth: [m].
        seconds: of the way.
    """
    device = DeviceSettings()
    tool = ToolSettings(radius=0.004, coupling_stiffness=COUPLING_STIFFNESS)
    path = ForcePath(tool, device, HapticsSettings(soft_start=0.0), device.load_profile())
    session = InProcess(path, Tissue(block(tissue)), 30.0, link)
    session.wait(0.1 + 2 * link.delay, tip_over(device, start))
    part = np.minimum(np.arange(0, seconds + 0.5, TICK_S) / seconds, 1)
    part = part**3 * (10 - 15 * part + 6 * part**2)
    wrenches = [session.tick(tip_over(device, h)).wrench for h in start - (start + depth) * part]
    return np.linalg.norm(np.array(wrenches)[:, :3], axis=1)


@pytest.mark.parametrize('tissue', [50.0, 200.0, 1000.0])
def test_a_first_touch_that_the_tissue_has_not_answered_yet_is_no_harder_than_the_tissue(
    tissue: float,
) -> None:
    force = pressed(tissue, LinkSettings(delay=0.05), start=0.03)
    assert 0.15 < force[-1] < 3.0
    assert force.max() < 1.1 * force[-1]


@pytest.mark.parametrize(('hand', 'tissue'), [(30.0, 1000.0), (1000.0, 50.0), (1000.0, 1000.0)])
def test_default_is_stable_and_passive_at_50_ms_and_5_percent_loss(
    hand: float, tissue: float
) -> None:
    for controlled in (False, True):
        place = Place('local_stiffness', hand, tissue, WORST.delay, WORST.loss)
        outcome = run_once(place, controlled, seed=1)
        assert outcome.stable, outcome
        assert outcome.passive, outcome


def test_a_held_force_swings_where_the_default_is_still() -> None:
    outcomes = run_place(Place('constant', 100.0, 1000.0, WORST.delay, 0.0))
    assert not any(outcome.stable for outcome in outcomes.values())


def test_the_controller_is_run_wherever_it_would_have_something_to_do() -> None:
    """The map leaves its run out elsewhere: there it must change nothing."""
    place = Place('local_stiffness', 100.0, 150.0, 0.025, 0.0)
    without = run_once(place, False, seed=2)
    assert not without.controller_due
    assert run_once(place, True, seed=2) == without
    held = Place('constant', 100.0, 1000.0, 0.025, 0.0)
    assert run_once(held, False, seed=2).controller_due
    assert run_once(held, True, seed=2) != run_once(held, False, seed=2)


def test_the_worst_of_the_seeds_is_what_counts_figure_by_figure() -> None:
    worst = Outcome(1e-5, 3e-4, False).worse(Outcome(4e-4, 1e-4, True))
    assert worst == Outcome(4e-4, 3e-4, True)


def test_the_map_counts_as_passive_what_is_stable_too_and_bounds_50_ms_and_5_percent() -> None:
    good, swings, makes = Outcome(1e-5, 1e-5), Outcome(1e-3, 1e-5), Outcome(1e-5, 1e-3)
    outcomes = {(0.0, 0.0): good, (0.05, 0.05): makes, (0.05, 0.1): good, (0.075, 0.0): swings}
    results = {Cell('time', 30.0, 50.0, *at, False): o for at, o in outcomes.items()}
    without, with_ = counts(results | {Cell('time', 30.0, 50.0, 0.0, 0.0, True): good})
    assert (without.cells, without.stable, without.both) == (4, 3, 2)
    assert (without.bound, without.both_bound) == (2, 1)
    assert (with_.controlled, with_.cells, with_.both_bound) == (True, 1, 1)


def test_the_same_seed_gives_the_same_bits_behind_jitter_and_loss() -> None:
    first, again = (pressed(200.0, WORST, start=0.003, seconds=0.1) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = pressed(200.0, LinkSettings(0.05, 0.05, 0.01, seed=2), start=0.003, seconds=0.1)
    assert np.any(first != other)
