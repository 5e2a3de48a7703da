"""The command line: `./trainer COMMAND`, or `python -m cutting_trainer.cli COMMAND`."""

import errno
import sys
from itertools import pairwise
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape

from cutting_trainer.cli import (
    bag_commands,
    session_commands,
    study_commands,
    two_host_commands,
    user_commands,
)
from cutting_trainer.cli.options import EXIT_STATUSES
from cutting_trainer.session.exit_status import Status

app = typer.Typer(
    name='trainer',
    help='Teleoperated soft-tissue cutting trainer on ROS 2.',
    epilog=EXIT_STATUSES,
    invoke_without_command=True,
    add_completion=False,  # the command completion has the words in its script
    pretty_exceptions_enable=False,
    rich_markup_mode='markdown',
)
for group in (session_commands, two_host_commands, bag_commands, study_commands, user_commands):
    app.add_typer(group.commands)


UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""What the command line makes of arguments that no command takes."""


@app.callback()
def _trainer(context: typer.Context) -> None:
    """Teleoperated soft-tissue cutting trainer on ROS 2."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: list[str] | None = None) -> None:
    """Run the trainer's command line and exit."""
    run_app(app, 'trainer', arguments)


def run_app(commands: typer.Typer, name: str, arguments: list[str] | None = None) -> NoReturn:
    """Run a command line and exit.

    What the user can mend becomes one line and exit status 2; everything else is a bug, and raised.

    Args:
        commands: to choose from.
        name: by which the user calls them, without the path.
        arguments: of the command line; None: of this process.
    """
    try:
        raise SystemExit(commands(arguments, prog_name=name, standalone_mode=False))
    except UsageError as error:
        _refuse(_misused(error, sys.argv[1:] if arguments is None else arguments))
    except ValueError as error:
        if not _is_users(error):
            raise
        _refuse(str(error))
    except OSError as error:
        if error.filename is None or error.errno not in _REMEDIES:
            raise
        why, remedy = (error.strerror or '').lower(), _REMEDIES[error.errno]
        _refuse(f'{error.filename}: {why}: {remedy}')


_ELSEWHERE = 'name another place, or mend its rights'
_REMEDIES = {
    errno.ENOENT: 'check the path, and that its folder exists',
    errno.ENOTDIR: 'check the path: a part of it is no folder',
    errno.EISDIR: 'name a file, not a folder',
    errno.EACCES: _ELSEWHERE,
    errno.EPERM: _ELSEWHERE,
    errno.EROFS: _ELSEWHERE,
    errno.ENOSPC: 'make room, or name a place on another disk',
}
"""What to do about a file that the system refuses, by the number of its error."""


def _misused(error: Any, arguments: list[str]) -> str:
    """Return one sentence about wrong arguments, with the place of the right ones."""
    reason = ' '.join(error.format_message().split()).removesuffix('.')
    reason = reason.replace('Value error, ', '').replace('Input should', 'it should')
    words = [word for argument in arguments for word in argument.split('=', 1)]
    for name, value in pairwise(words):
        if name.startswith('-'):
            reason = reason.replace(f"value for '{name}':", f'value for {name} {value!r}:')
    path = error.ctx.command_path.partition(' ')[2] if error.ctx else ''
    command = f'./trainer {path}'.strip()
    what = 'what it takes' if path else 'what there is'
    return f'{command}: {reason[:1].lower()}{reason[1:]}; {command} --help says {what}'


def _refuse(sentence: str) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True)
    console.print(f'[bold red]error:[/] {escape(sentence)}', highlight=False)
    raise SystemExit(int(Status.BAD_INPUT)) from None


def _is_users(error: ValueError) -> bool:
    from cutting_trainer.bags.errors import BagError
    from cutting_trainer.haptic_bridge.scene_schema import SettingsError
    from cutting_trainer.node_common.errors import MeshError, SceneError
    from cutting_trainer.session.errors import SessionError
    from cutting_trainer.viewer.access_control import PageError

    known = SessionError | SceneError | MeshError | SettingsError | BagError | PageError
    return isinstance(error, known)


if __name__ == '__main__':
    main()
