"""The torque of a blade that is turned in the tissue reaches the hand, and does its work there."""

import numpy as np
import pytest
from rig import PROFILE, QUIET, Rig, spoiled
from scipy.spatial.transform import Rotation

from bench.haptics.turned_blade import PRICE, RENDERS, TOOL, turned
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    Transform,
    check_together,
)
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState

TURNED_FRAME = Transform(translation=(0.01, 0, 0.02), rotation_rpy_deg=(20, -30, 70), scale=2.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ('device', 'force_scale'),
    [
        pytest.param(DeviceSettings(), 1.0, marks=pytest.mark.thorough),
        (DeviceSettings(tissue_from_device=TURNED_FRAME, force_frame='body'), 0.5),
    ],
    ids=['same axes', 'turned, scaled, body axes'],
)
def test_the_hand_that_turns_the_blade_by_57_degrees_does_the_work_of_the_cut(
    device: DeviceSettings, force_scale: float
) -> None:
    work, paid = turned(device, force_scale)
    assert paid == pytest.approx(PRICE, rel=0.05)
    # Force by way, and torque by turn, are scaled alike.
    assert work * device.tissue_from_device.scale / force_scale == pytest.approx(paid, rel=0.05)


class Held(Rig):
    """A blade that is held in the tissue by a torque about y [N m], told at each frame."""

    def __init__(self, torque: float, profile: DeviceProfile = RENDERS, **settings: object) -> None:
        super().__init__(profile=profile, **settings)
        self.torque = torque
        self.run(np.linspace(0.005, 0.001, 60))
        self.inside = True
        self.spoil = self._held
        self.run(np.full(70, 0.001))

    def _held(self, sample: StampedMessage) -> StampedMessage:
        values = {'force': (0.0, 0.0, 0.0), 'torque': (0.0, self.torque, 0.0)}
        values |= {'torque_resistance': (0.2,), 'immersed': (0.25, 0.08), 'stiffness': (0.0,) * 9}
        return spoiled(sample, **values)

    @property
    def wrench(self) -> np.ndarray:
        return np.array(self.ticks[-1].wrench)


def test_torque_is_felt_up_to_what_the_device_renders_and_not_at_all_where_it_renders_none() -> (
    None
):
    assert Held(0.002).wrench == pytest.approx([0, 0, 0, 0, 0.002, 0])
    small = RENDERS.model_copy(update={'max_torque': 0.001})
    assert Held(0.002, small).wrench == pytest.approx([0, 0, 0, 0, 0.001, 0])
    assert not any(Held(0.002, PROFILE).wrench)


def test_torque_starts_softly_is_never_faster_than_the_force_and_ends_at_once_in_a_fault() -> None:
    rig = Held(0.002, haptics=HapticsSettings(soft_start=0.5, max_damping=0.0))
    sent = np.array([tick.wrench[4] for tick in rig.ticks])
    fastest = RENDERS.max_slew * RENDERS.max_torque / RENDERS.max_force
    assert 0.0 < sent.max() < 0.0015
    assert np.abs(np.diff(sent)).max() <= fastest * 1e-3 * (1 + 1e-9)
    rig.state = CrtkState.FAULT
    rig.run(np.full(1, 0.001))
    assert not any(rig.wrench)


def test_torque_fades_when_the_simulation_is_silent() -> None:
    rig = Held(0.002)
    rig.sim = False
    rig.run(np.full(250, 0.001))
    assert not any(rig.wrench)


def test_the_passivity_observer_counts_torque_by_turn() -> None:
    rig = Held(0.002)
    before = rig.path.energy
    for angle in np.linspace(0.0, 0.1, 41)[1:]:
        rig.tick((0.0, 0.0, 0.001), Rotation.from_rotvec([0, angle, 0]).as_quat())
    # The hand gives way to the torque and gains its work.
    assert rig.path.energy - before == pytest.approx(-0.002 * 0.1, rel=0.05)
    quiet = Held(0.002, PROFILE)
    before = quiet.path.energy
    for angle in np.linspace(0.0, 0.1, 41)[1:]:
        quiet.tick((0.0, 0.0, 0.001), Rotation.from_rotvec([0, angle, 0]).as_quat())
    assert quiet.path.energy == before


def test_a_blade_whose_springs_are_too_stiff_to_be_turned_is_refused() -> None:
    weak = RENDERS.model_copy(update={'max_torsional_stiffness': 0.1})
    with pytest.raises(SettingsError, match='max_torsional_stiffness'):
        check_together(TOOL, DeviceSettings(), QUIET, weak)
    check_together(TOOL, DeviceSettings(), QUIET, PROFILE)
