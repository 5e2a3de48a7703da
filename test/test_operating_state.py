"""Claims about CRTK's state machine."""

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import Joy

from cutting_trainer.haptic_bridge.device_button import DeviceButton
from cutting_trainer.haptic_bridge.force_kernels import STATE
from cutting_trainer.haptic_bridge.hand_coupling import Order
from cutting_trainer.haptic_bridge.node import HapticBridge
from cutting_trainer.haptic_bridge.scene_schema import SettingsError
from cutting_trainer.node_common.crtk import REPLY_PERIOD_S
from cutting_trainer.node_common.lifecycle import Stop
from cutting_trainer.node_common.operating_state import (
    COMMANDS,
    E_STOP,
    CrtkState,
    OperatingStateMachine,
    crtk_types,
    device_cause,
)
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.tissue_sim.contact.tool import ToolMode

D, E, P, F = CrtkState.DISABLED, CrtkState.ENABLED, CrtkState.PAUSED, CrtkState.FAULT
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


def machine_in(state: CrtkState) -> OperatingStateMachine:
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


@pytest.mark.parametrize('before', CrtkState)
@pytest.mark.parametrize('command', [*COMMANDS, E_STOP, 'no such'])
def test_e_stop_holds_in_every_state_against_every_command_until_it_is_reset(before, command):
    machine = machine_in(before)
    assert machine.command(E_STOP) == ''
    refused = machine.command(command)
    assert 'reset_e_stop' in refused or command in (E_STOP, 'no such')
    machine.fault('the cable is off')
    assert (machine.state, machine.reason, machine.e_stopped) == (F, 'emergency stop', True)
    assert machine.reset()
    assert (machine.state, machine.reason, machine.e_stopped) == (D, '', False)
    assert not machine.reset()


def test_e_stop_of_a_device_that_nobody_resets_is_a_fault_like_any_other():
    machine = OperatingStateMachine(latches=False)
    machine.command(E_STOP)
    assert (machine.state, machine.reason) == (F, 'emergency stop')
    assert machine.command('enable') == ''


@given(st.lists(st.sampled_from(COMMANDS)))
def test_no_sequence_of_commands_enters_fault(commands):
    machine = OperatingStateMachine()
    for command in commands:
        machine.command(command)
        assert machine.state is not F


@pytest.mark.parametrize('state', CrtkState)
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


@pytest.mark.parametrize(
    ('state', 'name', 'refused'),
    [
        (CrtkState.DISABLED, 'enable', 'enable refused: the cable is off'),
        (CrtkState.FAULT, 'enable', 'enable refused: the cable is off'),
        (CrtkState.PAUSED, 'resume', 'resume is not valid in state FAULT'),
    ],
)
def test_a_loop_reports_a_fault_while_the_cause_is_asked_for_and_it_counts(state, name, refused):
    reported: list[bool] = []

    def cause() -> str:
        loop = threading.Thread(target=machine.fault, args=('the cable is off',), daemon=True)
        loop.start()
        loop.join(2.0)
        reported.append(not loop.is_alive())
        return ''

    machine = machine_in(state)
    machine._cause = cause
    assert machine.command(name) == refused
    assert reported == [True]
    assert machine.state is CrtkState.FAULT


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


def stop_and_reset(machine: OperatingStateMachine) -> None:
    machine.press()
    machine.reset()


MEANWHILE = {
    'disable': lambda machine: machine.command('disable'),
    'disable twice': lambda machine: [machine.command('disable') for _ in range(2)],
    'E-STOP and reset': stop_and_reset,
    'a new configuration': OperatingStateMachine.start_anew,
}


@pytest.mark.parametrize('meanwhile', MEANWHILE)
def test_enable_that_still_looks_at_the_graph_overrides_no_later_command(meanwhile):
    machine = OperatingStateMachine(lambda: MEANWHILE[meanwhile](machine) or '')
    assert 'another command came meanwhile' in machine.command('enable')
    assert machine.state is D


def test_resume_that_still_looks_at_the_graph_leaves_a_later_pause():
    machine = OperatingStateMachine()
    machine.command('enable')
    machine.command('pause')
    machine._cause = lambda: machine.command('pause')
    assert 'another command came meanwhile' in machine.command('resume')
    assert machine.state is P


def test_enable_asked_while_e_stop_is_pressed_is_refused_though_a_reset_comes_at_once():
    asked = []
    machine = OperatingStateMachine(lambda: asked.append(1) or '', pressed=True)
    enables = machine._enables

    def enables_then_reset(name: str) -> bool:
        found = enables(name)
        machine.reset()
        return found

    machine._enables = enables_then_reset
    assert machine.command('enable')
    assert machine.state is D and not asked


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
    bridge._machine.fault('no device')
    bridge._machine.command(E_STOP)
    bridge._watch_state()
    assert (bridge._machine.state, bridge._machine.reason) == (F, 'emergency stop')
    assert bridge._machine.reset()
    bridge._watch_state()
    assert bridge._machine.state is D  # and stays so until a person enables it


def test_every_command_is_answered_by_the_state_and_a_flood_of_them_is_answered_seldom(
    bridge: HapticBridge, monkeypatch: pytest.MonkeyPatch
):
    interface, heard = bridge._interface, []
    monkeypatch.setattr(interface, '_publisher', SimpleNamespace(publish=heard.append))
    word = crtk_types().command

    def send(name: str) -> None:
        with suppress(MessageError):
            interface._command(word(string=name))

    for name in ('disable', 'home', 'resume', 'nonsense'):
        time.sleep(2 * REPLY_PERIOD_S)
        before = len(heard)
        send(name)
        assert [m.state for m in heard[before:]] == ['DISABLED'], name
    time.sleep(2 * REPLY_PERIOD_S)
    before, began = len(heard), time.monotonic()
    for _ in range(1000):
        send('nonsense')
    assert len(heard) - before <= 2 + (time.monotonic() - began) / REPLY_PERIOD_S
    time.sleep(2 * REPLY_PERIOD_S)
    before = len(heard)
    interface.publish_changes()  # as the loop does: the last of them waits for no further command
    interface.publish_changes()
    assert len(heard) == before + 1
    for _ in range(2):  # and once more, for a client that was still sending
        time.sleep(2 * REPLY_PERIOD_S)
        interface.publish_changes()
    assert len(heard) == before + 2


def test_a_bridge_whose_state_watch_fails_is_in_fault_and_follows_the_mesh(
    bridge: HapticBridge, monkeypatch: pytest.MonkeyPatch
):
    followed = []
    monkeypatch.setattr(bridge._follower, 'follow_mesh', lambda: followed.append(True))
    monkeypatch.setattr(bridge, '_watch_state', lambda: 1 / 0)
    bridge._work_beside(Stop(lambda: len(followed) > 5))
    assert bridge._machine.state is F
    assert 'the state watch failed: ZeroDivisionError' in bridge._machine.reason


def test_of_a_request_that_is_refused_nothing_is_used(bridge: HapticBridge):
    request = [Parameter('force_scale', value=value) for value in (1.5, float('nan'))]
    assert not bridge.set_parameters_atomically(request).successful
    assert bridge._path.haptics.force_scale == 1.0
    assert bridge.set_parameters_atomically(request[:1]).successful
    assert bridge._path.haptics.force_scale == 1.5


def test_two_scales_of_one_request_count_together(bridge: HapticBridge):
    def ask(force: float, motion: float) -> SetParametersResult:
        given = {'force_scale': force, 'motion_scale': motion}
        return bridge.set_parameters_atomically([Parameter(n, value=v) for n, v in given.items()])

    coupling = bridge._path.coupling
    for alone in ({'force_scale': 3.0}, {'motion_scale': 3.0}):
        coupling.check(**alone)
    refused = ask(3.0, 3.0)
    assert not refused.successful and 'the device bears' in refused.reason
    assert coupling.check() == Order(1.0, bridge._path.haptics)
    assert ask(0.25, 4.0).successful
    with pytest.raises(SettingsError, match='the device bears'):
        coupling.check(force_scale=3.0)
    assert ask(3.0, 1.0).successful  # though the first of the two alone would be refused
    assert (coupling.check().motion_scale, bridge._path.haptics.force_scale) == (1.0, 3.0)


def test_a_scale_out_of_range_is_refused_in_a_sentence(bridge: HapticBridge):
    for name, wrong, why in (
        ('motion_scale', 0.0, 'motion_scale is 0: input should be greater than or equal to 0.001'),
        ('motion_scale', 1e9, 'motion_scale is 1e+09: input should be less than or equal to 100'),
        ('force_scale', -1.0, 'force_scale is -1: input should be greater than or equal to 0.001'),
        ('force_scale', float('nan'), 'force_scale is nan: input should be a finite number'),
    ):
        refused = bridge.set_parameters([Parameter(name, value=wrong)])[0]
        assert not refused.successful and refused.reason == why


def test_the_mode_of_the_tool_is_a_parameter_and_a_button_changes_it(bridge: HapticBridge):
    refused = bridge.set_parameters([Parameter('tool_mode', value='saw')])[0]
    assert not refused.successful and 'scalpel or palpator or open_grasper' in refused.reason
    bridge.set_parameters([Parameter('tool_mode', value='palpator')])
    assert bridge._path.next_mode == ToolMode.PALPATOR
    button = DeviceButton(bridge, 'button', 1, bridge._inputs.change_mode)
    for pressed in ([0, 0], [0, 1], [0, 1], [0, 0]):
        button._event(Joy(buttons=pressed))
    assert bridge._path.next_mode == ToolMode.SCALPEL
    assert bridge.get_parameter('tool_mode').value == 'scalpel'
    with pytest.raises(MessageError, match='no such button'):
        button._event(Joy(buttons=[0]))


def test_the_scale_of_motion_is_a_parameter_and_a_button_is_the_clutch(bridge: HapticBridge):
    refused = bridge.set_parameters([Parameter('motion_scale', value=60.0)])[0]
    assert not refused.successful and 'the device bears' in refused.reason
    assert bridge.set_parameters([Parameter('motion_scale', value=0.5)])[0].successful
    coupling = bridge._path.coupling
    state = np.zeros(1, STATE)
    state['device'] = 0.1, 0.2, 0.3
    state['orientation'] = 0.0, 0.0, 0.0, 1.0
    before = coupling.indexing
    coupling.carry_out(state, 5)
    assert (before.scale, coupling.indexing.scale) == (1.0, 0.5)
    assert coupling.indexing.after_ns == 5
    for pressed in (1, 0):
        bridge._inputs.clutch._event(Joy(buttons=[pressed]))
        coupling.carry_out(state, 6)
        assert coupling.indexing.clutched == pressed
    assert [i.clutched for i in coupling.unsent] == [False, True, False]
