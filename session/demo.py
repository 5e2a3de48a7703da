"""A whole session: the nodes, the bag, the table, the verdict."""

import json
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape

from bags.errors import BagError
from haptic_bridge.hand import compile_script
from session.domain import reserved_domain
from session.errors import SessionError
from session.evidence import read_evidence
from session.graph import (
    ARM_NODE,
    BRIDGE_NODE,
    LOCAL,
    PORT,
    TISSUE_NODE,
    node_environment,
    session_nodes,
    viewer_command,
)
from session.judge import Expected, judge
from session.node_process import NodeCommand
from session.processes import Outcome, Supervisor
from session.progress import SessionProgress
from session.recordings.report import session_tables
from session.scene import Scene, load_scene
from session.status import Status
from session.summary import Summary, summarise
from tissue_sim.share import PACKAGES, is_checkout

SESSIONS = (PACKAGES if is_checkout() else Path()) / 'bags' / 'sessions'
"""In the checkout; in the current folder where the trainer is installed."""
SHORTEST, LONGEST = 1.0, 86400.0  # [s]
OVERTIME = 15.0
"""How long [s] a session may last beyond its script, which waits for the haptic bridge."""


@dataclass(frozen=True)
class DemoOptions:
    """What the command line says.

    Attributes:
        scene: name or path.
        seconds: duration of the arm's script [s]; None: what the scene says.
        bag: folder of the new bag; None: one named after scene and time.
        seed: of everything random.
        domain: ROS domain, or `free`.
        as_json: print the summary as JSON.
        view: serve a page on this machine that shows the session.
    """

    scene: str
    seconds: float | None
    bag: Path | None
    seed: int
    domain: int | Literal['free']
    as_json: bool
    view: bool = False


def run_demo(options: DemoOptions) -> Status:
    """Runs a session and prints what became of it.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)
    seconds = script_seconds(scene, options.seconds)
    bag = new_bag(options.bag, scene.name)
    nodes = session_nodes(scene.path, bag, options.seed, seconds)
    if options.view:
        nodes.insert(0, viewer_command(scene.path, LOCAL, page_port(), session=False))
    notes = Console(stderr=True)
    with reserved_domain(options.domain) as domain:
        outcome = run_nodes(nodes, seconds, bag, node_environment(domain), notes)
    return conclude(outcome, bag, expected_of(scene), as_json=options.as_json)


def conclude(outcome: Outcome, bag: Path, expected: Expected, *, as_json: bool) -> Status:
    """Prints what became of a session.

    Args:
        outcome: of its processes.
        bag: that it was recorded into.
        expected: by its scene.
        as_json: print the summary as JSON.
    """
    console, notes = Console(), Console(stderr=True)
    if outcome.interrupted and not outcome.deaths:
        notes.print(f'interrupted (exit status {int(Status.INTERRUPTED)})', highlight=False)
    if not outcome.ran:
        return not_run(outcome, bag, notes)
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


def expected_of(scene: Scene) -> Expected:
    """What a session of a scene should do."""
    rates = {
        TISSUE_NODE: scene.tissue.integration.rate,
        BRIDGE_NODE: scene.haptics.rate,
        ARM_NODE: scene.arm.rate,
    }
    return Expected(rates, cut=scene.arm.script.cuts)


def page_port() -> int:
    """The usual one; where another page has it 0, which is one that is free."""
    try:
        with socket.create_server((LOCAL, PORT)):
            return PORT
    except OSError:
        return 0


def script_seconds(scene: Scene, asked: float | None) -> float:
    """Of the arm's script [s], refused where the hand would have to be too fast."""
    seconds = asked
    if seconds is None:
        seconds = scene.session.seconds or scene.arm.script.seconds
    elif not SHORTEST <= seconds <= LONGEST:
        raise SessionError(
            f'--seconds is {seconds:g}: give a number from {SHORTEST:g} to {LONGEST:g}'
        )
    compile_script(scene.arm.script, scene.device.tissue_from_device, seconds)
    return seconds


def new_bag(asked: Path | None, scene: str) -> Path:
    """Where the recorder will make the bag, refused where it could not.

    Args:
        asked: what the user wants; None: one in `SESSIONS`.
        scene: that the latter is named after.

    Raises:
        SessionError: it exists already, or cannot be made.
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
    """Runs the nodes of a session until the arm's script is over.

    Args:
        nodes: to run.
        seconds: duration of the script [s].
        bag: folder of the bag; gets the nodes' logs.
        environment: of the nodes.
        notes: where the progress is shown.
        restart: start nodes that die again.
    """
    with (
        SessionProgress(notes, len(nodes)) as progress,
        Supervisor(nodes, bag / 'log', environment, progress.tell, restart=restart) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(
                seconds + OVERTIME,
                until_done=ARM_NODE,
                tick=lambda elapsed: progress.tick(elapsed, seconds),
            )
        return supervisor.end()


def not_run(outcome: Outcome, bag: Path, notes: Console) -> Status:
    """Says why the nodes did not come up."""
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
    notes.print(f'all that the nodes said is in {escape(str(bag / "log"))}', highlight=False)
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
