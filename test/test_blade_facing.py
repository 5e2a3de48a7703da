"""The edge of a blade that faces one way cuts that way; spine and flat carry the tissue along."""

import numpy as np
import pytest
from pydantic import ValidationError

from bench.haptics import leading_side
from bench.haptics.leading_side import DEPTH, TOUGHNESS, moved
from cutting_trainer.haptic_bridge.force_kernels import SETUP, STATE, to_tissue
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.tissue_sim.contact.facing import Held, Law, settled, to_edge


def test_the_edge_cuts_at_its_toughness_and_spine_and_flat_resist_more_and_open_nothing() -> None:
    edge, flat, spine = (moved(np.radians(angle)) for angle in (0.0, 90.0, 180.0))
    assert edge.force == pytest.approx(TOUGHNESS * DEPTH, rel=0.05)
    assert edge.force < spine.force < flat.force
    assert edge.paid > 0.0
    assert spine.paid == flat.paid == spine.opened == flat.opened == 0.0


def test_a_region_that_the_blade_is_not_in_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blade is held and cuts at once, so it must know whether anything was swept."""
    monkeypatch.setattr(leading_side, 'WAY', 0.02)
    alone = moved(1.0)
    assert alone.opened > 0.0
    for other in ((1e5, 0.0), (0.0, 0.0)):
        assert moved(1.0, (other,)) == alone


def test_a_device_that_rounds_its_quaternion_has_a_unit_facing() -> None:
    setup, state = np.zeros(1, SETUP), np.zeros(1, STATE)
    setup['rotation'], setup['scale'], setup['facing'] = np.eye(3), 1.0, (1.0, 0.0, 0.0)
    turn = np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    for given in (np.round(turn, 4), 1.005 * turn):
        to_tissue(setup, state, np.append(np.zeros(3), given))
        assert np.linalg.norm(state['facing'][0]) == pytest.approx(1.0, abs=1e-12)


HELD = Held(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), 5e-4, np.zeros(1))


def onward(angle: float, along: float = 0.0) -> np.ndarray:
    """The way of the edge that is pulled by 1 at an angle from where it faces."""
    way = np.array([np.cos(angle), np.sin(angle), along])
    to_edge(way, HELD)
    return way


def test_the_way_of_the_edge_is_continuous_in_the_pull_and_takes_no_more_than_its_part() -> None:
    angles = np.linspace(-np.pi, np.pi, 20001)
    for along in (0.0, 0.7):
        ways = np.array([onward(angle, along) for angle in angles])
        pulls = np.stack([np.cos(angles), np.sin(angles), np.full(len(angles), along)], axis=1)
        assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 2e-3
        # A projection: the pull that is left is at right angles, so that no slip makes energy.
        np.testing.assert_allclose((ways * (pulls - ways)).sum(axis=1), 0.0, atol=1e-12)
        behind = np.abs(angles) >= np.pi / 2
        np.testing.assert_allclose(ways[behind], [[0, 0, along]] * behind.sum(), atol=1e-12)
        assert (ways[~behind, 0] > 0).all()
    # Where it is pulled a little aside, it goes there: 5 degrees, to a hundredth of that.
    np.testing.assert_allclose(onward(0.087), [np.cos(0.087), np.sin(0.087), 0.0], atol=1e-3)


def test_the_spine_is_softer_than_the_flat_by_what_its_narrower_front_settles() -> None:
    piece, stretches = 5e-4, np.linspace(1e-5, 0.02, 50)
    facing, known = np.array([1.0, 0.0, 0.0]), np.zeros((3, 3))
    law = Law(10.0, 1.0, 0.0, facing, 2e-5, 0.0, 0.0, known)
    for stretch in stretches:
        force = law.stiffness * stretch - settled(stretch, piece, law)
        load = law.compliance * force / piece
        settlement = stretch - force / law.stiffness
        assert settlement == pytest.approx(load / (1 + load / 1.25e-3), rel=1e-9)
    assert settled(0.01, piece, law._replace(compliance=0.0)) == pytest.approx(0, abs=1e-12)


def test_a_direction_along_the_blade_is_refused_and_another_is_turned_across_it() -> None:
    with pytest.raises(ValidationError, match=r'along the blade: give a direction across it'):
        ToolSettings(blade_facing=(0, 0, 2))
    np.testing.assert_allclose(ToolSettings(blade_facing=(3, 0, 4)).facing(), [1, 0, 0])
    assert not ToolSettings().facing().any()
