"""A node that hangs is killed and started again like one that died, and nobody else is."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import pytest
from live import free_domain, wait_for
from test_supervisor import (
    ENVIRONMENT,
    FAKE,
    ROOT,
    Ledger,
    command,
    ledger,
    wait_for_line,
)

from cutting_trainer.session.node_commands import CUTTING_NODE, node_command, node_environment
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.supervisor import Event, Supervisor

pytestmark = pytest.mark.live

__all__ = ['ledger']
PATIENCE_S = 1.5
"""Without a sign of life, in these tests."""


def beating(name: str, ledger: Ledger) -> NodeCommand:
    return replace(command(name, ledger, 'beats'), has_heartbeat=True)


@pytest.mark.parametrize('restart', [True, False])
def test_frozen_node_is_killed_told_and_started_again_where_nodes_are(
    tmp_path: Path, ledger: Ledger, restart: bool
) -> None:
    told: list[Event] = []
    nodes = [beating('cutting', ledger), beating('tissue_sim', ledger)]
    logs = tmp_path / 'bag' / 'log'
    with Supervisor(
        nodes, logs, ENVIRONMENT, told.append, restart=restart, heartbeat_timeout=PATIENCE_S
    ) as supervisor:
        assert supervisor.start()
        before = supervisor.pids
        os.kill(before['cutting'], signal.SIGSTOP)
        supervisor.run(PATIENCE_S + 2.5)
        after = supervisor.pids
        outcome = supervisor.end()
    assert [death.node for death in outcome.deaths] == ['cutting']
    died = next(event.text for event in told if event.kind == 'died')
    assert died.startswith('cutting hung after ')
    assert 'killed, no sign of life for 1.5 s' in died
    assert died.endswith('started again in 0.5 s' if restart else 'tissue_sim go on')
    assert after.keys() == ({'cutting', 'tissue_sim'} if restart else {'tissue_sim'})
    assert after['tissue_sim'] == before['tissue_sim']
    assert not ledger.running()
    assert 'beat:' not in (logs / 'cutting.log').read_text()


def test_node_that_gives_no_signs_by_its_nature_is_left_alone(
    tmp_path: Path, ledger: Ledger
) -> None:
    with Supervisor(
        [command('cutting', ledger)], tmp_path / 'bag' / 'log', ENVIRONMENT, heartbeat_timeout=0.2
    ) as supervisor:
        assert supervisor.start()
        supervisor.run(1.0)
        assert not supervisor.end().deaths


LAUNCHER = """
    import os, sys
    from pathlib import Path
    from cutting_trainer.session.node_process import NodeCommand
    from cutting_trainer.session.supervisor import Supervisor
    fake, ledger, timeout = sys.argv[1:]
    argv = (sys.executable, '-u', '-S', fake, 'cutting', ledger, 'beats')
    nodes = [NodeCommand('cutting', argv, has_heartbeat=True)]
    with Supervisor(nodes, Path('log'), os.environ, heartbeat_timeout=float(timeout)) as supervisor:
        if supervisor.start():
            print('running', flush=True)
            supervisor.run(60.0)
        print(len(supervisor.end().deaths), 'deaths', flush=True)
"""


def test_launcher_that_was_stopped_does_not_kill_the_nodes_on_waking(ledger: Ledger) -> None:
    arguments = [str(FAKE), str(ledger.path), f'{PATIENCE_S:g}']
    launcher = subprocess.Popen(
        [sys.executable, '-c', textwrap.dedent(LAUNCHER), *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_for_line(launcher, 'running')
    launcher.send_signal(signal.SIGSTOP)
    node = next(pid for name, pid in started(ledger) if name == 'cutting')
    os.kill(node, signal.SIGSTOP)  # so that nothing it has said is waiting for the launcher
    time.sleep(PATIENCE_S + 0.5)
    launcher.send_signal(signal.SIGCONT)
    time.sleep(0.2)
    os.kill(node, signal.SIGCONT)
    time.sleep(0.5)
    launcher.send_signal(signal.SIGINT)
    wait_for_line(launcher, '0 deaths')
    launcher.wait(10)


def started(ledger: Ledger) -> list[tuple[str, int]]:
    rows = [line.split() for line in ledger.path.read_text().splitlines()]
    return [(row[1], int(row[2])) for row in rows if row[0] == 'start']


@pytest.mark.thorough
def test_frozen_cutting_node_is_started_again_and_a_busy_one_is_not_killed(tmp_path: Path) -> None:
    told: list[Event] = []
    scene = ROOT / 'config' / 'scenes' / 'block.yaml'
    node = node_command(CUTTING_NODE, {'scene': str(scene), 'seed': 0})
    environment = node_environment(free_domain())
    with Supervisor(
        [node], tmp_path / 'log', environment, told.append, restart=True, heartbeat_timeout=3.0
    ) as supervisor:
        assert supervisor.start()
        first = supervisor.pids['cutting']
        supervisor.run(4.0)  # lets it be, longer than the timeout
        assert supervisor.pids == {'cutting': first}
        os.kill(first, signal.SIGSTOP)

        def again(elapsed: float) -> bool:
            return sum(event.kind == 'ready' for event in told) < 2

        supervisor.run(60.0, tick=again)
        assert supervisor.pids['cutting'] != first
        outcome = supervisor.end()
    assert [death.hung for death in outcome.deaths] == [3.0]
    wait_for(lambda: not Path(f'/proc/{first}').exists(), 'the hung process to be gone')
