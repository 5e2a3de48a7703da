"""Commands on many recorded sessions."""

from pathlib import Path
from typing import Annotated

import typer

from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, Changes, Scheduler, Workers

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
    workers: Workers = 0,
    scheduler: Scheduler = '',
    as_json: AsJson = False,
) -> None:
    """Compute recorded hands on many changed scenes, and the effect of each change. Needs no ROS.

    A study that was interrupted goes on where it was.
    """
    from cutting_trainer.studies.study_command import StudyOptions, run_study

    raise typer.Exit(int(run_study(StudyOptions(file, output, workers, scheduler, as_json))))


@commands.command(epilog=EXIT_STATUSES)
def identify(
    bags: Annotated[
        list[str], typer.Argument(help='Bags, folders with bags anywhere below, globs, or URLs.')
    ],
    output: Annotated[Path, typer.Option('--output', '-o', help='Folder of the results.')] = Path(
        'identified'
    ),
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            '--parameter',
            help='A constant of tissue.material; may be given again (default: those above 0 in '
            'the scene).',
        ),
    ] = None,
    noise: Annotated[
        float,
        typer.Option(min=1e-6, max=10.0, help='Noise of one component of the force, rms [N].'),
    ] = 0.003,
    changes: Changes = None,
    refine: Annotated[
        bool,
        typer.Option(
            '--refine',
            help='Search on, on the mesh refined once: 2 to 16 times the time. Intervals hold the '
            'error of the mesh then.',
        ),
    ] = False,
    workers: Workers = 0,
    scheduler: Scheduler = '',
    as_json: AsJson = False,
) -> None:
    """Find the material under which recorded hands feel the recorded forces. Needs no ROS."""
    from cutting_trainer.session.scene_overrides import parse_changes
    from cutting_trainer.studies.identify_command import IdentifyOptions, run_identification

    options = IdentifyOptions(
        bags=tuple(bags),
        output=output,
        parameters=tuple(parameters or ()),
        noise=noise,
        changes=parse_changes(changes or []),
        refine=refine,
        workers=workers,
        scheduler=scheduler,
        as_json=as_json,
    )
    raise typer.Exit(int(run_identification(options)))
