"""One tick of the force loop, from the device's pose to the force on the operator's hand.

This module does not use ROS.

The thesis (ch. 6.2) separates two forces, and so does this module. The force of the proxy's spring
loads the tissue (`Contact.external_force`). The hand feels the extrapolated reaction of the
tissue.
"""

import math
from typing import Any

import numpy as np

from cutting_trainer.haptic_bridge import extrapolation, force_kernels, safety
from cutting_trainer.haptic_bridge.contact_plausibility import MAX_STEP_AHEAD, ContactPlausibility
from cutting_trainer.haptic_bridge.contact_values import NOWHERE, ContactReport, Tick
from cutting_trainer.haptic_bridge.devices.motion_gate import GATE
from cutting_trainer.haptic_bridge.force_kernels import INSIDE, NONE, TOUCHING
from cutting_trainer.haptic_bridge.hand_coupling import HandCoupling
from cutting_trainer.haptic_bridge.proxy.coupling_spring import surface_stiffness
from cutting_trainer.haptic_bridge.proxy.friction import make_proxy, split_stiffness
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.proxy.undented_surface import UndentedSurface
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
)
from cutting_trainer.haptic_bridge.tissue_sample import TissueSample
from cutting_trainer.node_common.cdr_codec import StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.node_common.rejections import MessageError, RejectionStatistics
from cutting_trainer.tissue_sim.contact.blade_constants import UNKNOWN_BLADE, BladeConstants
from cutting_trainer.tissue_sim.contact.friction import NO_FRICTION, Friction
from cutting_trainer.tissue_sim.contact.tool import MAX_PULL_N, ToolMode

_SECOND = 1e-9
_QUEUE_ALLOWANCE_NS = 3_000_000
"""[ns] of queueing that counts as age of a sample too, so that deadlines hold."""
_ENTRY_TIMEOUT_NS = 20_000_000
"""[ns] after which a sample without a blade in the tissue says that it did not go in."""
_BORNE_RATIO = 1.5
"""Factor by which the entry force is exceeded before the same contact lets the blade in again."""
_MAX_PENDING_CONTACTS = 4096
"""Contacts whose answer may still arrive."""
ENERGY_CREDIT_J = 2e-4
"""[J] Energy that the force loop may have generated before the passivity controller acts: a fifth
of the energy of a 5 mm indentation of liver. Encoder steps and extrapolation errors lie below."""
POSE, FORCE = 'arm/measured_cp', 'tissue/force'
_INVALID = MessageError('marked invalid', 'its stamp is 0')
_OUTDATED = MessageError('not newer than the one before')
_AHEAD = MessageError('far ahead of the one before')
_OTHERS = MessageError('of another tool')
_NO_TISSUE = MessageError('a blade in the tissue', 'where the surface is not')


class ForcePath:
    """Computes the force of a tick: proxy, extrapolation and safety chain, in this order.

    Time is an argument, so that a recorded session gives the same forces again. Ages are
    measured between arrivals on the caller's clock; stamps are compared with stamps of the same
    sender only.

    Args:
        tool, device, haptics: sections of the scene.
        profile: limits of the device.
        refusals: rejection statistics to count in; None: its own.
        edge_resistance: largest cutting resistance of the tissue by blade length [N/m].
        friction: of the tool on the tissue.
        constants: of the blade in this tissue.
        number: of the tool, by its place in the list of the scene.

    Attributes:
        stale_trips: how often the simulation's data went stale while enabled.
        refusals: statistics of rejected messages: repeated, out of order, marked invalid.
        contact_time: total [s].
        max_force: largest norm commanded [N].
        mode: of the tool, as it is reported.
        next_mode: mode that it takes once no blade is in the tissue.
        coupling: of hand and tool, which may be changed.

    Raises:
        SettingsError: the settings do not fit together.
    """

    def __init__(
        self,
        tool: ToolSettings,
        device: DeviceSettings,
        haptics: HapticsSettings,
        profile: DeviceProfile,
        rejections: RejectionStatistics | None = None,
        edge_resistance: float = math.inf,
        friction: Friction = NO_FRICTION,
        constants: BladeConstants = UNKNOWN_BLADE,
        number: int = 0,
    ) -> None:
        self.stale_trips = 0
        self.rejections = rejections or RejectionStatistics()
        self.contact_time = 0.0
        self.max_force = 0.0
        self.mode = self.next_mode = ToolMode[tool.mode.upper()]
        self.coupling = HandCoupling(tool, device, haptics, profile, constants)
        self._state = np.zeros(1, force_kernels.STATE)
        self._s: Any = self._state[0]
        names = ('force', 'wrench', 'tip', 'blade', 'arms')
        self._take_mode(self.mode)
        self._force, self._wrench, self._tip, self._blade, self._arms = map(
            self._s.__getitem__, names
        )
        self._plausibility = ContactPlausibility(tool, tool.coupling_stiffness)
        self._length = math.dist(tool.blade_root, tool.blade_tip)
        if any(tool.blade_facing):  # spine and flat do not cut: they stretch the coupling
            edge_resistance = max(edge_resistance, tool.coupling_stiffness)
        self._max_resistance = edge_resistance * self._length
        self._max_resistance += tool.coupling_stiffness * constants.crack_length / 2
        self._history = np.zeros(1, extrapolation.HISTORY)
        self._grips = friction.sliding > 0.0
        self._proxy = make_proxy(tool.radius, self._s['stick'], friction)
        self._stiffness = tool.coupling_stiffness
        self._number = number
        self._report = ContactReport(tool.coupling_stiffness, tool.radius, number)
        self._pose = np.zeros(7)
        self._gate = np.zeros(1, GATE)
        self._pose_stamp = self._pose_ns = 0
        self._sample_ns = self._current_ns = self._start_ns = self._last_ns = 0
        self._step = self._sample_revision = -1
        self._sample_state = NONE
        self._undented = UndentedSurface()
        self._sequence = self._began = self._left = 0
        self._depths = np.zeros((_MAX_PENDING_CONTACTS, 3))
        self._past_arms = np.zeros((_MAX_PENDING_CONTACTS, 2, 3))
        self._contact = NONE
        self._was_enabled = self._stale = False

    def _take_mode(self, mode: ToolMode) -> None:
        self.mode = mode
        self._s['grips'] = mode.is_grasper
        self._s['enters'] = mode is ToolMode.SCALPEL

    @property
    def haptics(self) -> HapticsSettings:
        """Return the section of the scene with the present scale of the force."""
        return self.coupling.haptics

    @property
    def force_norm(self) -> float:
        """Return the norm of the commanded force [N]."""
        return math.hypot(*self._force.tolist())

    @property
    def is_stale(self) -> bool:
        """Return whether the simulation is silent while force is wanted."""
        return self._stale

    @property
    def contact(self) -> int:
        """Return NONE, TOUCHING or INSIDE."""
        return self._contact

    @property
    def energy(self) -> float:
        """Return the net energy that the hand has put in [J]; negative: the loop made energy."""
        return float(self._s['energy']) - ENERGY_CREDIT_J

    @property
    def damping(self) -> float:
        """Return the damping of the passivity controller now [N s/m]."""
        return float(self._s['damping'])

    def pose_age(self, now_ns: int) -> float:
        """Return the time since the last plausible device pose [s]; infinite before the first."""
        return (now_ns - self._pose_ns) * _SECOND if self._pose_ns else np.inf

    def simulation_age(self, now_ns: int) -> float:
        """Return the time since the last force and surface [s]; infinite before the first."""
        oldest = min(self._sample_ns, self._current_ns)
        return (now_ns - oldest) * _SECOND if oldest else np.inf

    def cause(self, now_ns: int) -> str:
        """Return why no force may be commanded now; '' when nothing is wrong."""
        if self.pose_age(now_ns) > self.haptics.device_timeout:
            return f'no valid device pose for {self.haptics.device_timeout * 1e3:g} ms'
        return ''

    def is_fresh(self, now_ns: int) -> bool:
        """Return whether device, force and surface have all arrived lately."""
        return not self.cause(now_ns) and self.simulation_age(now_ns) <= self.haptics.stale_after

    def tick(
        self,
        now_ns: int,
        *,
        state: CrtkState,
        pose: StampedMessage | None = None,
        sample: StampedMessage | None = None,
        sample_ns: int | None = None,
        surface: Surface | None = None,
    ) -> Tick:
        """Compute one period.

        Args:
            now_ns: monotonic clock [ns].
            state: operating state; force only when ENABLED, zero at once when FAULT.
            pose: `measured_cp` where one has arrived since the last tick.
            sample: `ForceSample` where one has arrived since the last tick.
            sample_ns: arrival time of the sample [ns] if it waited in a queue; None: `now_ns`.
            surface: the newest surface of the tissue; None before the first.
        """
        elapsed = min(
            max((now_ns - self._last_ns) * _SECOND, 1e-4), force_kernels.MAX_SLEW_PERIOD_S
        )
        self._last_ns = now_ns
        enabled = state is CrtkState.ENABLED
        if self.coupling.ordered and self._pose_stamp:
            regained = self.coupling.carry_out(self._state, self._pose_stamp)
            self._start_ns = now_ns if regained else self._start_ns
        fault = self._take_pose(now_ns, pose, enabled) or self._take_sample(
            now_ns, sample, now_ns if sample_ns is None else sample_ns, surface
        )
        fault = fault or self.cause(now_ns)
        enabled, fault = enabled and not fault, fault if enabled else ''
        if enabled and not self._was_enabled:
            self._begin(now_ns)
        self._was_enabled = enabled
        gain = self._gain(now_ns, enabled)
        touched = self._touch(now_ns, surface, enabled)
        if self.mode is not self.next_mode and (self._contact != INSIDE or self.mode.is_grasper):
            self._take_mode(self.next_mode)
        if fault or state is CrtkState.FAULT:
            self._s['force'] = self._s['torque'] = 0.0
        if not force_kernels.finish(
            self.coupling.setup,
            self._state,
            self._history,
            (touched or NOWHERE).state,
            touched is not None,
            self._report.record,
            self._depths[self._sequence % _MAX_PENDING_CONTACTS],
            self._contact,
            enabled,
            self._pose_stamp,
            gain,
            elapsed,
        ):
            fault = fault or 'the commanded force was not finite'
        if self._contact != NONE:
            self.contact_time += elapsed
        self.max_force = max(self.max_force, self.force_norm)
        mode = self.mode
        if mode == ToolMode.CLOSED_GRASPER and not enabled:
            mode = ToolMode.OPEN_GRASPER  # without force, the jaws let go
        contact = self._report.values(self._sequence, self._contact, surface, mode)
        return Tick(tuple(self._wrench.tolist()), contact, self._pose_stamp, fault)

    def _take_pose(self, now_ns: int, pose: StampedMessage | None, enabled: bool) -> str:
        if pose is None:
            return ''
        # After a silence without force, motion starts anew: the device may have another clock.
        known = enabled or self.pose_age(now_ns) <= self.haptics.device_timeout
        if pose.stamp_ns == 0 or (known and pose.stamp_ns <= self._pose_stamp):
            self.rejections.add(POSE, _OUTDATED if pose.stamp_ns else _INVALID)
            return ''
        self._pose[:] = pose.values
        setup, gate = self.coupling.setup, self._gate
        code = force_kernels.take_pose(
            setup, self._state, gate, self._pose, pose.stamp_ns, known and enabled
        )
        if code != safety.OK:
            self.rejections.add(POSE, MessageError(safety.POSE_FAULTS[code]))
            return safety.POSE_FAULTS[code]
        self._pose_stamp, self._pose_ns = pose.stamp_ns, now_ns
        return ''

    def _take_sample(
        self, now_ns: int, sample: StampedMessage | None, sample_ns: int, surface: Surface | None
    ) -> str:
        if sample is None:
            return ''
        reaction = TissueSample.read(sample)
        fresh = (now_ns - self._sample_ns) * _SECOND <= self.haptics.stale_after
        if sample.stamp_ns == 0 or (fresh and reaction.step <= self._step):
            self.rejections.add(FORCE, _OUTDATED if sample.stamp_ns else _INVALID)
            return ''
        if problem := reaction.problem:
            self.rejections.add(FORCE, problem)
            extrapolation.clear(self._history)
            return str(problem)
        if reaction.tool != self._number:
            self.rejections.add(FORCE, _OTHERS)
            return ''
        if fresh and reaction.step > self._step + MAX_STEP_AHEAD:
            self.rejections.add(FORCE, _AHEAD)
            return ''
        if reaction.state == INSIDE and not self._accepts_inside(now_ns, surface):
            self.rejections.add(FORCE, _NO_TISSUE)
            return ''
        if not fresh:
            extrapolation.clear(self._history)
        if self._grips and reaction.state != INSIDE and reaction.stiffness.any():
            pressing, beside = split_stiffness(reaction.stiffness, self._proxy.touch.normal)
            reaction = reaction._replace(stiffness=pressing)
            self._s['stick']['stiffness'] = beside
        self._step, self._sample_revision = reaction.step, reaction.revision
        self._sample_ns = sample_ns - _QUEUE_ALLOWANCE_NS
        self._sample_state = reaction.state
        most = MAX_PULL_N if self.mode.is_grasper else self._max_resistance
        self._s['resistance'] = min(reaction.resistance, most)
        self._s['torque_resistance'] = min(
            reaction.torque_resistance, self._max_resistance * self._length
        )
        self._s['advanced'] = self._s['out'] = 0.0
        self._s['renewed'] = True
        self._check_entry(reaction)
        if reaction.state == INSIDE:
            held = max(math.hypot(*reaction.force), math.hypot(*reaction.torque) / self._length)
            self._s['held'] = min(self._s['held'], held + float(self.coupling.setup['slack'][0]))
        elif reaction.stiffness.any():
            reported = surface_stiffness(reaction.stiffness, self._stiffness)
            self._plausibility.update_stiffness(self._state, now_ns, reported)
        answered = self._began <= reaction.sequence <= self._sequence and self._contact == TOUCHING
        if reaction.state == INSIDE or answered:
            slot = reaction.sequence % _MAX_PENDING_CONTACTS
            known = 0 <= self._sequence - reaction.sequence < _MAX_PENDING_CONTACTS
            extrapolation.push(
                self._history,
                reaction.time,
                reaction.position,
                reaction.force,
                reaction.stiffness,
                self._depths[slot],
                topology=reaction.topology,
                state=reaction.state,
                torque=reaction.torque,
                arms=self._past_arms[slot] if known else self._arms,
                immersed=reaction.immersed,
            )
        elif reaction.sequence > self._left and not self._history['count'][0]:
            # The reported state is of a place that the tool approaches, or has touched since.
            if reaction.stiffness.any():
                self._history['stiffness'] = reaction.stiffness
            if reaction.state == NONE and self._contact == NONE:
                self._undented.note_free(now_ns, reaction.revision)
        return ''

    def _check_entry(self, reaction: TissueSample) -> None:
        """Let the blade be outside where the tissue has had time to let it in, and has not."""
        entered = int(self._s['entered'])
        if entered and reaction.state == TOUCHING and reaction.time >= entered + _ENTRY_TIMEOUT_NS:
            self._s['entered'] = 0
            entry = float(self.coupling.setup['entry_force'][0])
            self._s['borne'] = _BORNE_RATIO * max(entry, float(self._s['borne']))

    def _accepts_inside(self, now_ns: int, surface: Surface | None) -> bool:
        already = self._contact == INSIDE
        return self._plausibility.accepts(now_ns, surface, self._blade, already=already)

    def _begin(self, now_ns: int) -> None:
        self._start_ns = now_ns
        self._stale = False
        self._s['energy'] = ENERGY_CREDIT_J
        self._s['velocity'] = 0.0
        self._leave_contact()

    def _leave_contact(self) -> None:
        self._proxy.reset()
        self._contact = NONE
        self._left = self._sequence
        extrapolation.clear(self._history)

    def _gain(self, now_ns: int, enabled: bool) -> float:
        age = self.simulation_age(now_ns)
        stale = enabled and age > self.haptics.stale_after
        if stale and not self._stale:
            self.stale_trips += self._sample_ns > 0
        elif self._stale and not stale:
            self._start_ns = now_ns
        self._stale = stale
        since = (now_ns - self._start_ns) * _SECOND
        return safety.soft_start(since, self.haptics.soft_start) * safety.freshness(
            age, self.haptics.stale_after, self.haptics.fade
        )

    def _touch(self, now_ns: int, surface: Surface | None, enabled: bool) -> Any:
        """Move the proxy; return its contact or nearest triangle, None while it is unused."""
        self._sequence += 1
        self._past_arms[self._sequence % _MAX_PENDING_CONTACTS] = self._arms
        self._follow(now_ns, surface)
        before = self._contact
        inside = enabled and self._sample_state == INSIDE and self._accepts_inside(now_ns, surface)
        if inside:
            # The samples of the cut stay: the change of state has already voided the older ones.
            if before != INSIDE:
                self._s['stretch'] = 0.0
                self._proxy.reset()
                self._undented.release()
                before_cut = self.force_norm / self.haptics.force_scale
                self._s['held'] = before_cut + self.coupling.setup['slack'][0]
            self._contact = INSIDE
            assert surface is not None
            edge = self._blade + self._s['stretch']
            self._s['reach'] = self._plausibility.reach(surface, edge)
            return None
        if before == INSIDE or (before == TOUCHING and not enabled):
            self._leave_contact()
            self._start_ns = now_ns
        if not enabled or surface is None:
            return None
        ground = self._undented.surface
        assert ground is not None
        touched = self._proxy.step(ground, self._undented.blend(now_ns), self._tip)
        self._contact = TOUCHING if touched.touching else NONE
        if self._contact != before:
            extrapolation.clear(self._history)
        if not touched.touching:
            if before == TOUCHING:
                self._left = self._sequence
            return touched
        self._undented.freeze()
        self._plausibility.note_touch(now_ns)
        if before != TOUCHING:
            self._began = self._sequence
            # Energy that the last contact dissipated is no credit; energy that it made is a debt.
            self._s['energy'] = min(self._s['energy'], ENERGY_CREDIT_J)
        return touched

    def _follow(self, now_ns: int, surface: Surface | None) -> None:
        if surface is None:
            return
        self._undented.follow(now_ns, surface)
        if surface.revision >= self._sample_revision:
            self._current_ns = now_ns
