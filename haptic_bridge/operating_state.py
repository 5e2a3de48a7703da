"""CRTK's operating states, and which package's messages carry them."""

import threading
from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

from tissue_sim.refusals import quoted


class State(StrEnum):
    """CRTK's four states."""

    DISABLED = 'DISABLED'
    ENABLED = 'ENABLED'
    PAUSED = 'PAUSED'
    FAULT = 'FAULT'


COMMANDS = ('enable', 'disable', 'pause', 'resume', 'home', 'unhome')
E_STOP = 'e_stop'
"""One more command that CRTK does not have: FAULT from any state, as a red button would do."""
_STOPPED = 'emergency stop'

# Pairs that are not listed are invalid and change nothing, PAUSED + enable among them.
_TRANSITIONS = {
    (State.DISABLED, 'enable'): State.ENABLED,
    (State.DISABLED, 'disable'): State.DISABLED,
    (State.ENABLED, 'enable'): State.ENABLED,
    (State.ENABLED, 'disable'): State.DISABLED,
    (State.ENABLED, 'pause'): State.PAUSED,
    (State.PAUSED, 'disable'): State.DISABLED,
    (State.PAUSED, 'pause'): State.PAUSED,
    (State.PAUSED, 'resume'): State.ENABLED,
    (State.FAULT, 'enable'): State.ENABLED,
    (State.FAULT, 'disable'): State.DISABLED,
}


class OperatingStateMachine:
    """The states of one device or bridge that needs no homing motion. Threads may share it.

    FAULT is entered when something is wrong, and by `E_STOP`; none of CRTK's commands leads there.
    It stays until `enable` or `disable` retries; `enable` succeeds when `cause` says that nothing
    is wrong.

    Args:
        cause: why force is impossible now, as a sentence, or '' when nothing is wrong. Asked before
            the state ENABLED is entered.

    Attributes:
        state: where it is.
        reason: why it is in FAULT, else ''.
        is_homed: CRTK's flag; true from the start.
        changes: counts transitions and changes of the flag, for whoever publishes on event.
    """

    def __init__(self, cause: Callable[[], str] = str) -> None:
        self.state = State.DISABLED
        self.reason = ''
        self.is_homed = True
        self.changes = 0
        self._cause = cause
        self._lock = threading.RLock()

    @property
    def is_stopped(self) -> bool:
        """Whether a person has stopped it: nobody but a person may enable it then."""
        return self.reason == _STOPPED

    @property
    def is_busy(self) -> bool:
        """CRTK's flag: false, because servo commands do not count as busy."""
        return False

    def command(self, name: str) -> str:
        """Carries out one of `COMMANDS`, or `E_STOP`.

        Returns:
            '' when done, else why not as a sentence; the state is then unchanged, or FAULT with
            the new reason where a cause forbids ENABLED.
        """
        if name == E_STOP:
            self.fault(_STOPPED)
            return ''
        if name not in COMMANDS:
            known = ', '.join((*COMMANDS, E_STOP))
            return f'unknown state command {quoted(name)}: use one of {known}'
        with self._lock:
            if name in ('home', 'unhome'):
                homed = name == 'home'
                self.changes += homed is not self.is_homed
                self.is_homed = homed
                return ''
            return self._transit(name)

    def fault(self, reason: str) -> None:
        """Enters FAULT. The first reason stays until the state is left or a retry finds another."""
        with self._lock:
            if self.state is not State.FAULT:
                self._enter(State.FAULT, reason)

    def _transit(self, name: str) -> str:
        after = _TRANSITIONS.get((self.state, name))
        if after is None:
            hint = ': use resume' if (self.state, name) == (State.PAUSED, 'enable') else ''
            return f'{name} is not valid in state {self.state}{hint}'
        if after is State.ENABLED and self.state is not after and (cause := self._cause()):
            self._enter(State.FAULT, cause)
            return f'{name} refused: {cause}'
        self._enter(after, '')
        return ''

    def _enter(self, state: State, reason: str) -> None:
        self.changes += (state, reason) != (self.state, self.reason)
        self.state, self.reason = state, reason


def device_cause(state: str, *, is_homed: bool) -> str:
    """Why a device gives no force in an operating state of its own, as a sentence; '' if it does.

    Args:
        state: as the device names it; anything but ENABLED is no force.
        is_homed: CRTK's flag: before homing a device does not know where it is.
    """
    if state != State.ENABLED:
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
    """The classes of `crtk_msgs` where it is installed, else those of `cutting_trainer_msgs`."""
    try:
        from crtk_msgs.msg import OperatingState, StringStamped
        from crtk_msgs.srv import TriggerOperatingState
    except ModuleNotFoundError:
        from cutting_trainer_msgs.msg import OperatingState, StringStamped
        from cutting_trainer_msgs.srv import TriggerOperatingState
    return CrtkTypes(OperatingState, StringStamped, TriggerOperatingState)
