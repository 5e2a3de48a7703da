"""The command line: `./trainer COMMAND`, or `python -m session.cli COMMAND`."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from session.status import Status

EXIT_STATUSES = 'Exit status: ' + '; '.join(f'{int(s)} {s.meaning}' for s in Status) + '.'

app = typer.Typer(
    name='trainer',
    help='Teleoperated soft-tissue cutting trainer on ROS 2.',
    epilog=EXIT_STATUSES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode='rich',
)


@app.callback()
def _trainer() -> None:
    """Teleoperated soft-tissue cutting trainer on ROS 2."""


@app.command(epilog=EXIT_STATUSES)
def demo(
    scene: Annotated[
        str, typer.Option(help='Name of a scene in config/scenes, or path of a scene file.')
    ] = 'liver',
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Duration [s]; the arm's script is stretched to it (default: of the scene).",
        ),
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option(help='New folder for the bag (default: bags/sessions/SCENE-TIME).'),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help='Seed of everything random.')] = 0,
    domain: Annotated[
        str,
        typer.Option(help='ROS domain, or "free" for one of its own (default: ROS_DOMAIN_ID, 0).'),
    ] = '',
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the summary as JSON on standard output.')
    ] = False,
) -> None:
    """Run a session: an emulated arm palpates and cuts the tissue, all of it recorded."""
    from session.demo import DemoOptions, run_demo
    from session.domain import parse_domain

    options = DemoOptions(scene, seconds, bag, seed, parse_domain(domain), as_json)
    raise typer.Exit(int(run_demo(options)))


@app.command(epilog=EXIT_STATUSES)
def picture(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag.')],
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
) -> None:
    """Draw a recorded session: the tissue at one moment, the way of the tool, the force."""
    from session.picture import make_picture

    make_picture(bag, output or bag / 'picture.png', at)
    Console().print(f'wrote {output or bag / "picture.png"}', highlight=False)


@app.command('compare-cuts', epilog=EXIT_STATUSES)
def compare_cuts(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder for the page, the table and the pictures.'),
    ] = Path('docs'),
) -> None:
    """Cut the same strokes by every method and compare what they leave."""
    from session.compare_cuts import run_comparison
    from session.cut_cases_picture import write_cases

    run_comparison(output)
    write_cases(output)


@app.command(epilog=EXIT_STATUSES)
def chart(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder for the page; charts/ in it for the rest.'),
    ] = Path('docs'),
) -> None:
    """Measure every method on this machine: error against CPU time, pictures and CSV."""
    from session.chart import run_chart

    run_chart(output)


@app.command(epilog=EXIT_STATUSES)
def plan(
    scene: Annotated[
        str, typer.Argument(help='Name of a scene in config/scenes, or path of a scene file.')
    ],
) -> None:
    """Find the least method that meets a scene's budget, and say why not a lesser one."""
    from session.plan_report import run_plan

    raise typer.Exit(int(run_plan(scene)))


@app.command(epilog=EXIT_STATUSES)
def stability(
    scene: Annotated[
        str, typer.Argument(help='Name of a scene in config/scenes, or path of a scene file.')
    ],
) -> None:
    """Print each integrator's largest stable step on a scene's mesh: by theory, and measured."""
    from session.stability_report import run_stability

    run_stability(scene)


@app.command('fuzz-cuts', epilog=EXIT_STATUSES)
def fuzz_cuts(
    strokes: Annotated[int, typer.Option(min=1, help='How many random strokes.')] = 10000,
    seed: Annotated[int, typer.Option(help='Seed of everything random.')] = 0,
    method: Annotated[str, typer.Option(help='Method of cutting.')] = 'combined',
    output: Annotated[
        Path, typer.Option(help='Folder for scenes that break an invariant.')
    ] = Path(),
    replay: Annotated[Path | None, typer.Option(help='Cut a saved scene again instead.')] = None,
) -> None:
    """Cut random meshes by random strokes and check every invariant after every batch."""
    from session.fuzz_cuts import replay_scene, run_strokes

    options = (strokes, seed, method, output)
    raise typer.Exit(int(replay_scene(replay, method) if replay else run_strokes(*options)))


@app.command(
    epilog='Exit status: that of the program.',
    context_settings={'allow_extra_args': True, 'ignore_unknown_options': True},
)
def run(context: typer.Context) -> None:
    """Run a program of your own with the messages and rclpy, as in: run python my_node.py."""
    if not context.args:
        raise typer.BadParameter('name a program, for example: ./trainer run python my_node.py')
    program, *arguments = context.args
    if program in ('python', 'python3'):
        program = sys.executable
    from session.graph import node_environment

    environment = node_environment(int(os.environ.get('ROS_DOMAIN_ID') or 0))
    try:
        os.execvpe(program, [program, *arguments], environment)
    except OSError as error:
        raise typer.BadParameter(f'{program} cannot be run: {error.strerror}') from None


@app.command(
    epilog='Exit status: that of the first check that failed.',
    context_settings={'allow_extra_args': True, 'ignore_unknown_options': True},
)
def test(context: typer.Context) -> None:
    """Run all checks of a checkout: lint, format, types, tests; arguments go to pytest."""
    from session.checks import all_checks, require_checkout, run_checks, verdict

    root = Path(__file__).resolve().parents[1]
    require_checkout(root)
    console = Console(stderr=True)
    results = run_checks(
        all_checks(context.args), root, lambda name: console.rule(name, align='left')
    )
    status, sentence = verdict(results)
    console.print(sentence, style='bold red' if status else 'bold green', highlight=False)
    raise typer.Exit(status)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits.

    What the user can mend becomes one line and exit status 2; everything else is a bug, and raised.
    """
    try:
        app(arguments, prog_name='trainer')
    except ValueError as error:
        if not _is_users(error):
            raise
        console = Console(stderr=True, soft_wrap=True)
        console.print(f'[bold red]error:[/] {escape(str(error))}', highlight=False)
        raise SystemExit(int(Status.BAD_INPUT)) from None


def _is_users(error: ValueError) -> bool:
    from bags.errors import BagError
    from haptic_bridge.settings import SettingsError
    from session.errors import SessionError
    from tissue_sim.errors import MeshError, SceneError

    return isinstance(error, SessionError | SceneError | MeshError | SettingsError | BagError)


if __name__ == '__main__':
    main()
