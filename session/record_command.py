"""`trainer record`: the recorder alone, for a graph that runs already."""

import json
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cutting_trainer.session.demo_command import new_bag, report_failed_start
from cutting_trainer.session.domain import parse_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import RECORDER_NODE, node_environment, recorder_command
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.supervisor import Event, Supervisor
from cutting_trainer.session.terminal import session_console

_FOREVER = 1e9
_COLUMNS = ('received', 'written', 'lost', 'missed')


def run_recorder(
    output: Path | None, scene: str, seed: int, domain: str, *, as_json: bool = False
) -> Status:
    """Record until Ctrl-C and print an account of the messages by topic.

    Args:
        output: folder of the new bag; None: a folder named after scene and time.
        scene: name or path of the scene that the nodes run; empty: unknown.
        seed: seed of the session.
        domain: ROS domain; empty: that of the environment.
        as_json: print the account as JSON.

    Raises:
        SessionError, SceneError: an option or the scene is not valid.
    """
    number = parse_domain(domain)
    if number == 'free':
        raise SessionError('--domain free has no graph in it: give the domain of the nodes')
    if output == Path():
        raise SessionError('--output names no folder: give the path of a new one')
    path = load_scene(scene).path if scene else None
    bag = new_bag(output, path.stem if path else RECORDER_NODE)
    notes = session_console(soft_wrap=True)
    command = recorder_command(path, bag, seed, {'account_as_json': True})
    outcome, account = _run(command, bag, number, notes)
    if not outcome.ran:
        return report_failed_start(outcome, bag, notes)
    if as_json:
        print(json.dumps(account, indent=2))
    elif account:
        Console().print(account_table(account))
    for failure in outcome.failures:
        notes.print(f'[bold red]not as it should be:[/] {escape(failure)}', highlight=False)
    if outcome.deaths:
        return Status.NODE_DIED
    return Status.FAILED if outcome.failures else Status.OK


def _run(
    command: NodeCommand, bag: Path, domain: int, notes: Console
) -> tuple[Outcome, dict[str, Any]]:
    """Return the outcome of the recorder and its account, empty where there is none."""
    account: dict[str, Any] = {}
    began = time.monotonic()

    def on_event(event: Event) -> None:
        if event.kind == 'message':
            message = event.content
            account.update(message if 'bag' in message else {})
            account.setdefault('topics', {}).update({} if 'bag' in message else message)
        elif event.kind == 'ready':
            notes.print(f'recording into {escape(str(bag))}; Ctrl-C ends it', highlight=False)
        elif event.kind != 'ending':
            notes.print(escape(event.text), highlight=False)

    def tick(_: float) -> None:
        size = sum(file.stat().st_size for file in bag.glob('*.mcap'))
        status.update(f'{time.monotonic() - began:.0f} s, {size / 1e6:.1f} MB')

    with (
        notes.status('starting') as status,
        Supervisor([command], bag / 'log', node_environment(domain), on_event) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(_FOREVER, tick=tick)
        return supervisor.end(), account


def account_table(account: dict[str, Any]) -> Table:
    """Return the counts of messages by topic, and the topics that were not recorded."""
    table = Table(title=f'{escape(account["bag"])}, {account["bytes"] / 1e6:.1f} MB')
    table.add_column('topic', overflow='fold')
    for word in _COLUMNS:
        title = 'missed before subscription' if word == 'missed' else word
        table.add_column(title, justify='right')
    for topic, counts in account['topics'].items():
        table.add_row(escape(topic), *(str(counts[word]) for word in _COLUMNS))
    sums = [sum(counts[word] for counts in account['topics'].values()) for word in _COLUMNS]
    table.add_section()
    table.add_row('all', *map(str, sums))
    for topic, reason in account['not_recorded'].items():
        table.add_row(escape(f'{topic}: not recorded: {reason}'))
    return table
