"""One tick of the force loop, from the device's pose to the force on the operator's hand, without
ROS.

The thesis (ch. 6.2) separates two forces, and so does this: what the proxy's spring exerts loads
the tissue (`Contact.external_force`); what the tissue answers, extrapolated, is what the hand
feels.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from haptic_bridge import chain, extrapolation, safety
from haptic_bridge.chain import INSIDE, NONE, TOUCHING
from haptic_bridge.comparators import CONTACTS
from haptic_bridge.ground import Ground
from haptic_bridge.operating_state import State
from haptic_bridge.settings import (
    DeviceProfile,
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
    check_together,
)
from haptic_bridge.surface import Surface
from haptic_bridge.tissue_sample import TissueSample
from haptic_bridge.wire import Sample
from tissue_sim.refusals import MessageError, Refusals

_SECOND = 1e-9
_LONGEST_STEP = 0.005
"""[s] of slew that a late tick may catch up on."""
_UNNOTICED_NS = 3_000_000
"""[ns] that a sample may lie unread: its age counts from before that, so that deadlines hold."""
_REMEMBERED = 4096
"""Contacts of which the answer may still come."""
ENERGY_CREDIT = 2e-4
"""[J] that the force loop may have made in all before the passivity controller acts, a fifth of
what a press of 5 mm on liver stores: below it are encoder steps and errors of extrapolation."""
POSE, FORCE = 'arm/measured_cp', 'tissue/force'
_INVALID = MessageError('marked invalid', 'its stamp is 0')
_OUTDATED = MessageError('not newer than the one before')
_NOWHERE = ([0] * 9, [0.0] * 9, [0.0] * 3, [0.0] * 3)


class Tick(NamedTuple):
    """What one tick commands.

    Attributes:
        wrench: force [N] and torque [N m] on the hand, as `WrenchStampedCodec` takes them.
        contact: as `ContactCodec` takes it.
        contact_stamp_ns: stamp of the device pose that the contact stems from.
        fault: why force is impossible, '' when nothing is wrong. Whoever calls must enter FAULT.
    """

    wrench: tuple[float, ...]
    contact: tuple[float, ...]
    contact_stamp_ns: int
    fault: str


class ForcePath:
    """Proxy, extrapolation and safety chain in the order of one tick.

    Time comes from outside, so that a recorded session gives the same forces again. Ages are
    measured between arrivals on the caller's clock; stamps are compared with stamps of the same
    sender only.

    Args:
        tool, device, haptics: sections of the scene.
        profile: limits of the device.
        refusals: to count in; None: its own.

    Attributes:
        stale_trips: how often the simulation's data went stale while enabled.
        refusals: messages that were refused: repeated, out of order, marked invalid.
        contact_time: total [s].
        max_force: largest norm commanded [N].

    Raises:
        SettingsError: settings that do not fit together.
    """

    def __init__(
        self,
        tool: ToolSettings,
        device: DeviceSettings,
        haptics: HapticsSettings,
        profile: DeviceProfile,
        refusals: Refusals | None = None,
    ) -> None:
        check_together(tool, device, haptics, profile)
        self.haptics = haptics
        self._tool, self._device, self._profile = tool, device, profile
        self.stale_trips = 0
        self.refusals = refusals or Refusals()
        self.contact_time = 0.0
        self.max_force = 0.0
        self._setup = chain.make_setup(tool, device, haptics, profile)
        self._state = np.zeros(1, chain.STATE)
        self._s: Any = self._state[0]
        names = ('force', 'wrench', 'tip', 'external', 'blade')
        self._force, self._wrench, self._tip, self._external, self._blade = map(
            self._s.__getitem__, names
        )
        self._history = np.zeros(1, extrapolation.HISTORY)
        self._proxy = CONTACTS[haptics.contact](tool.radius)
        self._tail = (tool.coupling_stiffness, tool.radius)
        self._pose = np.zeros(7)
        self._pose_stamp = self._pose_ns = 0
        self._sample_ns = self._current_ns = self._start_ns = self._last_ns = 0
        self._step = self._sample_revision = -1
        self._sample_state = NONE
        self._ground = Ground()
        self._sequence = self._began = self._left = 0
        self._depths = np.zeros((_REMEMBERED, 3))
        self._contact = NONE
        self._was_enabled = self._stale = False

    def scale_force(self, force_scale: float) -> None:
        """Changes how much of the tissue's force the hand feels; the slew limit makes it gradual.

        Args:
            force_scale: hand force over tissue force.

        Raises:
            SettingsError: the coupling would be stiffer than the device bears.
            ValidationError: it is no scale.
        """
        values = self.haptics.model_dump() | {'force_scale': force_scale}
        haptics = HapticsSettings.model_validate(values)
        check_together(self._tool, self._device, haptics, self._profile)
        self._setup = chain.make_setup(self._tool, self._device, haptics, self._profile)
        self.haptics = haptics

    @property
    def force_norm(self) -> float:
        """Norm of the commanded force [N]."""
        return math.hypot(*self._force.tolist())

    @property
    def is_stale(self) -> bool:
        """Whether the simulation is silent while force is wanted."""
        return self._stale

    @property
    def contact(self) -> int:
        """NONE, TOUCHING or INSIDE."""
        return self._contact

    @property
    def energy(self) -> float:
        """What the hand has put in, net [J]; negative: the force loop has made energy."""
        return float(self._s['energy']) - ENERGY_CREDIT

    @property
    def damping(self) -> float:
        """Of the passivity controller now [N s/m]."""
        return float(self._s['damping'])

    def pose_age(self, now_ns: int) -> float:
        """Since the last believable device pose [s]; infinite before the first."""
        return (now_ns - self._pose_ns) * _SECOND if self._pose_ns else np.inf

    def simulation_age(self, now_ns: int) -> float:
        """Since the last force and surface of the simulation [s]; infinite before the first."""
        oldest = min(self._sample_ns, self._current_ns)
        return (now_ns - oldest) * _SECOND if oldest else np.inf

    def cause(self, now_ns: int) -> str:
        """Why the device cannot be given force now; '' when nothing is wrong."""
        if self.pose_age(now_ns) > self.haptics.device_timeout:
            return f'no valid device pose for {self.haptics.device_timeout * 1e3:g} ms'
        return ''

    def is_fresh(self, now_ns: int) -> bool:
        """Whether device, force and surface have all arrived lately."""
        return not self.cause(now_ns) and self.simulation_age(now_ns) <= self.haptics.stale_after

    def tick(
        self,
        now_ns: int,
        *,
        state: State,
        pose: Sample | None = None,
        sample: Sample | None = None,
        sample_ns: int | None = None,
        surface: Surface | None = None,
    ) -> Tick:
        """One period.

        Args:
            now_ns: monotonic clock [ns].
            state: operating state; force only when ENABLED, zero at once when FAULT.
            pose: `measured_cp` where one has arrived since the last tick.
            sample: `ForceSample` where one has arrived since the last tick.
            sample_ns: from when its age counts [ns] where it waited in a queue; None: `now_ns`.
            surface: the newest surface of the tissue; None before the first.
        """
        elapsed = min(max((now_ns - self._last_ns) * _SECOND, 1e-4), _LONGEST_STEP)
        self._last_ns = now_ns
        enabled = state is State.ENABLED
        fault = self._take_pose(now_ns, pose, enabled) or self._take_sample(
            now_ns, sample, now_ns if sample_ns is None else sample_ns
        )
        fault = fault or self.cause(now_ns)
        enabled, fault = enabled and not fault, fault if enabled else ''
        if enabled and not self._was_enabled:
            self._begin(now_ns)
        self._was_enabled = enabled
        gain = self._gain(now_ns, enabled)
        touched = self._touch(now_ns, surface, enabled)
        if fault or state is State.FAULT:
            self._s['force'] = 0.0
        if not chain.command(
            self._setup,
            self._state,
            self._history,
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
        wrench = (*self._wrench.tolist(), 0.0, 0.0, 0.0)
        return Tick(wrench, self._contact_values(surface, touched), self._pose_stamp, fault)

    def _take_pose(self, now_ns: int, pose: Sample | None, enabled: bool) -> str:
        if pose is None:
            return ''
        # After a silence without force anything is a new start: a device may have another clock.
        known = enabled or self.pose_age(now_ns) <= self.haptics.device_timeout
        if pose.stamp_ns == 0 or (known and pose.stamp_ns <= self._pose_stamp):
            self.refusals.add(POSE, _OUTDATED if pose.stamp_ns else _INVALID)
            return ''
        known = known and enabled
        elapsed = (pose.stamp_ns - self._pose_stamp) * _SECOND if known else np.inf
        self._pose[:] = pose.values
        code = safety.pose_gate(self._pose[:3], self._pose[3:], self._s['device'], elapsed)
        if code != safety.OK:
            self.refusals.add(POSE, MessageError(safety.POSE_FAULTS[code]))
            return safety.POSE_FAULTS[code]
        chain.to_tissue(self._setup, self._state, self._pose)
        if not known:
            self._s['moved'] = 0.0
        self._pose_stamp, self._pose_ns = pose.stamp_ns, now_ns
        return ''

    def _take_sample(self, now_ns: int, sample: Sample | None, sample_ns: int) -> str:
        if sample is None:
            return ''
        said = TissueSample.read(sample)
        fresh = (now_ns - self._sample_ns) * _SECOND <= self.haptics.stale_after
        if sample.stamp_ns == 0 or (fresh and said.step <= self._step):
            self.refusals.add(FORCE, _OUTDATED if sample.stamp_ns else _INVALID)
            return ''
        if problem := said.problem:
            self.refusals.add(FORCE, problem)
            extrapolation.clear(self._history)
            return str(problem)
        if not fresh:
            extrapolation.clear(self._history)
        self._step, self._sample_revision = said.step, said.revision
        self._sample_ns = sample_ns - _UNNOTICED_NS
        self._sample_state = said.state
        self._s['resistance'] = said.resistance
        answered = self._began <= said.sequence <= self._sequence and self._contact == TOUCHING
        if said.state == INSIDE or answered:
            there = self._depths[said.sequence % _REMEMBERED]
            extrapolation.push(
                self._history,
                said.time,
                said.position,
                said.force,
                said.stiffness,
                there,
                topology=said.topology,
                state=said.state,
            )
        elif said.sequence > self._left and not self._history['count'][0]:
            # What the tissue says of a place that the tool comes near to, or has touched since.
            if said.stiffness.any():
                self._history['stiffness'] = said.stiffness
            if said.state == NONE and self._contact == NONE:
                self._ground.answered_free(now_ns, said.revision)
        return ''

    def _begin(self, now_ns: int) -> None:
        self._start_ns = now_ns
        self._stale = False
        self._s['energy'] = ENERGY_CREDIT
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
        """Moves the proxy; returns what it touches or comes near to, None where it has no say."""
        self._sequence += 1
        self._follow(now_ns, surface)
        before = self._contact
        inside = self._sample_state == INSIDE
        if enabled and inside:
            # The samples of the cut stay: the change of state has already voided the older ones.
            if before != INSIDE:
                self._proxy.reset()
                self._ground.release()
            self._contact = INSIDE
            self._s['proxy'] = self._tip
            return None
        if before == INSIDE or (before == TOUCHING and not enabled):
            self._leave_contact()
            self._start_ns = now_ns
        if not enabled or surface is None:
            self._s['proxy'] = self._tip
            return None
        ground = self._ground.surface
        assert ground is not None
        touched = self._proxy.step(ground, self._ground.blend(now_ns), self._tip)
        self._s['proxy'] = touched.position
        slot = self._sequence % _REMEMBERED
        self._depths[slot] = touched.position - self._tip
        self._contact = TOUCHING if touched.touching else NONE
        if self._contact != before:
            extrapolation.clear(self._history)
        if not touched.touching:
            if before == TOUCHING:
                self._left = self._sequence
            return touched
        self._ground.press()
        if before != TOUCHING:
            self._began = self._sequence
            # What the last contact dissipated is no credit for this one, what it made is a debt.
            self._s['energy'] = min(self._s['energy'], ENERGY_CREDIT)
        self._s['normal'] = touched.normal
        return touched

    def _follow(self, now_ns: int, surface: Surface | None) -> None:
        if surface is None:
            return
        self._ground.follow(now_ns, surface)
        if surface.revision >= self._sample_revision:
            self._current_ns = now_ns

    def _contact_values(self, surface: Surface | None, touched: Any) -> tuple[float, ...]:
        # Lists: for three numbers an operation of numpy takes ten times as long.
        stiffness, radius = self._tail
        tip, external = self._tip.tolist(), self._external.tolist()
        proxy = [t - e / stiffness for t, e in zip(tip, external, strict=True)]
        revision, topology = (surface.revision, surface.topology) if surface is not None else (0, 0)
        nodes, weights, point, normal = _NOWHERE
        if touched is not None:
            nodes = [max(node, 0) for node in touched.nodes.tolist()]
            weights, normal = touched.weights.tolist(), touched.normal.tolist()
            contact, position = touched.contact.tolist(), touched.position.tolist()
            point = [p + (c - q) for p, c, q in zip(proxy, contact, position, strict=True)]
        return (
            self._sequence,
            self._contact,
            revision,
            topology,
            *nodes,
            *weights,
            *tip,
            *proxy,
            *point,
            *normal,
            *external,
            stiffness,
            *self._blade.ravel().tolist(),
            radius,
        )
