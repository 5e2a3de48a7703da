"""E-STOP against everything else in any order: never ENABLED after it without a reset."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from cutting_trainer.node_common.operating_state import (
    COMMANDS,
    E_STOP,
    AutoEnable,
    CrtkState,
    OperatingStateMachine,
)

pytestmark = pytest.mark.long


class StoppedBridge(RuleBasedStateMachine):
    """A bridge, its own enabling, and a launcher that remembers what the bridge says of E-STOP."""

    def __init__(self) -> None:
        super().__init__()
        self.cause = ''
        self.fresh = False
        self.stopped = False
        self.start(pressed=False, auto=True)

    def start(self, *, pressed: bool, auto: bool) -> None:
        self.machine = OperatingStateMachine(lambda: self.cause, pressed=pressed)
        self.auto = AutoEnable(self.machine, wanted=auto)

    @rule(name=st.sampled_from((*COMMANDS, 'no such', '', 'E_STOP')))
    def command(self, name: str) -> None:
        refused = self.machine.command(name)
        assert refused or not self.stopped

    @rule(reason=st.sampled_from(('the cable is off', 'emergency stop')))
    def fault(self, reason: str) -> None:
        self.machine.fault(reason)

    @rule(cause=st.sampled_from(('', 'no pose')), fresh=st.booleans())
    def world(self, cause: str, fresh: bool) -> None:
        self.cause, self.fresh = cause, fresh

    @rule()
    def time_passes(self) -> None:
        self.auto.look(lambda: self.fresh)

    @rule(by_word=st.booleans())
    def e_stop(self, by_word: bool) -> None:
        if by_word:
            assert self.machine.command(E_STOP) == ''
        else:
            self.machine.press()
        self.stopped = True

    @rule()
    def reset(self) -> None:
        stopped, before = self.stopped, self.machine.state
        assert self.machine.reset() is stopped
        self.stopped = False
        assert self.machine.state is (CrtkState.DISABLED if stopped else before)

    @rule(auto=st.booleans())
    def dies_and_is_started_again(self, auto: bool) -> None:
        self.start(pressed=self.machine.e_stopped, auto=auto)

    @rule(auto=st.booleans())
    def is_configured_again(self, auto: bool) -> None:
        self.machine.start_anew()
        self.auto = AutoEnable(self.machine, wanted=auto)

    @invariant()
    def stop_holds(self) -> None:
        assert self.machine.e_stopped is self.stopped
        if self.stopped:
            assert self.machine.state is CrtkState.FAULT
            assert self.machine.reason == 'emergency stop'


TestStoppedBridge = StoppedBridge.TestCase
TestStoppedBridge.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)
