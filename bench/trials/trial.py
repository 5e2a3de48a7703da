"""A session on trial: its nodes, the course that an operator and a tormentor take, the verdict."""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from rich.console import Console
from rich.table import Table

from cutting_trainer.session.demo_command import report_failed_start
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    node_environment,
    recorder_command,
    simulation_nodes,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import Scene
from cutting_trainer.session.supervisor import Event, Supervisor
from cutting_trainer.session.terminal import session_console


@dataclass(frozen=True)
class TrialOptions:
    """Options of every trial.

    Attributes:
        scene: name or path.
        seed: seed of all random numbers.
        domain: ROS domain, or `free`.
        as_json: print the outcome as JSON.
    """

    scene: str
    seed: int
    domain: int | Literal['free']
    as_json: bool


@dataclass(frozen=True)
class Running:
    """Session whose nodes are all ready.

    Attributes:
        supervisor: supervisor of the nodes.
        domain: ROS domain of the nodes.
        folder: temporary folder of the trial.
        progress: display of the session.
    """

    supervisor: Supervisor
    domain: int
    folder: Path
    progress: SessionProgress


class Course:
    """Actions on a running session."""

    def tick(self, elapsed: float) -> bool | None:
        """Advance the course at a time [s]; return False at its end."""
        raise NotImplementedError

    def ready(self, node: str) -> None:
        """Register a node that was restarted and is ready again; by default do nothing."""

    def end(self) -> None:
        """Leave the graph."""
        raise NotImplementedError


C = TypeVar('C', bound=Course)


def recorded_nodes(
    scene: Scene, options: TrialOptions, folder: Path, bag: Path | None = None
) -> list[NodeCommand]:
    """Return the nodes of a session with a recorder; its bag is in the folder if none is named."""
    nodes = simulation_nodes(scene.path, options.seed, folder / 'checkpoint')
    return [*nodes, recorder_command(scene.path, bag or folder / 'bag', options.seed)]


def run_trial(
    options: TrialOptions,
    nodes: Callable[[Path], Sequence[NodeCommand]],
    begin: Callable[[Running], C],
    report: Callable[[C, Outcome], list[str]],
    *,
    seconds: float,
    bag: Path | None = None,
    restart: bool = False,
) -> Status:
    """Run a session through a course, and report.

    Args:
        options: domain of the session.
        nodes: returns the commands of the nodes; gets the temporary folder of the trial.
        begin: returns the course, once all nodes are ready.
        report: prints the result and returns the failures, as sentences.
        seconds: longest duration [s].
        bag: folder of the logs; None: the temporary folder.
        restart: restart nodes that die. Their warnings are not shown: there are too many.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    notes = session_console()
    with (
        reserved_domain(options.domain) as domain,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
    ):
        commands, logs = nodes(Path(temporary)), bag or Path(temporary)
        course: C | None = None

        def on_event(event: Event) -> None:
            if event.kind == 'ready' and course is not None:
                course.ready(event.node)
            elif event.kind != 'warning' or bag is None:
                progress.show(event)

        with (
            SessionProgress(notes, len(commands)) as progress,
            Supervisor(
                commands, logs / 'log', node_environment(domain), on_event, restart=restart
            ) as supervisor,
        ):
            if not supervisor.start():
                return report_failed_start(supervisor.end(), logs, notes)
            course = begin(Running(supervisor, domain, Path(temporary), progress))
            supervisor.run(seconds, tick=course.tick)
            course.end()
            outcome = supervisor.end()
        failures = report(course, outcome)
    if outcome.interrupted:
        return Status.INTERRUPTED
    return Status.FAILED if failures else Status.OK


def print_result(
    values: Mapping[str, Any],
    table: Table,
    failures: Sequence[str],
    *,
    more: Mapping[str, Any],
    as_json: bool,
) -> None:
    """Print the result of a trial: a table, values and failures; or JSON with `more` values."""
    console = Console()
    if as_json:
        console.out(json.dumps({**values, **more, 'failures': list(failures)}), highlight=False)
        return
    console.print(table)
    for name, value in values.items():
        console.print(f'{name}: {value}', highlight=False, markup=False, soft_wrap=True)
    for failure in failures:
        console.print(f'[bold red]not as it should be:[/] {failure}', highlight=False)
