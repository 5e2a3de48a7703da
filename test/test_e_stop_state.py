"""Claims about what the launcher keeps of E-STOP, and about who is started again."""

import os
import sys
import termios
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cutting_trainer.haptic_bridge import e_stop_topic
from cutting_trainer.node_common.operating_state import OperatingStateMachine
from cutting_trainer.session.e_stop_memory import PRESSED, RELEASED, REPEAT_PERIOD_S, EStopState
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.session.terminal_keys import Keys

BRIDGE = NodeCommand('bridge', ('bridge',), e_stop_arguments=('-p', 'e_stop_pressed:=true'))
OTHER = NodeCommand('other', ('other',))
SLEEPER = "print('ready: sleeper', flush=True); import time; time.sleep(60)"


def test_a_press_is_told_again_and_again_until_a_node_says_that_it_holds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr('cutting_trainer.session.e_stop_memory.time.monotonic', lambda: now)
    state = EStopState([BRIDGE, OTHER], keys=False)
    assert not state.poll()
    state.ask()
    for _ in range(50):  # a bridge that starts says first that it is released
        assert state.poll()
        assert not state.poll()
        assert state.interpret(BRIDGE, RELEASED)
        assert state.pressed
        now += REPEAT_PERIOD_S
    assert not state.interpret(OTHER, PRESSED)
    assert state.interpret(BRIDGE, PRESSED)
    now += REPEAT_PERIOD_S
    assert not state.poll()
    assert state.start_command(BRIDGE).argv == (*BRIDGE.argv, *BRIDGE.e_stop_arguments)
    assert state.start_command(OTHER) == OTHER
    state.interpret(BRIDGE, RELEASED)
    assert state.start_command(BRIDGE) == BRIDGE


@pytest.mark.long
def test_a_node_that_was_put_in_the_place_of_a_dead_one_is_not_started_twice(
    tmp_path: Path,
) -> None:
    command = NodeCommand('sleeper', (sys.executable, '-c', SLEEPER))
    with Supervisor([command], tmp_path / 'log', os.environ, restart=True) as supervisor:
        assert supervisor.start()
        os.kill(supervisor.pids['sleeper'], 9)
        supervisor.run(0.3)
        assert supervisor.outcome.deaths
        assert supervisor.replace([command])
        begun = supervisor.pids
        supervisor.run(3.0)  # longer than the first delay
        assert supervisor.pids == begun
        supervisor.remove(['sleeper'])
        assert not supervisor.pids


def test_keys_of_a_terminal_that_is_closed_end_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()
    with os.fdopen(theirs, 'r') as terminal:
        monkeypatch.setattr(sys, 'stdin', terminal)
        monkeypatch.setattr('cutting_trainer.session.terminal_keys._of_another', lambda _: False)
        with Keys() as keys:
            os.write(ours, b'E')
            assert keys.pressed() == 'E'
            settings = termios.tcgetattr(theirs)  # as a shell leaves it that stopped the program
            settings[3] |= termios.ICANON
            termios.tcsetattr(theirs, termios.TCSANOW, settings)
            keys.pressed()
            os.write(ours, b'e')
            assert keys.pressed() == 'e'
            os.close(ours)
            assert keys.pressed() == ''


def test_bridge_answers_each_request_of_the_launcher_though_it_is_pressed_already(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    monkeypatch.setattr(e_stop_topic.output, 'announce', said.append)
    monkeypatch.setattr(e_stop_topic.ros, 'polled', lambda *_: None)
    monkeypatch.setattr(e_stop_topic.ros, 'take_raw', lambda _: None)
    monkeypatch.setattr(e_stop_topic.ros, 'introspect', lambda *_: None)
    publisher = SimpleNamespace(publish=lambda message: None)
    node: Any = SimpleNamespace(
        create_publisher=lambda *_: publisher, create_service=lambda *_: None
    )
    machine = OperatingStateMachine()
    latch = e_stop_topic.EStop(node, machine, button=-1)
    for _ in range(2):
        machine.press()
        latch.confirm()
        for _ in range(3):
            latch.poll(1)
    assert said == [PRESSED, PRESSED]
    machine.reset()
    latch.poll(2)
    assert said[-1] == RELEASED


def test_key_works_after_an_error_of_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    polls: list[int] = []
    counted: list[Exception] = []

    def poll() -> None:
        polls.append(1)
        raise OSError('no such handle')

    rejections = SimpleNamespace(add=lambda topic, error: counted.append(error))
    context = SimpleNamespace(ok=lambda: len(polls) < 3)
    monkeypatch.setattr(e_stop_topic, 'POLL_PERIOD_S', 0.001)
    node = SimpleNamespace(context=context, rejections=rejections, poll_e_stop=poll)
    listener = e_stop_topic.Listener.__new__(e_stop_topic.Listener)
    listener._node, listener._pipe = node, False
    listener._run()
    assert len(counted) == 3
