"""Commands on a recorded session."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.status import Status

from cutting_trainer.cli.bag_errors import reading
from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, BagArgument, Changes, Domain

commands = typer.Typer()


@commands.command(epilog=EXIT_STATUSES)
def report(
    bag: BagArgument,
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='Page to write (default: BAG/report.html).'),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a recorded session on one page: force, depth, speed, the cut against the plan."""
    from cutting_trainer.recordings.html_report import write_report

    file = output or bag / 'report.html'
    with _working('reading the bag'), reading(bag):
        summary = write_report(bag, file)
    _tell_written([file], as_json=as_json, summary=summary.plain())


@commands.command(epilog=EXIT_STATUSES)
def picture(
    bag: BagArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            '--output', '-o', help='File to write: .png, .svg or .pdf (default: BAG/picture.png).'
        ),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option(min=0.0, help='Moment at which the tissue is shown [s] (default: the end).'),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw a recorded session: the tissue at one moment, the path of the tool, the force."""
    from cutting_trainer.recordings.picture import make_picture

    file = output or bag / 'picture.png'
    with _working('drawing'), reading(bag):
        make_picture(bag, file, at)
    _tell_written([file], as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def replay(
    bag: BagArgument,
    as_recorded: Annotated[
        bool,
        typer.Option(
            '--as-recorded',
            help='Show mesh and forces as they were; without it the recorded hand drives the '
            'simulation afresh.',
        ),
    ] = False,
    rate: Annotated[
        float, typer.Option(min=0.01, max=100.0, help='Seconds of the session in one second.')
    ] = 1.0,
    start: Annotated[float, typer.Option(min=0.0, help='Where to begin [s].')] = 0.0,
    loop: Annotated[bool, typer.Option('--loop', help='Begin again at the end.')] = False,
    domain: Domain = '',
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='New bag for the replay (not with --as-recorded).'),
    ] = None,
    drive_device: Annotated[
        bool,
        typer.Option('--drive-device', help='Let the force reach a live device.'),
    ] = False,
) -> None:
    """Play a recorded session into the graph. Space pauses, s steps one frame, q ends."""
    from cutting_trainer.recordings.replay_command import ReplayOptions
    from cutting_trainer.recordings.replay_command import replay as play
    from cutting_trainer.session.domain import parse_domain

    number = parse_domain(domain)
    options = ReplayOptions(bag, as_recorded, rate, start, loop, number, output, drive_device)
    with reading(bag):
        status = play(options)
    raise typer.Exit(int(status))


@commands.command(epilog=EXIT_STATUSES)
def resimulate(
    bag: BagArgument,
    changes: Changes = None,
    as_json: AsJson = False,
) -> None:
    """Compute a recorded session again: identical, or where it first differs. Needs no ROS."""
    from cutting_trainer.recordings.resimulate_command import resimulate as compute
    from cutting_trainer.session.scene_overrides import parse_changes

    with reading(bag):
        status = compute(bag, parse_changes(changes or []), as_json=as_json)
    raise typer.Exit(int(status))


@commands.command(epilog=EXIT_STATUSES)
def export(
    bag: BagArgument,
    output: Annotated[
        Path,
        typer.Argument(
            help='A mesh file (.vtk, .vtu: solid; .ply, .stl: surface), or a folder for tables.'
        ),
    ],
    at: Annotated[
        float | None, typer.Option(min=0.0, help='Moment of the mesh [s] (default: the end).')
    ] = None,
    parquet: Annotated[
        bool, typer.Option('--parquet', help='Write tables as Parquet, not as CSV.')
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a bag's poses and forces as CSV or Parquet, or its tissue as a mesh."""
    from cutting_trainer.recordings.export_command import export as write

    with _working('reading the bag'), reading(bag):
        files = write(bag, output, at, parquet=parquet)
    _tell_written(files, as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def repair(bag: BagArgument, as_json: AsJson = False) -> None:
    """Make a bag that was cut off readable again, and say what is gone."""
    from cutting_trainer.recordings.repair_command import repair as mend

    with _working('reading the bag'), reading(bag):
        mend(bag, as_json=as_json)


def _working(what: str) -> Status:
    """Show that something is under way, on a terminal, as long as the context lasts."""
    return Console(stderr=True).status(what)


def _tell_written(files: Sequence[Path], *, as_json: bool, **more: object) -> None:
    """Print the written files; with `as_json` as an object with all other values."""
    if as_json:
        print(json.dumps({'written': [str(file) for file in files], **more}, indent=2))
        return
    for file in files:
        Console(soft_wrap=True).print(f'wrote {escape(str(file))}', highlight=False)
