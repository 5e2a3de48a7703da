"""Claims about CRTK's state machine."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st

from haptic_bridge.node import HapticBridge
from haptic_bridge.operating_state import (
    COMMANDS,
    E_STOP,
    OperatingStateMachine,
    State,
    crtk_types,
    device_cause,
)
from session.domain import reserved_domain
from tissue_sim.lifecycle import Stop

D, E, P, F = State.DISABLED, State.ENABLED, State.PAUSED, State.FAULT
INVALID = True
# CRTK's table: state by state, the command, the state after it, and whether it is invalid there.
TABLE = [
    (D, 'enable', E, not INVALID),
    (D, 'disable', D, not INVALID),
    (D, 'pause', D, INVALID),
    (D, 'resume', D, INVALID),
    (E, 'enable', E, not INVALID),
    (E, 'disable', D, not INVALID),
    (E, 'pause', P, not INVALID),
    (E, 'resume', E, INVALID),
    (P, 'enable', P, INVALID),
    (P, 'disable', D, not INVALID),
    (P, 'pause', P, not INVALID),
    (P, 'resume', E, not INVALID),
    (F, 'enable', E, not INVALID),
    (F, 'disable', D, not INVALID),
    (F, 'pause', F, INVALID),
    (F, 'resume', F, INVALID),
]


def machine_in(state: State) -> OperatingStateMachine:
    machine = OperatingStateMachine()
    for command in {D: (), E: ('enable',), P: ('enable', 'pause'), F: ()}[state]:
        machine.command(command)
    if state is F:
        machine.fault('the cable is off')
    return machine


@pytest.mark.parametrize(('before', 'command', 'after', 'invalid'), TABLE)
def test_table_of_transitions_is_that_of_crtk(before, command, after, invalid):
    machine = machine_in(before)
    refused = machine.command(command)
    assert machine.state is after
    assert bool(refused) == invalid
    if invalid:
        assert f'{command} is not valid in state {before}' in refused


def test_enable_while_paused_points_to_resume():
    assert 'use resume' in machine_in(P).command('enable')


@pytest.mark.parametrize('before', State)
def test_emergency_stop_is_a_fault_from_every_state_until_a_command_leaves_it(before):
    machine = machine_in(before)
    assert machine.command(E_STOP) == ''
    assert machine.state is F
    assert machine.reason == ('the cable is off' if before is F else 'emergency stop')
    for refused in ('resume', 'pause'):
        assert machine.command(refused)
        assert machine.state is F
    assert machine.command('disable') == ''
    assert machine.state is D


@given(st.lists(st.sampled_from(COMMANDS)))
def test_no_sequence_of_commands_enters_fault(commands):
    machine = OperatingStateMachine()
    for command in commands:
        machine.command(command)
        assert machine.state is not F


@pytest.mark.parametrize('state', State)
def test_fault_is_entered_from_every_state_and_latched_with_its_reason(state):
    machine = machine_in(state)
    machine.fault('the cable is off')
    machine.fault('and something else')
    assert (machine.state, machine.reason) == (F, 'the cable is off')
    for command in ('pause', 'resume', 'home'):
        machine.command(command)
    assert (machine.state, machine.reason) == (F, 'the cable is off')
    machine.command('disable')
    assert (machine.state, machine.reason) == (D, '')


@pytest.mark.parametrize('state', [D, F])
def test_enable_is_refused_with_a_reason_while_the_cause_lasts(state):
    causes = ['no pose from the device']
    machine = OperatingStateMachine(lambda: causes[-1])
    if state is F:
        machine.fault('the cable is off')
    assert 'no pose from the device' in machine.command('enable')
    assert (machine.state, machine.reason) == (F, 'no pose from the device')
    causes.append('')
    assert not machine.command('enable')
    assert (machine.state, machine.reason) == (E, '')


def test_home_and_unhome_change_the_flag_and_no_state():
    machine = machine_in(P)
    machine.command('unhome')
    assert (machine.is_homed, machine.state) == (False, P)
    machine.command('home')
    assert (machine.is_homed, machine.state) == (True, P)


def test_unknown_command_is_refused_with_the_known_ones():
    refused = OperatingStateMachine().command('Enable')
    assert "'Enable'" in refused
    assert all(command in refused for command in COMMANDS)


def test_changes_count_only_what_an_observer_would_see():
    machine = OperatingStateMachine()
    for command in ('disable', 'enable', 'enable', 'pause', 'pause', 'enable', 'home'):
        machine.command(command)
    machine.fault('a')
    machine.fault('b')
    assert machine.changes == 3


def test_messages_have_the_fields_of_crtk():
    types = crtk_types()
    state = types.operating_state.get_fields_and_field_types()
    assert list(state) == ['header', 'state', 'is_homed', 'is_busy']
    assert list(types.command.get_fields_and_field_types()) == ['header', 'string']
    assert list(types.query.Response.get_fields_and_field_types()) == ['operating_state']


@pytest.mark.parametrize('state', ['DISABLED', 'PAUSED', 'FAULT', 'UNDEFINED', ''])
def test_a_device_in_any_state_but_enabled_or_not_homed_is_a_cause(state):
    assert device_cause('ENABLED', is_homed=True) == ''
    assert 'not homed' in device_cause('ENABLED', is_homed=False)
    assert 'not ENABLED' in device_cause(state, is_homed=True)


@pytest.fixture
def bridge(tmp_path: Path) -> Iterator[HapticBridge]:
    """The node, configured, with its own enabling still to come."""
    scene = tmp_path / 'scene.yaml'
    scene.write_text('device: {profile: emulated}\n')
    with reserved_domain('free') as domain:
        rclpy.init(
            args=['--ros-args', '-p', f'scene:={scene}', '-p', 'auto_enable:=true'],
            domain_id=domain,
        )
    node = HapticBridge()
    try:
        node.configure()
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_a_bridge_that_was_stopped_before_its_start_does_not_enable_itself(
    bridge: HapticBridge, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(bridge._path, 'is_fresh', lambda now_ns: True)
    monkeypatch.setattr(bridge._machine, '_cause', str)
    bridge._machine.command(E_STOP)
    bridge._watch_state()
    assert (bridge._machine.state, bridge._machine.reason) == (F, 'emergency stop')
    bridge._machine.command('disable')  # a person's
    bridge._watch_state()
    assert bridge._machine.state is E


def test_a_bridge_whose_state_watch_fails_is_in_fault_and_follows_the_mesh(
    bridge: HapticBridge, monkeypatch: pytest.MonkeyPatch
):
    followed = []
    monkeypatch.setattr(bridge._follower, 'follow_mesh', lambda: followed.append(True))
    monkeypatch.setattr(bridge, '_watch_state', lambda: 1 / 0)
    bridge._work_beside(Stop(lambda: len(followed) > 5))
    assert bridge._machine.state is F
    assert 'the state watch failed: ZeroDivisionError' in bridge._machine.reason
