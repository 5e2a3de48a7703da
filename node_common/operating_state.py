"""CRTK's operating states, their state machine, and the package whose messages carry them."""

import itertools
import threading
from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

from cutting_trainer.node_common.rejections import quoted


class CrtkState(StrEnum):
    """The four operating states of CRTK."""

    DISABLED = 'DISABLED'
    ENABLED = 'ENABLED'
    PAUSED = 'PAUSED'
    FAULT = 'FAULT'


COMMANDS = ('enable', 'disable', 'pause', 'resume', 'home', 'unhome')
E_STOP = 'e_stop'
"""Command beside those of CRTK: E-STOP, a latch that only `reset` releases."""
RESET = 'haptic_bridge/reset_e_stop'
"""Service that releases E-STOP."""
STOPPED = 'emergency stop'
"""Reason of the FAULT while E-STOP is pressed."""

# Pairs that are not listed are invalid and change nothing, PAUSED + enable among them.
_TRANSITIONS = {
    (CrtkState.DISABLED, 'enable'): CrtkState.ENABLED,
    (CrtkState.DISABLED, 'disable'): CrtkState.DISABLED,
    (CrtkState.ENABLED, 'enable'): CrtkState.ENABLED,
    (CrtkState.ENABLED, 'disable'): CrtkState.DISABLED,
    (CrtkState.ENABLED, 'pause'): CrtkState.PAUSED,
    (CrtkState.PAUSED, 'disable'): CrtkState.DISABLED,
    (CrtkState.PAUSED, 'pause'): CrtkState.PAUSED,
    (CrtkState.PAUSED, 'resume'): CrtkState.ENABLED,
    (CrtkState.FAULT, 'enable'): CrtkState.ENABLED,
    (CrtkState.FAULT, 'disable'): CrtkState.DISABLED,
}


class OperatingStateMachine:
    """State machine of a device or bridge without homing motion; thread-safe.

    FAULT is entered on an error, never by a command of CRTK. It stays until `enable` or `disable`
    retries; `enable` succeeds when `cause` reports no error.

    E-STOP is a latch beside the states. While it is pressed, the state is FAULT and every command
    is refused. Only `reset` releases it, to DISABLED.

    Args:
        cause: why force is impossible now, as a sentence, or '' without an error. Called before the
            state ENABLED is entered.
        pressed: whether E-STOP is pressed from the start.
        latches: whether somebody serves `reset`; without it, E-STOP is an ordinary fault.

    Attributes:
        is_homed: CRTK's flag; true from the start.
    """

    def __init__(
        self, cause: Callable[[], str] = str, *, pressed: bool = False, latches: bool = True
    ) -> None:
        self.is_homed = True
        self._state, self._reason = CrtkState.DISABLED, ''
        self._entered = self._stopped = self._orders = 0
        self._cause = cause
        self._latches = latches
        self._lock = threading.RLock()
        self._faults, self._last_fault = 0, ''
        # A press takes no lock, so that a 1 kHz loop never waits for a command, and each has a
        # number of its own, so that a reset releases no press that it has not seen.
        self._numbers = itertools.count(1)
        self._pressed = self._released = 0
        if pressed:
            self.press()

    @property
    def state(self) -> CrtkState:
        """Present state."""
        return CrtkState.FAULT if self.e_stopped else self._state

    @property
    def reason(self) -> str:
        """Reason of the FAULT, else ''."""
        return STOPPED if self.e_stopped else self._reason

    @property
    def changes(self) -> int:
        """Number of transitions and changes of the flag, for publishing on event. What changes is
        written first: who sees a new number sees the new state.
        """
        return self._entered + self._stopped

    @property
    def e_stopped(self) -> bool:
        """Whether E-STOP is pressed."""
        return self._pressed != self._released

    @property
    def presses(self) -> int:
        """Number of the last press of E-STOP, 0 before the first. After a press only a person may
        enable the machine.
        """
        return self._pressed

    @property
    def is_busy(self) -> bool:
        """CRTK's flag: false, because servo commands do not count as busy."""
        return False

    def press(self) -> None:
        """Press E-STOP: enter FAULT from every state until `reset`."""
        again = self.e_stopped
        self._pressed = next(self._numbers)
        self._stopped += not again

    def reset(self) -> bool:
        """Release E-STOP, into DISABLED; return whether it was pressed."""
        with self._lock:
            seen = self._pressed
            if seen == self._released:
                return False
            self._state, self._reason = CrtkState.DISABLED, ''
            self._released = seen
            self._orders += 1
            self._entered += 1
            return True

    def start_anew(self) -> None:
        """Forget all but E-STOP, for a node that is configured again."""
        with self._lock:
            self.is_homed = True
            self._orders += 1
            self._enter(CrtkState.DISABLED, '')

    def command(self, name: str) -> str:
        """Carry out one of `COMMANDS`, or `E_STOP`.

        Returns:
            '' when done, else why not as a sentence; the state is then unchanged, or FAULT with
            the new reason where a cause forbids ENABLED.
        """
        if name == E_STOP:
            if self._latches:
                self.press()
            else:
                self.fault(STOPPED)
            return ''
        if name not in COMMANDS:
            known = ', '.join((*COMMANDS, E_STOP))
            return f'unknown state command {quoted(name)}: use one of {known}'
        # Without the lock: a cause may ask the graph, and the 1 kHz loop may report a fault
        # meanwhile, which then is the cause. Nor does it override a command that came meanwhile.
        faults, before = self._faults, (self._pressed, self._orders)
        cause = self._cause() if self._enables(name) else ''
        with self._lock:
            if self.e_stopped:
                return f'{name} refused: E-STOP is pressed: call the service {RESET} first'
            if self._enables(name) and before != (self._pressed, self._orders):
                return f'{name} refused: another command came meanwhile: send it again'
            self._orders += 1
            if self._faults != faults:
                cause = cause or self._last_fault
            if name in ('home', 'unhome'):
                homed = name == 'home'
                changed = homed is not self.is_homed
                self.is_homed = homed
                self._entered += changed
                return ''
            return self._transit(name, cause)

    def fault(self, reason: str) -> None:
        """Enter FAULT; the first reason stays until a command leaves the state or a retry finds
        another.
        """
        with self._lock:
            self._faults, self._last_fault = self._faults + 1, reason
            if self._state is not CrtkState.FAULT:
                self._enter(CrtkState.FAULT, reason)

    def _enables(self, name: str) -> bool:
        before = self._state
        after = _TRANSITIONS.get((before, name))
        return after is CrtkState.ENABLED and before is not after and not self.e_stopped

    def _transit(self, name: str, cause: str) -> str:
        before = self._state
        after = _TRANSITIONS.get((before, name))
        if after is None:
            hint = ': use resume' if (before, name) == (CrtkState.PAUSED, 'enable') else ''
            return f'{name} is not valid in state {before}{hint}'
        if cause and after is CrtkState.ENABLED and before is not after:
            self._enter(CrtkState.FAULT, cause)
            return f'{name} refused: {cause}'
        self._enter(after, '')
        return ''

    def _enter(self, state: CrtkState, reason: str) -> None:
        changed = (state, reason) != (self._state, self._reason)
        self._state, self._reason = state, reason
        self._entered += changed


class AutoEnable:
    """Enables a machine once, when its conditions are met; never after an E-STOP.

    Args:
        machine: to enable.
        wanted: whether to enable at all.
    """

    def __init__(self, machine: OperatingStateMachine, *, wanted: bool) -> None:
        self._machine = machine
        self._wanted = wanted

    def forgo(self) -> None:
        """Leave enabling to a person from now on."""
        self._wanted = False

    def look(self, is_fresh: Callable[[], bool]) -> None:
        """Enable the machine if `is_fresh` reports that all its inputs are fresh."""
        if self._machine.presses:
            self.forgo()
        if self._wanted and is_fresh():
            self.forgo()
            self._machine.command('enable')


def device_cause(state: str, *, is_homed: bool) -> str:
    """Return why a device in some operating state gives no force, as a sentence; '' if it does.

    Args:
        state: as the device names it; anything but ENABLED is no force.
        is_homed: CRTK's flag; before homing, a device does not know its position.
    """
    if state != CrtkState.ENABLED:
        return f'the device says that it is {state or "in no state"}, not ENABLED'
    return '' if is_homed else 'the device says that it is not homed'


class CrtkTypes(NamedTuple):
    """Message and service classes for operating states.

    Attributes:
        operating_state: OperatingState.
        command: StringStamped.
        query: TriggerOperatingState.
    """

    operating_state: Any
    command: Any
    query: Any


def crtk_types() -> CrtkTypes:
    """Return the message classes of `crtk_msgs` if installed, else of `cutting_trainer_msgs`."""
    try:
        from crtk_msgs.msg import OperatingState, StringStamped
        from crtk_msgs.srv import TriggerOperatingState
    except ModuleNotFoundError:
        from cutting_trainer_msgs.msg import OperatingState, StringStamped
        from cutting_trainer_msgs.srv import TriggerOperatingState
    return CrtkTypes(OperatingState, StringStamped, TriggerOperatingState)
