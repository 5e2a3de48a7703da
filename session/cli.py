"""The command line: `./trainer COMMAND`, or `python -m session.cli COMMAND`."""

import errno
import sys
from itertools import pairwise
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape

from session import commands_bags, commands_live, commands_measure, commands_network, commands_own
from session.options import EXIT_STATUSES
from session.status import Status

app = typer.Typer(
    name='trainer',
    help='Teleoperated soft-tissue cutting trainer on ROS 2.',
    epilog=EXIT_STATUSES,
    invoke_without_command=True,
    add_completion=False,  # the command completion has the words in its script
    pretty_exceptions_enable=False,
    rich_markup_mode='markdown',
)
for group in (commands_live, commands_network, commands_bags, commands_measure, commands_own):
    app.add_typer(group.commands)


UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""What the command line makes of arguments that no command takes."""


@app.callback()
def _trainer(context: typer.Context) -> None:
    """Teleoperated soft-tissue cutting trainer on ROS 2."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits.

    What the user can mend becomes one line and exit status 2; everything else is a bug, and raised.
    """
    try:
        raise SystemExit(app(arguments, prog_name='trainer', standalone_mode=False))
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
    """What is wrong with the arguments, in one sentence, and where those that are right stand."""
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
    from bags.errors import BagError
    from haptic_bridge.settings import SettingsError
    from session.errors import SessionError
    from tissue_sim.errors import MeshError, SceneError
    from viewer.page import PageError

    known = SessionError | SceneError | MeshError | SettingsError | BagError | PageError
    return isinstance(error, known)


if __name__ == '__main__':
    main()
