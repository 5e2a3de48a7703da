"""The supervisor: what starts is ended, what dies is named, and nothing is left running."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from cutting_trainer.node_common.timing import FRAME_NICENESS
from cutting_trainer.session.node_process import CUT_OFF, NodeCommand
from cutting_trainer.session.supervisor import Event, Supervisor

pytestmark = pytest.mark.long

GROUP = Path('/proc/self/autogroup')
FAKE = Path(__file__).with_name('fake_node.py')
ROOT = FAKE.parents[1]
ENVIRONMENT = os.environ | {'PYTHONUNBUFFERED': '1'}
ORDER = ('emulated_arm', 'haptic_bridge', 'tissue_sim', 'cutting', 'recorder')


class Ledger:
    """What fake nodes wrote down."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def entries(self, word: str) -> list[tuple[str, float]]:
        if not self.path.exists():
            return []
        rows = [line.split() for line in self.path.read_text().splitlines()]
        return [(row[1], float(row[3])) for row in rows if row[0] == word]

    def running(self) -> list[str]:
        rows = [line.split() for line in self.path.read_text().splitlines()]
        return [row[1] for row in rows if row[0] == 'start' and _lives(int(row[2]))]


def _lives(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except OSError:
        return False
    return state != 'Z'


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, 'it did not happen'
        time.sleep(0.01)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger(tmp_path / 'ledger')


def command(name: str, ledger: Ledger, *habits: str, grace: float = 5.0) -> NodeCommand:
    argv = (sys.executable, '-S', str(FAKE), name, str(ledger.path), *habits)
    return NodeCommand(name, argv, records=name == 'recorder', grace=grace)


def commands(ledger: Ledger, **habits: str) -> list[NodeCommand]:
    """The five nodes of a session; `habits` by name."""
    return [command(name, ledger, *habits.get(name, '').split()) for name in ORDER]


def run_until(supervisor: Supervisor, condition: Callable[[], object]) -> None:
    """Runs a session until something has happened, however long the machine takes for it."""
    supervisor.run(60.0, tick=lambda _: not condition())
    assert condition(), 'it did not happen'


def test_recording_starts_before_all_others_and_ends_after_them(
    tmp_path: Path, ledger: Ledger
) -> None:
    nodes = commands(ledger, recorder='slow', tissue_sim='slow', emulated_arm='done')
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        supervisor.run(60.0, until_done=['emulated_arm'])
        outcome = supervisor.end()
    assert outcome.ran and outcome.finished and not outcome.interrupted
    assert not outcome.deaths and not outcome.killed
    assert ledger.entries('start')[0][0] == 'recorder'
    asked = dict(ledger.entries('SIGINT'))
    assert asked['recorder'] > max(at for name, at in ledger.entries('end') if name != 'recorder')
    assert not ledger.running()


def test_all_lines_of_a_node_are_in_its_log_and_warnings_are_told(
    tmp_path: Path, ledger: Ledger
) -> None:
    told: list[Event] = []
    logs = tmp_path / 'bag' / 'log'
    nodes = [command('cutting', ledger, 'done')]
    with Supervisor(nodes, logs, ENVIRONMENT, told.append) as supervisor:
        assert supervisor.start()
        run_until(supervisor, lambda: [event for event in told if event.kind == 'warning'])
    written = (logs / 'cutting.log').read_text().splitlines()
    assert written[:2] == ['cutting looks around', 'ready: cutting']
    assert written[-1] == '[WARN] [1.0] [cutting]: careful'
    assert [event.kind for event in told] == ['ready', 'warning', 'ending']


def test_time_limit_ends_a_session_that_never_says_done(tmp_path: Path, ledger: Ledger) -> None:
    with Supervisor(commands(ledger), tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        supervisor.run(0.3, until_done=['emulated_arm'])
        outcome = supervisor.end()
    assert outcome.ran and not outcome.finished
    assert outcome.seconds >= 0.3
    assert not ledger.running()


def test_node_killed_in_the_session_is_named_and_the_others_live(
    tmp_path: Path, ledger: Ledger
) -> None:
    told: list[Event] = []
    logs = tmp_path / 'bag' / 'log'
    with Supervisor(commands(ledger), logs, ENVIRONMENT, told.append) as supervisor:
        assert supervisor.start()
        supervisor.run(0.1)
        os.kill(supervisor.pids['tissue_sim'], signal.SIGKILL)
        run_until(supervisor, lambda: [event for event in told if event.kind == 'died'])
        alive = set(ledger.running())
        outcome = supervisor.end()
    assert [death.node for death in outcome.deaths] == ['tissue_sim']
    assert outcome.deaths[0].returncode == -signal.SIGKILL
    assert alive == set(ORDER) - {'tissue_sim'}
    sentence = next(event.text for event in told if event.kind == 'died')
    assert re.match(r'tissue_sim died after [\d.]+ s ', sentence)
    assert 'SIGKILL' in sentence and 'haptic_bridge' in sentence and sentence.endswith('go on')
    assert not ledger.running()


def test_node_that_dies_before_it_is_ready_ends_the_start_with_its_last_lines(
    tmp_path: Path, ledger: Ledger
) -> None:
    nodes = commands(ledger, cutting='dies')
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert not supervisor.start()
        outcome = supervisor.end()
    assert not outcome.ran
    assert outcome.deaths[0].sentence == 'cutting died before it was ready (exit status 7)'
    assert outcome.deaths[0].tail == ('error: no such mesh',)
    assert not ledger.running()


def test_node_that_never_gets_ready_is_named_with_what_it_said_last(
    tmp_path: Path, ledger: Ledger
) -> None:
    nodes = commands(ledger, haptic_bridge='mute')
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert not supervisor.start(timeout=5.0)
        outcome = supervisor.end()
    assert outcome.unready.startswith('haptic_bridge not ready within 5 s (')
    assert 'doctor); haptic_bridge said last' in outcome.unready
    assert 'careful' in outcome.unready
    assert not ledger.running()


def test_node_that_ignores_signals_is_killed_after_its_grace(
    tmp_path: Path, ledger: Ledger
) -> None:
    nodes = [command('cutting', ledger, 'deaf', grace=0.2), command('recorder', ledger)]
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        supervisor.run(0.1)
        outcome = supervisor.end()
    assert outcome.killed == ['cutting']
    asked = [word for word in ('SIGINT', 'SIGTERM') if dict(ledger.entries(word)).get('cutting')]
    assert asked == ['SIGINT', 'SIGTERM']
    assert not ledger.running()


def bad_end(folder: Path, ledger: Ledger, habit: str) -> str:
    """What is said of a node with a habit that is asked to end."""
    said: list[Event] = []
    nodes = [command('cutting', ledger, habit)]
    with Supervisor(nodes, folder / 'bag' / 'log', ENVIRONMENT, said.append) as supervisor:
        assert supervisor.start()
        supervisor.end()
    (sentence,) = [event.text for event in said if 'did not end well' in event.text]
    return sentence


def test_a_node_that_crashes_at_its_end_says_where(tmp_path: Path, ledger: Ledger) -> None:
    sentence = bad_end(tmp_path, ledger, 'crashes')
    assert 'killed by SIGSEGV' in sentence
    assert 'Fatal Python error: Segmentation fault' in sentence and 'in main' in sentence


def test_a_node_that_is_interrupted_as_its_interpreter_starts_shows_no_traceback(
    tmp_path: Path, ledger: Ledger
) -> None:
    sentence = bad_end(tmp_path, ledger, 'unborn')
    assert sentence.endswith('(exit status 1), see its log')


def test_frozen_node_does_not_outlive_the_session(tmp_path: Path, ledger: Ledger) -> None:
    nodes = [command('cutting', ledger, grace=0.2)]
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        os.kill(supervisor.pids['cutting'], signal.SIGSTOP)
        supervisor.run(0.1)
        assert supervisor.end().killed == ['cutting']
    assert not ledger.running()


def test_what_a_node_has_started_ends_with_it(tmp_path: Path, ledger: Ledger) -> None:
    nodes = [command('cutting', ledger, 'parent')]
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        assert sorted(ledger.running()) == ['child', 'cutting']
        supervisor.run(0.1)
    wait_for(lambda: not ledger.running())


def test_exception_in_the_launcher_leaves_nothing_running(tmp_path: Path, ledger: Ledger) -> None:
    def stumble(elapsed: float) -> None:
        raise RuntimeError('stumbled')

    logs = tmp_path / 'bag' / 'log'

    def session() -> None:
        with Supervisor(commands(ledger), logs, ENVIRONMENT) as supervisor:
            assert supervisor.start()
            supervisor.run(5.0, tick=stumble)

    with pytest.raises(RuntimeError, match='stumbled'):
        session()
    assert not ledger.running()


LAUNCHER = """
    import os, sys
    from pathlib import Path
    from cutting_trainer.session.node_process import NodeCommand
    from cutting_trainer.session.supervisor import Supervisor
    fake, ledger, *habits = sys.argv[1:]
    names = ('emulated_arm', 'haptic_bridge', 'recorder')
    nodes = [
        NodeCommand(
            name,
            (sys.executable, '-u', '-S', fake, name, ledger, *habits),
            records=name == 'recorder',
            grace=30.0,
        )
        for name in names
    ]
    tell = lambda event: print(event.kind, event.node, flush=True)
    with Supervisor(nodes, Path(ledger).parent / 'bag' / 'log', os.environ, tell) as supervisor:
        if supervisor.start():
            print('running', flush=True)
            supervisor.run(60.0)
        outcome = supervisor.end()
    print('over', *outcome.deaths, *outcome.killed, flush=True)
    sys.exit(130 if outcome.interrupted else 0)
"""


def launch(ledger: Ledger, *habits: str) -> 'subprocess.Popen[str]':
    """A launcher of its own, for tests that send it signals."""
    return subprocess.Popen(
        [sys.executable, '-c', textwrap.dedent(LAUNCHER), str(FAKE), str(ledger.path), *habits],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for_line(launcher: 'subprocess.Popen[str]', start: str) -> None:
    assert launcher.stdout is not None
    for line in launcher.stdout:
        if line.startswith(start):
            return
    raise AssertionError(f'the launcher never said {start}')


def group_interrupt(launcher: 'subprocess.Popen[str]') -> None:
    """What a terminal does at Ctrl-C."""
    os.killpg(launcher.pid, signal.SIGINT)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_during_the_session_ends_everything(ledger: Ledger, number: signal.Signals) -> None:
    launcher = launch(ledger)
    wait_for_line(launcher, 'running')
    os.killpg(launcher.pid, number)
    assert launcher.wait(60) == 130
    assert not ledger.running()
    asked = ledger.entries('SIGINT')
    assert sorted(name for name, _ in asked) == ['emulated_arm', 'haptic_bridge', 'recorder']
    assert asked[-1][0] == 'recorder'


def test_interrupt_at_the_moment_when_all_are_ready_ends_a_session_that_was(
    tmp_path: Path, ledger: Ledger
) -> None:
    def interrupt(event: Event) -> None:
        if event.kind == 'ready':
            signal.raise_signal(signal.SIGINT)

    nodes = [command('viewer', ledger)]
    with Supervisor(nodes, tmp_path / 'log', ENVIRONMENT, interrupt) as supervisor:
        assert supervisor.start()
        supervisor.run(60.0)
        outcome = supervisor.end()
    assert outcome.ran and outcome.interrupted and not outcome.deaths


def test_interrupt_before_all_are_ready_ends_everything(ledger: Ledger) -> None:
    launcher = launch(ledger, 'mute')
    wait_for(lambda: ledger.entries('start'))
    group_interrupt(launcher)
    assert launcher.wait(60) == 130
    assert not ledger.running()


@pytest.mark.parametrize('pause', [0.0, 0.02, 0.05, 0.1, 0.2])
def test_interrupt_at_any_moment_of_the_start_leaves_nothing_running(
    ledger: Ledger, pause: float
) -> None:
    launcher = launch(ledger)
    wait_for_line(launcher, 'ready recorder')
    time.sleep(pause)
    group_interrupt(launcher)
    assert launcher.wait(60) == 130
    assert not ledger.running()


def test_second_interrupt_kills_the_slow_but_lets_the_recorder_finish(ledger: Ledger) -> None:
    launcher = launch(ledger, 'deaf')
    wait_for_line(launcher, 'running')
    group_interrupt(launcher)
    wait_for(lambda: len(ledger.entries('SIGINT')) == 2)
    assert len(ledger.running()) == 3
    group_interrupt(launcher)
    wait_for_line(launcher, 'killed')
    wait_for(lambda: ledger.running() == ['recorder'])
    wait_for(lambda: dict(ledger.entries('SIGINT')).get('recorder'))
    group_interrupt(launcher)
    time.sleep(0.3)
    assert ledger.running() == ['recorder']
    recorder = next(
        int(line.split()[2])
        for line in ledger.path.read_text().splitlines()
        if line.startswith('start recorder')
    )
    os.kill(recorder, signal.SIGKILL)
    assert launcher.stdout is not None
    assert launcher.stdout.read().splitlines()[-1] == 'over'
    assert launcher.wait(60) == 130
    assert not ledger.running()


def test_node_that_ends_soon_after_a_second_interrupt_is_not_killed(ledger: Ledger) -> None:
    launcher = launch(ledger, 'slow')
    wait_for_line(launcher, 'running')
    group_interrupt(launcher)
    wait_for(lambda: ledger.entries('SIGINT'))
    group_interrupt(launcher)
    assert launcher.stdout is not None
    said = launcher.stdout.read()
    assert launcher.wait(60) == 130
    assert 'killed' not in said
    assert len(ledger.entries('end')) == 3


def test_nothing_survives_a_killed_launcher_and_the_recorder_may_close_its_bag(
    ledger: Ledger,
) -> None:
    launcher = launch(ledger)
    wait_for_line(launcher, 'running')
    assert len(ledger.running()) == 3
    launcher.kill()
    launcher.wait(60)
    wait_for(lambda: not ledger.running())
    assert [name for name, _ in ledger.entries('end')] == ['recorder']
    # Once for each thread of the launcher that dies before the last one.
    assert {name for name, _ in ledger.entries('SIGTERM')} == {'recorder'}


# Nodes that are started again, and one that asks for it


def test_nodes_are_replaced_and_removed_while_the_others_run(
    tmp_path: Path, ledger: Ledger
) -> None:
    with Supervisor(commands(ledger), tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        before = supervisor.pids
        assert supervisor.replace([command(name, ledger) for name in ('cutting', 'tissue_sim')])
        after = supervisor.pids
        supervisor.remove(['recorder'])
        assert 'recorder' not in supervisor.pids
        outcome = supervisor.end()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {'cutting', 'tissue_sim'}
    assert not outcome.deaths and not outcome.killed
    assert not ledger.running()


def test_node_that_cannot_take_anothers_place_is_told_and_the_others_run(
    tmp_path: Path, ledger: Ledger
) -> None:
    with Supervisor(commands(ledger), tmp_path / 'bag' / 'log', ENVIRONMENT) as supervisor:
        assert supervisor.start()
        assert not supervisor.replace([command('cutting', ledger, 'refuses')])
        assert [death.node for death in supervisor.outcome.deaths] == ['cutting']
        assert supervisor.replace([command('cutting', ledger)])
        assert supervisor.pids.keys() == set(ORDER)
    assert not ledger.running()


def test_node_that_converses_is_heard_and_answered(tmp_path: Path, ledger: Ledger) -> None:
    told: list[Event] = []

    def messages() -> list[dict[str, object]]:
        return [dict(event.content) for event in told if event.kind == 'message']

    node = replace(command('viewer', ledger, 'asks'), converses=True)
    with Supervisor([node], tmp_path / 'bag' / 'log', ENVIRONMENT, told.append) as supervisor:
        assert supervisor.start()
        supervisor.answer('viewer', 'yes')
        run_until(supervisor, lambda: len(messages()) == 2)
        supervisor.answer('nobody', 'yes')
    assert messages() == [{'ask': 'may I?'}, {'answered': 'yes'}]


def test_messages_that_cannot_be_read_are_counted_and_end_nothing(
    tmp_path: Path, ledger: Ledger
) -> None:
    told: list[Event] = []
    nodes = [command('viewer', ledger, 'garbles')]
    with Supervisor(nodes, tmp_path / 'bag' / 'log', ENVIRONMENT, told.append) as supervisor:
        assert supervisor.start()
        run_until(supervisor, lambda: sum(event.kind == 'warning' for event in told) >= 3)
        assert supervisor.pids.keys() == {'viewer'}
    said = [event.text for event in told if event.kind == 'warning']
    assert said[0].startswith('a message could not be read')
    assert said[1].startswith('2 messages so far could not be read')
    assert not [event for event in told if event.kind == 'message']
    # What followed in the line that was too long is not taken for lines of its own.
    written = (tmp_path / 'bag' / 'log' / 'viewer.log').read_text().splitlines()
    assert [line.endswith(CUT_OFF) for line in written if 'xxx' in line] == [True]


@pytest.mark.skipif(not GROUP.exists(), reason='the kernel shares processors without groups')
def test_a_session_is_preferred_to_other_programs_until_its_end(tmp_path: Path) -> None:
    """As a group: else the niceness of nodes means nothing to a browser that draws by software."""
    code = f"""
import os
from pathlib import Path
from cutting_trainer.session.supervisor import Supervisor
def niceness():
    return int(Path({str(GROUP)!r}).read_text().split()[-1])
before = niceness()
with Supervisor([], Path({str(tmp_path)!r}), os.environ):
    within = niceness()
print(before, within, niceness())
os.nice(-1)"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, start_new_session=True
    )
    allowed = 'PermissionError' not in done.stderr
    said = [int(word) for word in done.stdout.split()]
    assert said == [0, FRAME_NICENESS if allowed else 0, 0], done
