"""Claims about the clutch and the live scale of motion: no jump, no force, and still safe."""

from collections import deque

import numpy as np
import pytest
from rig import PROFILE, QUIET, RADIUS, Rig
from scipy.spatial.transform import Rotation

from cutting_trainer.haptic_bridge.force_kernels import NONE, TOUCHING
from cutting_trainer.haptic_bridge.force_path import ENERGY_CREDIT_J, ForcePath
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceSettings,
    HapticsSettings,
    SettingsError,
    ToolSettings,
    Transform,
)
from cutting_trainer.node_common.cdr_codec import ContactCodec, StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.recordings import what_if
from cutting_trainer.viewer.tool_state import Translator

FRAME = Transform(translation=(0.01, -0.02, 0.03), rotation_rpy_deg=(20, -35, 110), scale=1.4)
DEPTH = 4e-3


class Hand:
    """A hand on a device that is turned and scaled, by the place of its tool before any clutch."""

    def __init__(self, haptics=QUIET, frame=FRAME):
        tool = ToolSettings(radius=RADIUS, coupling_stiffness=200.0, blade_facing=(1, 0, 0))
        self.device = DeviceSettings(tissue_from_device=frame)
        self.rig = Rig(haptics=haptics, device=self.device, tool=tool)
        self.poses = []
        self.frame = frame
        self.place, self.turn = np.array([0.0, 0.0, RADIUS + 1e-3]), Rotation.identity()
        self._turned: tuple[Rotation | None, np.ndarray] = None, np.empty(4)
        self.work = 0.0
        self.felt, self.tips, self.blades, self.at = [], [], [], None

    def go(self, place, turn=None, ms=1):
        """Moves there evenly."""
        start, began = self.place, self.turn
        turn = began if turn is None else turn
        way = (turn * began.inv()).as_rotvec()
        for share in np.arange(1, ms + 1) / ms:
            self.place = start + share * (np.asarray(place) - start)
            if way.any():
                self.turn = Rotation.from_rotvec(share * way) * began
            self.tick()

    def tick(self):
        position = self.frame.to_device(self.place)
        if self.at is not None:
            self.work += self.rig.forces[-1] @ (position - self.at)
        self.at = position
        if self.turn is not self._turned[0]:
            rotation = self.frame.rotation().T @ self.turn.as_matrix()
            self._turned = self.turn, Rotation.from_matrix(rotation).as_quat()
        quaternion = self._turned[1]
        self.rig.tick(tuple(position), quaternion)
        self.poses.append(StampedMessage(self.rig.now, '', (*position, *quaternion)))
        self.felt.append(np.linalg.norm(self.rig.forces[-1]))
        self.tips.append(self.rig.contact('device'))
        self.blades.append(
            [*self.rig.contact('blade_root'), *self.rig.contact('blade_facing')],
        )

    def clutch(self, pressed):
        self.rig.path.coupling.change(clutched=pressed)

    def press(self):
        self.go((0, 0, RADIUS - DEPTH), ms=200)
        self.go(self.place, ms=200)


def largest_step(values, first=0):
    return np.abs(np.diff(np.array(values[first:]), axis=0)).max()


def test_the_tool_stays_while_clutched_and_does_not_jump_when_taken_again():
    hand = Hand()
    hand.press()
    before = len(hand.tips)
    hand.clutch(True)
    hand.go((0.03, -0.02, 0.05), Rotation.from_rotvec((0.7, -0.4, 1.1)), ms=300)
    hand.clutch(False)
    hand.go(hand.place, ms=3)
    assert largest_step(hand.tips, before - 1) < 1e-12
    assert largest_step(hand.blades, before - 1) < 1e-12
    # From there on it goes and turns as the hand does, about the same axis.
    tip, root = hand.rig.contact('device'), np.array(hand.rig.contact('blade_root'))
    turn = Rotation.from_rotvec((0.0, 0.3, 0.2))
    hand.go(hand.place + np.array([1e-3, 2e-3, -0.5e-3]), turn * hand.turn, ms=50)
    np.testing.assert_allclose(
        np.subtract(hand.rig.contact('device'), tip), [1e-3, 2e-3, -0.5e-3], atol=1e-12
    )
    arm = np.subtract(hand.rig.contact('blade_root'), hand.rig.contact('device'))
    np.testing.assert_allclose(arm, turn.apply(root - tip), atol=1e-12)


def test_no_force_while_clutched_and_a_soft_start_after():
    hand = Hand(HapticsSettings(soft_start=0.2, max_damping=0.0))
    hand.press()
    force = hand.felt[-1]
    assert force > 0.1
    hand.clutch(True)
    first = len(hand.felt)
    hand.go((0.0, 0.0, 0.05), ms=100)
    assert np.diff(hand.felt[first - 1 :]).min() >= -PROFILE.max_slew * 1e-3 - 1e-12
    assert max(hand.felt[first + 10 :]) == 0.0
    assert hand.rig.ticks[-1].contact[1] == TOUCHING
    hand.clutch(False)
    hand.go(hand.place, ms=20)
    assert 0.0 < hand.felt[-1] < 0.15 * force
    hand.go(hand.place, ms=300)
    assert hand.felt[-1] == pytest.approx(force, abs=0.02 * PROFILE.max_force)


def test_the_scale_of_motion_changes_without_a_jump():
    hand = Hand()
    hand.press()
    before = len(hand.tips)
    force = hand.felt[-1]
    hand.rig.path.coupling.change(motion_scale=0.7)
    hand.go(hand.place, ms=100)
    assert largest_step(hand.tips, before - 1) < 1e-12
    assert hand.felt[-1] == pytest.approx(force, abs=0.02 * PROFILE.max_force)
    tip = hand.rig.contact('device')
    hand.go(hand.place + np.array([0, 0, 2e-3]), ms=50)
    lifted = np.subtract(hand.rig.contact('device'), tip)
    np.testing.assert_allclose(lifted, [0, 0, 0.7 / 1.4 * 2e-3], atol=1e-12)
    with pytest.raises(SettingsError, match='the device bears 1000 N/m'):
        hand.rig.path.coupling.change(motion_scale=6.0)
    for wrong in (0.0, -1.0, np.nan, 200.0):
        with pytest.raises(ValueError, match='scale'):
            hand.rig.path.coupling.change(motion_scale=wrong)


def test_a_scale_that_changes_while_clutched_counts_when_the_tool_is_taken_again():
    hand = Hand()
    hand.press()
    before = len(hand.tips)
    hand.clutch(True)
    hand.go((0.0, 0.01, 0.02), ms=50)
    hand.rig.path.coupling.change(motion_scale=2.8)
    hand.go((0.0, 0.01, 0.03), ms=50)
    hand.clutch(False)
    hand.go(hand.place, ms=2)
    assert largest_step(hand.tips, before - 1) < 1e-12
    tip = hand.rig.contact('device')
    hand.go(hand.place + np.array([0, 0, 1e-3]), ms=50)
    np.testing.assert_allclose(np.subtract(hand.rig.contact('device'), tip)[2], 2e-3, atol=1e-12)


@pytest.mark.parametrize('released', [False, True])
def test_a_fault_holds_through_a_clutch(released):
    hand = Hand()
    hand.press()
    hand.clutch(True)
    hand.rig.state = CrtkState.FAULT  # as E-STOP sets it
    first = len(hand.felt)
    hand.go((0, 0, 0.01), ms=50)
    hand.clutch(not released)
    hand.go((0, 0, RADIUS - DEPTH), ms=100)
    assert max(hand.felt[first:]) == 0.0
    hand.rig.state = CrtkState.ENABLED
    hand.go(hand.place, ms=100)
    assert bool(hand.felt[-1] > 0.1) is released


def test_a_device_that_falls_silent_while_clutched_is_a_fault():
    hand = Hand()
    hand.press()
    hand.clutch(True)
    hand.go((0, 0, 0.04), ms=50)
    hand.rig.poses = False
    hand.go(hand.place, ms=19)
    assert hand.rig.state is CrtkState.ENABLED
    hand.go(hand.place, ms=3)
    assert hand.rig.state is CrtkState.FAULT


def test_a_device_that_jumps_while_clutched_is_a_fault():
    hand = Hand()
    hand.press()
    hand.clutch(True)
    hand.go((0, 0, 0.04), ms=50)
    hand.go((0, 0.5, 0.04))
    assert hand.rig.state is CrtkState.FAULT


def test_a_simulation_that_falls_silent_while_clutched_gives_no_force_afterwards():
    hand = Hand()
    hand.press()
    hand.clutch(True)
    hand.rig.sim = False
    hand.go((0, 0, 0.04), ms=300)
    hand.clutch(False)
    first = len(hand.felt)
    hand.go(hand.place, ms=300)
    assert max(hand.felt[first:]) == 0.0


def made(haptics):
    """The most energy [J] that a hand ever had out of pumping: it presses while the force is soft,
    lets go while it is full, and moves back without the tool."""
    hand = Hand(haptics, Transform())
    random = np.random.default_rng(5)
    hand.press()
    most = 0.0
    for _ in range(60):
        hand.clutch(True)
        hand.go((0, 0, RADIUS + random.uniform(0, 0.03)), ms=int(random.integers(20, 80)))
        hand.clutch(False)
        for height in (RADIUS - DEPTH, RADIUS - DEPTH, RADIUS + 1e-3):
            way = np.array([0, 0, height - hand.rig.contact('device')[2]])
            hand.go(hand.place + way, ms=int(random.integers(20, 150)))
        most = max(most, hand.work)
    assert hand.rig.state is CrtkState.ENABLED
    return most


def test_pumping_by_the_clutch_makes_no_energy():
    assert made(HapticsSettings(soft_start=0.1)) < 5 * ENERGY_CREDIT_J
    assert made(HapticsSettings(soft_start=0.1, max_damping=0.0)) > 25 * ENERGY_CREDIT_J


@pytest.mark.parametrize('after', [0, 250])
def test_recorded_changes_put_the_tool_where_it_was_from_the_middle_too(after):
    hand = Hand()
    coupling = hand.rig.path.coupling
    changes, poses = [coupling.indexing], []
    hand.press()
    for target, order in (
        ((0.02, 0.01, 0.03), {'clutched': True}),
        ((0.0, 0.01, 0.02), {'clutched': False}),
        ((0.01, -0.01, 0.03), {'motion_scale': 0.9}),
        ((0.0, -0.01, 0.03), {'clutched': True, 'motion_scale': 1.1}),
        ((0.0, 0.0, 0.02), {'clutched': False}),
    ):
        coupling.change(**order)
        turn = Rotation.from_rotvec(10 * np.array(target)) * hand.turn
        hand.go(target, turn, ms=60)
    changes += coupling.unsent
    assert len(changes) == 6
    again = what_if.Hand(
        ForcePath(hand.rig.tool, hand.device, QUIET, PROFILE), indexings=deque(changes)
    )
    poses = hand.poses[400 + after :]
    for pose, tip, blade in zip(
        poses, hand.tips[400 + after :], hand.blades[400 + after :], strict=True
    ):
        again.tick(pose)
        values = again.contact.values
        fields = ContactCodec.fields
        np.testing.assert_allclose(values[fields['device']], tip, atol=1e-12)
        found = [*values[fields['blade_root']], *values[fields['blade_facing']]]
        np.testing.assert_allclose(found, blade, atol=1e-12)


def test_the_page_draws_the_tool_as_it_is_turned():
    hand = Hand()
    hand.press()
    hand.clutch(True)
    hand.go((0.02, 0.01, 0.03), Rotation.from_rotvec((0.7, -0.4, 1.1)), ms=100)
    for clutched in (True, False):
        hand.clutch(clutched)
        hand.go(hand.place, ms=2)
        contact = StampedMessage(1, '', hand.rig.ticks[-1].contact)
        indexing = hand.rig.path.coupling.indexing
        moment = Translator(hand.device).moment(contact, hand.poses[-1], None, indexing)
        w, *axis = moment.orientation
        drawn = Rotation.from_quat([*axis, w]).apply(hand.rig.tool.blade_root)
        np.testing.assert_allclose(moment.tip + drawn, moment.blade[0], atol=1e-9)


def test_a_clutch_before_the_first_pose_waits_for_it():
    hand = Hand()
    hand.clutch(True)
    hand.go(hand.place, ms=2)
    tip = hand.rig.contact('device')
    hand.go((0, 0, RADIUS - DEPTH), ms=100)
    assert largest_step([tip, hand.rig.contact('device')]) < 1e-12
    assert hand.rig.last_contact.contact[1] == NONE
