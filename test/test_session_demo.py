"""The demo command's exit status tells what became of the session."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cutting_trainer.session import demo_command
from cutting_trainer.session.demo_command import DemoOptions, run_demo
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import MODULES
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.summary import Summary

FAKE = Path(__file__).with_name('fake_node.py')
Run = Callable[..., Status]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the demo on fake nodes with the given habits."""

    def session(seconds: float = 5.0, **habits: str) -> Status:
        fake = (sys.executable, '-S', str(FAKE))
        nodes = []
        for name in MODULES:
            argv = (*fake, name, str(tmp_path / 'ledger'), *habits.get(name, '').split())
            nodes.append(NodeCommand(name, argv, records=name == 'recorder'))
        monkeypatch.setattr(demo_command, 'session_nodes', lambda *arguments: nodes)
        return run_demo(DemoOptions('block', seconds, tmp_path / 'bag', 0, 'free', False))

    return session


@pytest.fixture
def perfect(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bag with which everything is all right."""
    summary = Summary('bag', True, 5.0, {}, 1.0, 1.0, 0.0, 0.0, 1, 1, {}, {})
    monkeypatch.setattr(demo_command, 'read_evidence', lambda folder: None)
    monkeypatch.setattr(demo_command, 'summarise', lambda evidence: summary)
    monkeypatch.setattr(
        demo_command, 'expectations', lambda scene: demo_command.Expected({}, cut=True)
    )


@pytest.mark.usefixtures('perfect')
def test_session_that_finished_is_a_success_and_every_node_has_its_log(
    run: Run, tmp_path: Path
) -> None:
    assert run(emulated_arm='done') == Status.OK
    assert {path.stem for path in (tmp_path / 'bag' / 'log').iterdir()} == set(MODULES)


@pytest.mark.usefixtures('perfect')
def test_dead_node_is_the_exit_status_even_of_a_session_that_finished(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(cutting='falls', emulated_arm='done') == Status.NODE_DIED
    assert 'cutting died after' in capsys.readouterr().err


@pytest.mark.usefixtures('perfect')
def test_script_that_never_ends_is_a_failure(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo_command, 'MAX_OVERTIME_S', -4.5)
    assert run() == Status.FAILED
    assert 'did not finish its script' in capsys.readouterr().err


@pytest.mark.usefixtures('perfect')
def test_interrupted_session_still_has_its_table(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> None:
        ledger = tmp_path / 'ledger'
        while not ledger.exists() or ledger.read_text().count('start') < len(MODULES):
            time.sleep(0.01)
        time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    assert run() == Status.INTERRUPTED
    captured = capsys.readouterr()
    assert 'elements cut' in captured.out
    assert 'not as it should be' not in captured.err
    assert 'interrupted (exit status 130)' in captured.err


def test_session_without_a_readable_bag_is_a_failure(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(emulated_arm='done') == Status.FAILED
    assert 'no summary' in capsys.readouterr().err


def test_what_a_node_refuses_is_bad_input_in_the_words_of_the_node(run: Run) -> None:
    with pytest.raises(SessionError, match=r'^cutting: no such mesh$'):
        run(cutting='refuses')


def test_node_that_dies_at_the_start_is_told_with_its_last_lines(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tissue_sim='dies') == Status.NODE_DIED
    text = capsys.readouterr().err
    assert 'tissue_sim died before it was ready (exit status 7)' in text
    assert 'tissue_sim: error: no such mesh' in text
