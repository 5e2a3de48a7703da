"""The force where a blade goes in and comes out, in the ticks between two samples of the tissue."""

import numpy as np
import pytest
from rig import FRAME, QUIET, RADIUS, K, Rig, lowered, spoiled

from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.tissue_sim.contact.blade_constants import BladeConstants

ENTRY = 0.2
"""[N] at a depth of 2.5 mm of the rig's tissue."""
DEEP = 4e-3
SCALPEL = ToolSettings(radius=RADIUS, coupling_stiffness=200.0)
PALPATOR = ToolSettings(radius=RADIUS, coupling_stiffness=200.0, mode='palpator')


def lowering(tool: ToolSettings = SCALPEL, entry: float = ENTRY) -> tuple[Rig, np.ndarray]:
    """A rig and its forces along z while the tool goes 4 mm deep in 300 ms [N]."""
    rig = Rig(tool=tool, constants=BladeConstants(entry_force=entry))
    return rig, rig.run(lowered(DEEP, 300))[:, 2]


def test_the_force_ends_in_the_tick_in_which_it_lets_the_blade_in() -> None:
    _, felt = lowering()
    _, pressed = lowering(entry=np.inf)
    entered = int(np.argmax((felt[1:] == 0.0) & (felt[:-1] > 0.0))) + 1
    assert felt[entered - 1] == pytest.approx(ENTRY, rel=0.02)
    assert np.array_equal(felt[:entered], pressed[:entered])
    assert (felt[entered : entered + 15] == 0.0).all()
    assert pressed[-1] == pytest.approx(K * DEEP, rel=0.05)


def test_a_palpator_that_presses_as_hard_is_felt_on() -> None:
    _, felt = lowering(PALPATOR)
    assert felt[-1] == pytest.approx(K * DEEP, rel=0.05)


def test_a_blade_that_the_tissue_has_let_in_is_felt_by_its_samples() -> None:
    rig, _ = lowering()
    rig.inside = True
    felt = rig.run(np.full(3 * FRAME, RADIUS - DEEP))[:, 2]
    assert felt[0] == 0.0
    assert felt[-1] == pytest.approx(0.3, rel=0.05)  # the resistance in the samples


def test_tissue_that_does_not_let_the_blade_in_is_felt_again_and_bears_more_from_then_on() -> None:
    rig, _ = lowering()
    felt = rig.run(np.full(10 * FRAME, RADIUS - DEEP))[:, 2]
    assert felt[-1] == pytest.approx(K * DEEP, rel=0.05)
    again = np.flatnonzero((felt[1:] == 0.0) & (felt[:-1] > 0.0))
    assert len(again) <= 1  # K DEEP is above 1.5 times ENTRY once
    assert (felt[-5 * FRAME :] > ENTRY).all()


def test_a_contact_that_ends_takes_what_it_bore_with_it() -> None:
    rig, first = lowering()
    rig.run(np.full(10 * FRAME, RADIUS - DEEP))
    rig.run(np.linspace(RADIUS - DEEP, RADIUS + 2e-3, 200))
    rig.run(np.full(10 * FRAME, RADIUS + 2e-3))
    second = rig.run(lowered(DEEP, 300))[:, 2]
    assert second.max() == pytest.approx(first.max(), rel=0.05)


def test_the_resistance_falls_with_the_length_in_the_tissue_before_a_sample_says_so() -> None:
    length = 0.020
    tool = ToolSettings(
        radius=RADIUS, coupling_stiffness=200.0, blade_root=(0, 0, 0.008), blade_tip=(0, 0, -0.012)
    )
    rig = Rig(tool=tool, haptics=QUIET)
    rig.run(lowered(DEEP, 300))
    rig.inside = True
    immersed = 0.008
    mean = immersed / length / 2
    rig.spoil = lambda sample: spoiled(
        sample, force=(0.1, 0.0, 0.0), resistance=(0.1,), immersed=(mean, mean**2 * 4 / 3)
    )
    rig.run(np.full(3 * FRAME - rig.ms % FRAME, RADIUS - DEEP))
    rig.sim = False  # no sample while the blade comes out by 6 of its 8 mm
    felt = np.linalg.norm(rig.run(np.linspace(RADIUS - DEEP, RADIUS - DEEP + 0.006, 30)), axis=1)
    left = 1.0 - np.linspace(0.0, 0.006, 30) / immersed
    assert felt == pytest.approx(0.1 * left, abs=0.003)
