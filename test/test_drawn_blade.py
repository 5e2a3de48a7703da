"""The force of a blade that is drawn out of tissue that it loads, with samples and between two."""

import numpy as np
import pytest
from rig import FRAME, RADIUS, Rig, lowered, spoiled

from bench.haptics.random_cuts import errors_of
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.tissue_sim.contact.blade_constants import BladeConstants

DEEP = RADIUS - 4e-3
LENGTH, IMMERSED = 0.020, 0.008
"""[m] of the blade, in all and in the tissue."""
TOUGHNESS, FRICTION = 164.0, 5.0
STIFFNESS = 60.0
"""[N/m] of tissue and coupling in each direction."""
ASIDE = 8e-3
"""[m] by which the hand has moved across the blade."""
LOAD = 1.2
"""[N] across the blade, below what cuts."""
TOOL = ToolSettings(
    radius=RADIUS, coupling_stiffness=200.0, blade_root=(0, 0, 0.008), blade_tip=(0, 0, -0.012)
)
UNCHARTED = (5002, 5012)
"""Seeds of strokes that no chart has."""


def loaded(load: float, tool: ToolSettings = TOOL, **changes: tuple[float, ...]) -> Rig:
    """A rig whose blade is in the tissue and has a load across it [N]; no sample follows."""
    rig = Rig(tool=tool, constants=BladeConstants(friction=FRICTION, toughness=TOUGHNESS))
    rig.run(lowered(4e-3, 300))
    rig.inside = True
    mean = IMMERSED / LENGTH / 2
    values = {
        'force': (-load, 0.0, 0.0),
        'stiffness': tuple(STIFFNESS * np.eye(3).ravel()),
        'resistance': ((TOUGHNESS + FRICTION) * IMMERSED,),
        'immersed': (mean, mean**2 * 4 / 3),
    }
    rig.spoil = lambda sample: spoiled(sample, **values | changes)
    rig.run(np.full(2 * FRAME, DEEP))
    for x in np.append(np.linspace(0.0, ASIDE, FRAME), np.full(2 * FRAME, ASIDE)):
        rig.tick((float(x), 0.0, DEEP))
    rig.sim = False
    return rig


def drawn(rig: Rig, way: np.ndarray) -> np.ndarray:
    """The forces of a rig while its blade is drawn out [N], shape (k, 3); way by tick [m], (k,)."""
    for z in way:
        rig.tick((ASIDE, 0.0, DEEP + float(z)))
    return np.array(rig.forces[-len(way) :])


def test_a_loaded_blade_takes_the_tissue_along_until_both_forces_together_cut() -> None:
    way = np.linspace(0.0, 0.016, 80)
    forces = drawn(loaded(LOAD), way)
    sizes, across = np.linalg.norm(forces, axis=1), np.abs(forces[:, 0])
    # What the tissue bears is J l sin(edge, force) + friction l, and sin(edge, force) = across / F.
    bound = IMMERSED * (TOUGHNESS * across + FRICTION * sizes)
    yields = int(np.argmax(sizes**2 > 0.99 * bound))
    assert 20 < yields < 50
    np.testing.assert_allclose(across[:yields], LOAD, rtol=1e-3)
    np.testing.assert_allclose(forces[:yields, 2], -STIFFNESS * way[:yields], atol=2e-3)
    assert (sizes**2 <= 1.01 * bound).all()
    assert sizes[-1] < 0.8 * sizes[yields]


def test_a_blade_without_load_is_drawn_out_against_its_friction_alone() -> None:
    way = np.linspace(0.0, 0.006, 60)
    forces = drawn(loaded(0.0), way)
    rubs = np.abs(forces[:, 2])
    assert rubs.max() == pytest.approx(FRICTION * IMMERSED, rel=0.02)
    # It is in proportion to the length that is still in the tissue, and so is the stiffness of the
    # coupling: its stretch stays, that of the tissue falls with the force.
    stretch = FRICTION * LENGTH / 2 / TOOL.coupling_stiffness
    soft = 1 / STIFFNESS - stretch / (FRICTION * IMMERSED)
    left = (IMMERSED - way[-1] + stretch) / (1 - soft * FRICTION)
    assert rubs[-1] == pytest.approx(FRICTION * left, rel=0.01)


def test_a_blade_that_slips_out_leaves_the_faster_the_less_of_it_is_in_the_tissue() -> None:
    rig = loaded(LOAD)
    still = rig.spoil

    def told(sample: StampedMessage) -> StampedMessage:
        mean = (IMMERSED - (sample.values[9] - DEEP)) / LENGTH / 2
        return spoiled(still(sample), immersed=(mean, mean**2 * 4 / 3))

    rig.spoil, rig.sim = told, True
    drawn(rig, np.linspace(0.0, 2e-3, 2 * FRAME + 1))  # by as much as it is drawn, two samples say
    rig.sim = False
    way = 2e-3 + np.linspace(0.0, 6e-3, 121)
    sizes = np.linalg.norm(drawn(rig, way), axis=1)
    # The newest sample is of 1 to 2 mm. At its rate, all would be out at 8 mm.
    gone = int(np.argmax(sizes == 0.0))
    assert 4.4e-3 < way[gone] < 5.1e-3
    falls = -np.diff(sizes[:gone])
    assert (np.diff(falls) > 0.0).all()
    assert falls[-1] > 3.0 * falls[0]


def test_a_blade_through_a_sheet_holds_until_its_tip_has_come_to_it() -> None:
    rig, below = loaded(LOAD), 6e-3
    still = rig.spoil

    def told(sample: StampedMessage) -> StampedMessage:
        """The part in the tissue is as long as before, and nearer to the tip by the way out."""
        mean = (below - (sample.values[9] - DEEP) + IMMERSED / 2) / LENGTH
        return spoiled(still(sample), immersed=(mean, mean**2 + (IMMERSED / LENGTH) ** 2 / 12))

    rig.spoil, rig.sim = told, True
    drawn(rig, np.linspace(0.0, 2e-3, 2 * FRAME + 1))
    rig.sim = False
    sizes = np.linalg.norm(drawn(rig, 2e-3 + np.linspace(0.0, 2e-3, 41)), axis=1)
    assert (sizes >= 0.99 * LOAD).all()


def test_tissue_that_two_samples_show_to_be_stiffer_is_felt_so_from_then_on() -> None:
    rig = loaded(LOAD)
    still, shown = rig.spoil, 1.5 * STIFFNESS
    rig.spoil = lambda sample: spoiled(
        still(sample), force=(-LOAD, 0.0, -shown * (sample.values[9] - DEEP))
    )
    rig.sim = True
    drawn(rig, np.linspace(0.0, 2e-3, 2 * FRAME + 1))
    rig.sim = False
    forces = drawn(rig, 2e-3 + np.linspace(0.0, 1e-3, 11))[:, 2]
    np.testing.assert_allclose(np.diff(forces), -shown * 1e-4, rtol=0.05)


@pytest.mark.parametrize('facing', [(-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_spine_and_flat_are_felt_as_the_tissue_bears_them_beyond_what_cuts(
    facing: tuple[float, float, float],
) -> None:
    tool = TOOL.model_copy(update={'blade_facing': facing})
    rig = loaded(1.5 * TOUGHNESS * IMMERSED, tool, resistance=(3.0,))
    forces = drawn(rig, np.zeros(20))
    assert forces[-1, 0] == pytest.approx(-1.5 * TOUGHNESS * IMMERSED, rel=0.01)


def test_a_blade_goes_on_by_no_more_than_finite_ways_in_a_forged_tissue() -> None:
    turned = np.array([[0.0, 200.0, 0.0], [-200.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    stiffness = tuple((turned + 2e-3 * np.eye(3)).ravel())
    rig = loaded(LOAD, stiffness=stiffness, resistance=(0.0,))
    rig.sim = True
    for i in range(300):
        waves = np.sin(np.array([i / 30, i / 7, i / 11]))
        x, y, z = waves * (ASIDE, 2e-3, 4e-3) + (0.0, 0.0, DEEP)
        rig.tick((float(x), float(y), float(z)))
    assert not any(tick.fault for tick in rig.ticks)


@pytest.mark.long
@pytest.mark.thorough
@pytest.mark.parametrize('seed', UNCHARTED)
def test_a_blade_that_slices_and_is_withdrawn_feels_as_over_a_tissue_at_1_khz(seed: int) -> None:
    errors = errors_of(seed)
    assert errors.peak > 1.0
    assert errors.p95 < 0.065
    assert errors.worst < 0.25
    assert errors.hole < 0.2
    assert errors.tail < 0.005
