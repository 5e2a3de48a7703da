"""Commands on a recorded session."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.status import Status

from cutting_trainer.cli.bag_errors import reading
from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, BagArgument, Changes, Domain
from cutting_trainer.session.errors import SessionError

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
def film(
    bag: BagArgument,
    output: Annotated[
        Path, typer.Option('--output', '-o', help='File to write: .mp4, .webm or .gif.')
    ],
    beside: Annotated[
        Path | None, typer.Option(help='Folder of another bag, to show beside it.')
    ] = None,
    start: Annotated[float, typer.Option(min=0.0, help='Where to begin [s].')] = 0.0,
    end: Annotated[float | None, typer.Option(min=0.0, help='Where to end [s].')] = None,
    rate: Annotated[
        float, typer.Option(min=0.01, max=100.0, help='Seconds of the session in one second.')
    ] = 1.0,
    fps: Annotated[int, typer.Option(min=1, max=120, help='Pictures a second.')] = 30,
    size: Annotated[
        tuple[int, int], typer.Option(min=64, max=4096, help='Width and height [pixel].')
    ] = (1280, 720),
    zoom: Annotated[
        float, typer.Option(min=0.2, max=8.0, help='How much nearer than on the page.')
    ] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Write a recorded session as a moving picture, drawn by the page. Needs Chromium."""
    from cutting_trainer.recordings.film_command import FilmOptions, make_film

    even = size[0] & -2, size[1] & -2
    options = FilmOptions(bag, output, beside, start, end, rate, fps, even, zoom)
    with Progress(console=Console(stderr=True), transient=True) as shown, reading(bag):
        task = shown.add_task('drawing', total=1.0)
        make_film(options, lambda share: shown.update(task, completed=share))
    _tell_written([output], as_json=as_json)


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
    """Compute a recorded session again: identical, or where it first differs. Needs no ROS.

    With changes of the scene, the force that the recorded hand would feel, beside the recorded one.
    """
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
            help='A mesh file (.vtk, .vtu: solid; .ply, .stl: surface), a file of arrays (.h5), or '
            'a folder for tables or a data set.'
        ),
    ],
    at: Annotated[
        float | None, typer.Option(min=0.0, help='Moment of the mesh [s] (default: the end).')
    ] = None,
    form: Annotated[
        Literal['csv', 'parquet', 'hdf5', 'lerobot'],
        typer.Option(
            '--format',
            help='Of tables: csv, parquet. Of all bags below the folder: hdf5, one file of arrays; '
            'lerobot, a data set.',
        ),
    ] = 'csv',
    data_licence: Annotated[
        str,
        typer.Option('--licence', help='Licence of the recordings (hdf5, lerobot): CC-BY-4.0.'),
    ] = '',
    video: Annotated[
        bool,
        typer.Option(
            '--video', help='With pictures, 25 in a second (lerobot); slow. Needs Chromium.'
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a bag's poses and forces as tables, its tissue as a mesh, or bags as a data set."""
    if video and form != 'lerobot':
        raise SessionError(f'--video is for --format lerobot: {form} has no pictures')
    if form in ('hdf5', 'lerobot'):
        from cutting_trainer.studies.bag_collection import find_bags

        if at is not None:
            raise SessionError('--at is the time of a mesh: a data set has whole sessions')
        if form == 'hdf5':
            from cutting_trainer.studies.session_arrays import write_sessions as write_bags
        else:
            from cutting_trainer.studies.dataset import write_dataset

            write_bags = partial(write_dataset, pictures=video)
        with _working('reading the bags') as shown, reading(bag):
            bags = find_bags([str(bag)], Path.cwd())
            files = write_bags(
                bags, output, data_licence, lambda name: shown.update(f'writing {escape(name)}')
            )
        _tell_written(files, as_json=as_json)
        return
    from cutting_trainer.recordings.export_command import export as write

    with _working('reading the bag'), reading(bag):
        files = write(bag, output, at, parquet=form == 'parquet')
    _tell_written(files, as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def repair(bag: BagArgument, as_json: AsJson = False) -> None:
    """Make a bag that was cut off readable again, and say what is gone."""
    from cutting_trainer.recordings.repair_command import repair as mend

    with _working('reading the bag'), reading(bag):
        mend(bag, as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def attempts(
    folder: Annotated[
        Path | None, typer.Argument(help='Folder of the bags (default: bags/sessions).')
    ] = None,
    subject: Annotated[str, typer.Option(help='Only this subject.')] = '',
    exercise: Annotated[str, typer.Option(help='Only this exercise: name of its scene.')] = '',
    compare: Annotated[
        tuple[str, str] | None, typer.Option(help='Compare the attempts of two bags.')
    ] = None,
    curves: Annotated[
        bool, typer.Option('--curves', help='Learning curves by subject and exercise.')
    ] = False,
    output: Annotated[
        Path | None, typer.Option('--output', '-o', help='Write .csv or .parquet.')
    ] = None,
    delete: Annotated[
        str, typer.Option(help='Delete this subject: rows of the index and bags in the folder.')
    ] = '',
    as_json: AsJson = False,
) -> None:
    """List scored attempts at exercises, compare two, draw curves, export, delete a subject."""
    from dataclasses import asdict

    from cutting_trainer.recordings import attempts_command as of
    from cutting_trainer.session.attempts import open_store
    from cutting_trainer.session.demo_command import SESSIONS
    from cutting_trainer.session.errors import SessionError

    bags = folder or SESSIONS
    if folder is not None and not folder.is_dir():
        raise SessionError(f'{folder} is no folder: name one with bags in it')
    if delete and (subject or exercise or compare or curves or output is not None):
        raise SessionError(
            '--delete takes all attempts of a subject: leave --subject, --exercise, --compare, '
            '--curves and --output out'
        )
    console, store = Console(), open_store(bags)
    with _working('reading new bags'):
        for problem in of.index_bags(store, bags):
            Console(stderr=True).print(f'left out: {escape(problem)}', highlight=False)
    if delete:
        gone = of.delete(store, bags, delete)
        many = f'{len(gone)} bag{"s" * (len(gone) != 1)}'
        said = f'deleted the attempts of {delete}, with {many}'
        _tell({'deleted': gone} if as_json else said, as_json=as_json)
        return
    rows = of.chosen(store, subject, exercise)
    if output is not None:
        of.export_rows(rows, output)
        _tell_written([output], as_json=as_json)
    elif compare is not None:
        one, two = (of.find(rows, name) for name in compare)
        both = [of.plain(one), of.plain(two)]
        _tell(both, as_json=True) if as_json else console.print(of.comparison_table(one, two))
    elif curves:
        found, table = of.curves_table(rows)
        _tell([asdict(c) for c in found], as_json=True) if as_json else console.print(table)
    elif as_json:
        _tell([of.plain(row) for row in rows], as_json=True)
    else:
        console.print(of.list_table(rows))


def _tell(outcome: object, *, as_json: bool) -> None:
    print(json.dumps(outcome, indent=2) if as_json else outcome)


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
