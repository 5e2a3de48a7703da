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
from cutting_trainer.haptic_bridge.contact_plausibility import (
    MAX_STEP_AHEAD,
    WORK,
    bounded_stiffness,
)
from cutting_trainer.haptic_bridge.contact_values import Tick, make_report
from cutting_trainer.haptic_bridge.devices.motion_gate import GATE
from cutting_trainer.haptic_bridge.force_kernels import ENERGY_CREDIT_J, INSIDE, NONE, TOUCHING
from cutting_trainer.haptic_bridge.force_tick import (
    is_plausible_alone,
    leave_contact_alone,
    tick,
)
from cutting_trainer.haptic_bridge.hand_coupling import HandCoupling
from cutting_trainer.haptic_bridge.proxy.coupling_spring import surface_stiffness
from cutting_trainer.haptic_bridge.proxy.friction import make_stick, split_stiffness
from cutting_trainer.haptic_bridge.proxy.proxy import NO_WAY, Proxy
from cutting_trainer.haptic_bridge.proxy.surface import NO_GEOMETRY, Surface
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
        rejections: statistics to count in; None: its own.
        edge_resistance: largest cutting resistance of the tissue by blade length [N/m].
        friction: of the tool on the tissue.
        constants: of the blade in this tissue.
        number: of the tool, by its place in the list of the scene.

    Attributes:
        rejections: statistics of rejected messages: repeated, out of order, marked invalid.
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
        self.rejections = rejections or RejectionStatistics()
        self.coupling = HandCoupling(tool, device, haptics, profile, constants)
        self._state = np.zeros(1, force_kernels.STATE)
        self._s: Any = self._state[0]
        self._s['mode'] = self._s['next_mode'] = ToolMode[tool.mode.upper()]
        names = ('force', 'wrench', 'tip', 'arms')
        self._force, self._wrench, self._tip, self._arms = map(self._s.__getitem__, names)
        self._length = math.dist(tool.blade_root, tool.blade_tip)
        if any(tool.blade_facing):  # spine and flat do not cut: they stretch the coupling
            edge_resistance = max(edge_resistance, tool.coupling_stiffness)
        self._max_resistance = edge_resistance * self._length
        self._max_resistance += tool.coupling_stiffness * constants.crack_length / 2
        self._history = np.zeros(1, extrapolation.HISTORY)
        self._grips = friction.sliding > 0.0
        self._s['stick'] = make_stick(friction)
        self._proxy = Proxy(tool.radius, self._s['stick'])
        self._work = np.zeros(1, WORK)
        self._stiffness = tool.coupling_stiffness
        self._stiffness_ns: int | None = None
        self._number = number
        self._report = make_report(tool.coupling_stiffness, tool.radius, number)
        self._pose = np.zeros(7)
        self._gate = np.zeros(1, GATE)
        self._pose_stamp = self._pose_ns = 0
        self._step = self._sample_revision = -1
        self._undented = UndentedSurface()
        self._depths = np.zeros((_MAX_PENDING_CONTACTS, 3))
        self._past_arms = np.zeros((_MAX_PENDING_CONTACTS, 2, 3))
        self._contact = NONE
        self._was_enabled = False

    @property
    def mode(self) -> ToolMode:
        """Return the mode of the tool, as it is reported."""
        return ToolMode(self._s['mode'])

    @property
    def next_mode(self) -> ToolMode:
        """Return the mode that it takes once no blade is in the tissue."""
        return ToolMode(self._s['next_mode'])

    @next_mode.setter
    def next_mode(self, mode: ToolMode) -> None:
        self._s['next_mode'] = mode

    @property
    def stale_trips(self) -> int:
        """Return how often the simulation's data went stale while force was wanted."""
        return int(self._s['stale_trips'])

    @property
    def contact_time(self) -> float:
        """Return the time of contact in all [s]."""
        return float(self._s['contact_time'])

    @property
    def max_force(self) -> float:
        """Return the largest norm commanded [N]."""
        return float(self._s['max_norm'])

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
        return bool(self._s['stale'])

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
        oldest = min(int(self._s['sample_ns']), int(self._s['current_ns']))
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
        enabled = state is CrtkState.ENABLED
        if self.coupling.ordered and self._pose_stamp:
            regained = self.coupling.carry_out(self._state, self._pose_stamp)
            if regained:
                self._s['start_ns'] = now_ns
        fault = self._take_pose(now_ns, pose, enabled) or self._take_sample(
            now_ns, sample, now_ns if sample_ns is None else sample_ns, surface
        )
        fault = fault or self.cause(now_ns)
        enabled, fault = enabled and not fault, fault if enabled else ''
        if enabled and not self._was_enabled:
            self._begin(now_ns)
        self._was_enabled = enabled
        zero = bool(fault) or state is CrtkState.FAULT
        if not self._compute(now_ns, surface, enabled, zero):
            fault = fault or 'the commanded force was not finite'
        wrench, message = tuple(self._wrench.tolist()), self._report.tobytes()
        return Tick(wrench, message, self._pose_stamp, fault)

    def _compute(self, now_ns: int, surface: Surface | None, enabled: bool, zero: bool) -> bool:
        """Compute contact, command and report; return False where they are not finite.

        Args:
            now_ns: monotonic clock [ns].
            surface: the newest of the tissue.
            enabled: whether force is wanted.
            zero: whether the force goes to zero at once.
        """
        undented = self._undented
        newest, motion, way = NO_GEOMETRY, 0.0, NO_WAY
        revision, topology = -1, 0
        if surface is not None:
            revision, topology = surface.revision, surface.topology
            undented.follow(now_ns, surface)
            newest, motion = surface.geometry, surface.motion
            if enabled:
                assert undented.surface is not None
                way = self._proxy.way_to(undented.surface, undented.blend(now_ns))
        self._contact, finite = tick(
            self.coupling.setup,
            self._state,
            self._history,
            self._depths,
            self._past_arms,
            self._report,
            self._proxy.touch.state,
            self._work,
            newest,
            motion,
            *way,
            now_ns,
            self._pose_stamp,
            enabled,
            zero,
            revision,
            topology,
            surface is not None and revision >= self._sample_revision,
        )
        if self._contact == TOUCHING:
            undented.freeze()
        elif self._contact == INSIDE:
            undented.release()
        return finite

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
        age = (now_ns - int(self._s['sample_ns'])) * _SECOND
        fresh = age <= self.haptics.stale_after
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
        if reaction.state == INSIDE and not self._is_plausible(now_ns, surface):
            self.rejections.add(FORCE, _NO_TISSUE)
            return ''
        if not fresh:
            extrapolation.clear(self._history)
        if self._grips and reaction.state != INSIDE and reaction.stiffness.any():
            pressing, beside = split_stiffness(reaction.stiffness, self._proxy.touch.normal)
            reaction = reaction._replace(stiffness=pressing)
            self._s['stick']['stiffness'] = beside
        self._step, self._sample_revision = reaction.step, reaction.revision
        self._s['sample_ns'] = sample_ns - _QUEUE_ALLOWANCE_NS
        self._s['says_inside'] = reaction.state == INSIDE
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
            since = None if self._stiffness_ns is None else now_ns - self._stiffness_ns
            known = float(self._s['known'])
            self._s['known'] = bounded_stiffness(known, since, reported, self._stiffness)
            self._stiffness_ns = now_ns
        began, last, left = (int(self._s[name]) for name in ('began', 'sequence', 'left'))
        answered = began <= reaction.sequence <= last and self._contact == TOUCHING
        if reaction.state == INSIDE or answered:
            slot = reaction.sequence % _MAX_PENDING_CONTACTS
            kept = 0 <= last - reaction.sequence < _MAX_PENDING_CONTACTS
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
                arms=self._past_arms[slot] if kept else self._arms,
                immersed=reaction.immersed,
            )
        elif reaction.sequence > left and not self._history['count'][0]:
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

    def _is_plausible(self, now_ns: int, surface: Surface | None) -> bool:
        """Return whether the blade can be in the tissue."""
        return surface is not None and is_plausible_alone(
            self.coupling.setup,
            self._state,
            surface.geometry,
            surface.motion,
            now_ns,
            self._work,
        )

    def _begin(self, now_ns: int) -> None:
        self._s['start_ns'] = now_ns
        self._s['stale'] = False
        self._s['energy'] = ENERGY_CREDIT_J
        self._s['velocity'] = 0.0
        leave_contact_alone(self._state, self._history, self._proxy.touch.state)
        self._contact = NONE
