"""`trainer demo`: run a session, record its bag, print its table and its verdict."""

import json
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape

from cutting_trainer.bags.errors import BagError
from cutting_trainer.exercises.attempt_store import SUBJECT
from cutting_trainer.haptic_bridge.emulated_arm.hand import compile_script
from cutting_trainer.node_common.share_folder import PACKAGES, is_checkout
from cutting_trainer.session.acceptance_criteria import Expected, judge
from cutting_trainer.session.attempts import attempt_data
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    ARM_NODE,
    BRIDGE_NODE,
    LOCAL,
    PORT,
    TISSUE_NODE,
    node_environment,
    session_nodes,
    viewer_command,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.result_table import session_tables
from cutting_trainer.session.scene_loader import Scene, load_scene, require_frames
from cutting_trainer.session.summary import Summary, summarise
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.session.terminal import session_console

SESSIONS = (PACKAGES if is_checkout() else Path()) / 'bags' / 'sessions'
"""In the checkout; in the current folder where the trainer is installed."""
MIN_DURATION_S, MAX_DURATION_S = 1.0, 86400.0  # [s]
MAX_OVERTIME_S = 15.0
"""A session may last so much longer [s] than its script, which waits for the haptic bridge."""


@dataclass(frozen=True)
class DemoOptions:
    """Options of `demo`.

    Attributes:
        scene: name or path.
        seconds: duration of the arm's script [s]; None: that of the scene.
        bag: folder of the new bag; None: a folder named after scene and time.
        seed: seed of all random numbers.
        domain: ROS domain, or `free`.
        as_json: print the summary as JSON.
        view: serve a page on this machine with a view of the session.
        subject: pseudonym of who makes the attempt; empty: a new one for an exercise.
        notes: remarks on the session.
    """

    scene: str
    seconds: float | None
    bag: Path | None
    seed: int
    domain: int | Literal['free']
    as_json: bool
    view: bool = False
    subject: str = ''
    notes: str = ''


def run_demo(options: DemoOptions) -> Status:
    """Run a session and print its result.

    Raises:
        SessionError, SceneError, SettingsError: an option or the scene is not valid.
    """
    if not re.fullmatch(SUBJECT, options.subject):
        raise SessionError(
            f'--subject is {options.subject!r:.60}: write a pseudonym of letters (A to Z), digits, '
            'points, hyphens and underscores'
        )
    scene = load_scene(options.scene)
    require_frames(scene)
    seconds = script_seconds(scene, options.seconds)
    bag = new_bag(options.bag, scene.name)
    tools = [tool.label for tool in scene.others]
    said = {'subject': options.subject, 'notes': options.notes}
    if scene.exercise.title:
        said = attempt_data(bag.parent, scene.name, options.subject, options.notes)
    nodes = session_nodes(scene.path, bag, options.seed, seconds, tools, said)
    if options.view:
        nodes.insert(0, viewer_command(scene.path, LOCAL, page_port(), session=False))
    notes = session_console()
    with reserved_domain(options.domain) as domain:
        outcome = run_nodes(nodes, seconds, bag, node_environment(domain), notes)
    return conclude(outcome, bag, expectations(scene), as_json=options.as_json)


def conclude(outcome: Outcome, bag: Path, expected: Expected, *, as_json: bool) -> Status:
    """Print the result of a session.

    Args:
        outcome: outcome of its processes.
        bag: bag of the session.
        expected: expectations of its scene.
        as_json: print the summary as JSON.
    """
    console, notes = Console(), Console(stderr=True)
    if outcome.interrupted and not outcome.deaths:
        notes.print(f'interrupted (exit status {int(Status.INTERRUPTED)})', highlight=False)
    if not outcome.ran:
        return report_failed_start(outcome, bag, notes)
    try:
        with notes.status('reading the bag'):
            summary = summarise(read_evidence(bag))
    except BagError as error:
        notes.print(f'[bold red]no summary:[/] {escape(str(error))}')
        return _status(outcome, ['no summary'])
    failures = judge(summary, outcome, expected)
    if as_json:
        _print_json(summary, outcome, failures, console)
    else:
        console.print(session_tables(summary))
    for failure in failures:
        notes.print(f'[bold red]not as it should be:[/] {escape(failure)}', highlight=False)
    return _status(outcome, failures)


def expectations(scene: Scene) -> Expected:
    """Return the expectations of a scene: rates, and whether it cuts."""
    rates = {TISSUE_NODE: scene.tissue.integration.rate}
    for tool in scene.tools:
        prefix = f'{tool.label}/' if tool.label else ''
        rates |= {prefix + BRIDGE_NODE: tool.haptics.rate, prefix + ARM_NODE: tool.arm.rate}
    scripts = [tool.arm.script for tool in scene.tools]
    return Expected(rates, cut=any(script is not None and script.cuts for script in scripts))


def page_port() -> int:
    """Return the default port; 0, which is any free port, where the default is taken."""
    try:
        with socket.create_server((LOCAL, PORT)):
            return PORT
    except OSError:
        return 0


def script_seconds(scene: Scene, asked: float | None) -> float:
    """Return the duration of the arm's script [s].

    Raises:
        SessionError, SettingsError: it is out of range, or the hand would be too fast.
    """
    scripts, seconds = [tool.arm.require_script() for tool in scene.tools], asked
    if seconds is None:
        seconds = scene.session.seconds or max(script.seconds for script in scripts)
    elif not MIN_DURATION_S <= seconds <= MAX_DURATION_S:
        raise SessionError(
            f'--seconds is {seconds:g}: give a number from {MIN_DURATION_S:g} to {MAX_DURATION_S:g}'
        )
    for tool, script in zip(scene.tools, scripts, strict=True):
        compile_script(script, tool.device.tissue_from_device, seconds)
    return seconds


def new_bag(asked: Path | None, scene: str) -> Path:
    """Return the folder that the recorder will make the bag in.

    Args:
        asked: folder that the user names; None: a new one in `SESSIONS`.
        scene: scene that the folder in `SESSIONS` is named after.

    Raises:
        SessionError: the folder exists already, or cannot be made.
    """
    if asked == Path():
        raise SessionError('--bag names no folder: give the path of a new one')
    if asked is None:
        folder = SESSIONS / f'{scene}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}'
    else:
        folder = asked.resolve()
        if folder.parent.exists() and not folder.parent.is_dir():
            raise SessionError(f'{folder.parent} is a file: name a folder that the bag can go into')
    try:
        folder.mkdir(parents=True)
        folder.rmdir()
    except FileExistsError:
        raise SessionError(f'{folder} exists already: name a new folder for the bag') from None
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise SessionError(
            f'{folder} cannot be made ({why}): name another folder for the bag'
        ) from None
    return folder.resolve()


def run_nodes(
    nodes: list[NodeCommand],
    seconds: float,
    bag: Path,
    environment: Mapping[str, str],
    notes: Console,
    *,
    restart: bool = False,
) -> Outcome:
    """Run the nodes of a session until the end of the arm's script.

    Args:
        nodes: nodes to run.
        seconds: duration of the script [s].
        bag: folder of the bag and of the nodes' logs.
        environment: environment of the nodes.
        notes: console for the progress.
        restart: restart nodes that die.
    """
    with (
        SessionProgress(notes, len(nodes)) as progress,
        Supervisor(nodes, bag / 'log', environment, progress.show, restart=restart) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(
                seconds + MAX_OVERTIME_S,
                until_done=[c.name for c in nodes if c.name.rpartition('/')[2] == ARM_NODE],
                tick=lambda elapsed: progress.tick(elapsed, seconds),
            )
        return supervisor.end()


def report_failed_start(outcome: Outcome, bag: Path, notes: Console) -> Status:
    """Print the reason why the nodes did not start; return the exit status."""
    if outcome.interrupted:
        return Status.INTERRUPTED
    for death in outcome.deaths:
        refusal = next((line for line in death.tail if line.startswith('error: ')), None)
        if death.returncode == Status.BAD_INPUT and refusal:
            raise SessionError(f'{death.node}: {refusal.removeprefix("error: ")}')
        for line in death.tail:
            notes.print(f'  {death.node}: {escape(line)}', highlight=False)
    if outcome.unready:
        notes.print(f'[bold red]error:[/] {escape(outcome.unready)}', highlight=False)
    notes.print(f'the logs of the nodes are in {escape(str(bag / "log"))}', highlight=False)
    return Status.NODE_DIED if outcome.deaths else Status.FAILED


def _status(outcome: Outcome, failures: list[str]) -> Status:
    if outcome.deaths:
        return Status.NODE_DIED
    if outcome.interrupted:
        return Status.INTERRUPTED
    return Status.FAILED if failures else Status.OK


def _print_json(summary: Summary, outcome: Outcome, failures: list[str], console: Console) -> None:
    plain = summary.plain() | {
        'finished': outcome.finished,
        'interrupted': outcome.interrupted,
        'deaths': [death.sentence for death in outcome.deaths],
        'failures': failures,
    }
    console.out(json.dumps(plain, indent=2), highlight=False)
