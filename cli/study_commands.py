"""Commands on many recorded sessions."""

from pathlib import Path
from typing import Annotated

import typer

from cutting_trainer.cli.options import EXIT_STATUSES, AsJson

commands = typer.Typer()


@commands.command(epilog=EXIT_STATUSES)
def study(
    file: Annotated[Path, typer.Argument(help='Study file: bags, settings, outputs.')],
    output: Annotated[
        Path | None,
        typer.Option(
            '--output', '-o', help='Folder of the results (default: FILE without its suffix).'
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(min=0, max=1024, help='Own workers; 0: one for each processor.'),
    ] = 0,
    scheduler: Annotated[
        str,
        typer.Option(help='Address of a Dask scheduler whose workers compute, as tcp://host:8786.'),
    ] = '',
    as_json: AsJson = False,
) -> None:
    """Compute recorded hands on many changed scenes, and the effect of each change. Needs no ROS.

    A study that was interrupted goes on where it was.
    """
    from cutting_trainer.studies.study_command import StudyOptions, run_study

    raise typer.Exit(int(run_study(StudyOptions(file, output, workers, scheduler, as_json))))
