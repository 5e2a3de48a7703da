"""Commands for scenes, programs and checkouts of the user's own."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, SceneArgument
from cutting_trainer.session.errors import SessionError

commands = typer.Typer()


@commands.command(epilog=EXIT_STATUSES)
def plan(
    scene: SceneArgument,
    as_json: AsJson = False,
) -> None:
    """Find the cheapest method that meets a scene's budget, and say why cheaper ones fail."""
    from cutting_trainer.cli.plan_report import run_plan

    raise typer.Exit(int(run_plan(scene, as_json=as_json)))


@commands.command('import-mesh', epilog=EXIT_STATUSES)
def import_mesh(
    surface: Annotated[
        Path,
        typer.Argument(
            help='Closed surface: .stl, .ply, .obj or what else trimesh reads; or tetrahedra.'
        ),
    ],
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='NAME: writes NAME.msh and the scene NAME.yaml.'),
    ],
    unit: Annotated[
        Literal['m', 'cm', 'mm'], typer.Option(help='Unit of length in the file.')
    ] = 'mm',
    edge: Annotated[
        float | None,
        typer.Option(
            min=1e-4, max=1.0, help='Length of edge to aim at [m] (default: some 4000 tetrahedra).'
        ),
    ] = None,
    rests_on: Annotated[
        str,
        typer.Option(help='Side that is turned down and held: -x, +x, -y, +y, -z or +z.'),
    ] = '-z',
    as_json: AsJson = False,
) -> None:
    """Make mesh, quality report and scene from an organ's surface, or from its tetrahedra."""
    from cutting_trainer.mesh_import.import_mesh import ImportOptions
    from cutting_trainer.mesh_import.import_mesh import import_mesh as make

    raise typer.Exit(int(make(ImportOptions(surface, output, unit, edge, rests_on, as_json))))


@commands.command(epilog=EXIT_STATUSES)
def doctor(
    as_json: AsJson = False,
) -> None:
    """Examine this machine: Python, compiler, DDS, real time, ports, time sync; what to do."""
    from cutting_trainer.cli.doctor import run_doctor, running_python
    from cutting_trainer.session.node_commands import node_environment

    environment = node_environment(int(os.environ.get('ROS_DOMAIN_ID') or 0))
    raise typer.Exit(
        int(run_doctor([running_python], sys.executable, environment, as_json=as_json))
    )


@commands.command(epilog=EXIT_STATUSES)
def completion(
    context: typer.Context,
    shell: Annotated[Literal['bash', 'zsh'], typer.Argument(help='Shell to complete in.')],
) -> None:
    """Print completion for the shell: eval "$(./trainer completion bash)"."""
    from cutting_trainer.cli.completion import script

    print(script(context.find_root().command, shell))


@commands.command(
    epilog='Exit status: that of the program.',
    context_settings={'allow_extra_args': True, 'ignore_unknown_options': True},
)
def run(context: typer.Context) -> None:
    """Run a program of your own with the messages and rclpy, as in: run python my_node.py."""
    if not context.args:
        raise SessionError('name a program, for example: ./trainer run python my_node.py')
    program, *arguments = context.args
    if program in ('python', 'python3'):
        program = sys.executable
    from cutting_trainer.session.node_commands import node_environment

    environment = node_environment(int(os.environ.get('ROS_DOMAIN_ID') or 0))
    try:
        os.execvpe(program, [program, *arguments], environment)
    except OSError as error:
        why = (error.strerror or '').lower()
        raise SessionError(
            f'{program} cannot be run ({why}): name a program that is there'
        ) from None


@commands.command(
    'test',
    epilog='Exit status: that of the first check that failed.',
    context_settings={'allow_extra_args': True, 'ignore_unknown_options': True},
)
def check(
    context: typer.Context,
    quick: Annotated[
        bool, typer.Option('--quick', help='Only lint and tests of seconds without a ROS graph.')
    ] = False,
    everything: Annotated[
        bool, typer.Option('--all', help='Also tests that take long: soak, random faults, builds.')
    ] = False,
) -> None:
    """Run the checks of a checkout: lint, format, types, tests; arguments go to pytest."""
    from cutting_trainer.cli.test_command import all_checks, require_checkout, run_checks, verdict

    if quick and everything:
        raise SessionError('--quick and --all exclude each other: give one of them')
    root = Path(__file__).resolve().parents[1]
    require_checkout(root)
    console = Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix='trainer-test-', ignore_cleanup_errors=True) as folder:
        checks = all_checks(
            context.args, Path(folder), 'quick' if quick else 'all' if everything else 'usual'
        )
        results = run_checks(checks, root, lambda name: console.rule(name, align='left'))
    status, sentence = verdict(results)
    console.print(sentence, style='bold red' if status else 'bold green', highlight=False)
    raise typer.Exit(status)
