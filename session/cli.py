"""The command line: `./trainer COMMAND`, or `python -m session.cli COMMAND`."""

import errno
import os
import sys
from pathlib import Path
from typing import Annotated, Literal, NoReturn

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
    view: Annotated[
        bool, typer.Option('--view', help='Serve a page that shows the session (see view).')
    ] = False,
) -> None:
    """Run a session: an emulated arm palpates and cuts the tissue, all of it recorded."""
    from session.demo import DemoOptions, run_demo
    from session.domain import parse_domain

    options = DemoOptions(scene, seconds, bag, seed, parse_domain(domain), as_json, view)
    raise typer.Exit(int(run_demo(options)))


@app.command(epilog=EXIT_STATUSES)
def view(
    scene: Annotated[
        str, typer.Option(help='Name of a scene in config/scenes, or path of a scene file.')
    ] = 'liver',
    host: Annotated[
        str,
        typer.Option(help='Address to serve the page on; 0.0.0.0: open to other machines.'),
    ] = '127.0.0.1',
    port: Annotated[
        int, typer.Option(min=0, max=65535, help='Port of the page; 0: one that is free.')
    ] = 8080,
    attach: Annotated[
        bool, typer.Option('--attach', help='Show the graph that runs already; start no session.')
    ] = False,
    bag: Annotated[
        Path | None,
        typer.Option(help='Folder of a bag: show that, with a time line, instead of a session.'),
    ] = None,
    resimulate: Annotated[
        bool, typer.Option('--resimulate', help='Compute the bag again, and show that beside it.')
    ] = False,
    changes: Annotated[
        list[str] | None,
        typer.Option('--with', help='key=value that is otherwise then (as in resimulate).'),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help='Seed of everything random.')] = 0,
    domain: Annotated[
        str,
        typer.Option(help='ROS domain, or "free" for one of its own (default: ROS_DOMAIN_ID, 0).'),
    ] = '',
) -> None:
    """Run a session in the browser: see the tissue, drag the blade, cut. Ctrl-C ends it."""
    from session.domain import parse_domain
    from session.view import ViewOptions, run_view

    if bag is not None:
        from session.recorded_scene import parse_changes
        from session.view_bag import ReplayOptions, view_bag

        replayed = ReplayOptions(bag, resimulate, parse_changes(changes or []), host, port)
        raise typer.Exit(int(view_bag(replayed)))
    if resimulate or changes:
        raise typer.BadParameter('--resimulate and --with need a --bag')
    options = ViewOptions(scene, host, port, attach, seed, parse_domain(domain))
    raise typer.Exit(int(run_view(options)))


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


@app.command(epilog='Exit status: that of the recorder.')
def record(
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='New folder for the bag (default: as of demo).'),
    ] = None,
    scene: Annotated[
        str, typer.Option(help='Scene that the nodes run: its text goes into the bag.')
    ] = '',
    seed: Annotated[int, typer.Option(help='Of the session; goes into the bag.')] = 0,
    domain: Annotated[str, typer.Option(help='ROS domain (default: ROS_DOMAIN_ID, 0).')] = '',
) -> None:
    """Record every topic of a graph that runs elsewhere, until Ctrl-C."""
    from session.record import run_recorder

    run_recorder(output, scene, seed, domain)


@app.command(epilog=EXIT_STATUSES)
def repair(bag: Annotated[Path, typer.Argument(help='Folder of the bag.')]) -> None:
    """Make a bag that was cut off readable again, and say what is gone."""
    from session.repair import repair as mend

    mend(bag)


@app.command(epilog=EXIT_STATUSES)
def replay(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag.')],
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
    domain: Annotated[
        str, typer.Option(help='ROS domain, or "free" (default: ROS_DOMAIN_ID, 0).')
    ] = '',
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='Record the replay into a new bag (not as recorded).'),
    ] = None,
    drive_device: Annotated[
        bool,
        typer.Option('--drive-device', help='Let the force reach a live device. Without it none.'),
    ] = False,
) -> None:
    """Play a recorded session into the graph. Space pauses, s steps one frame, q ends."""
    from session.domain import parse_domain
    from session.replay import ReplayOptions
    from session.replay import replay as play

    number = parse_domain(domain)
    options = ReplayOptions(bag, as_recorded, rate, start, loop, number, output, drive_device)
    raise typer.Exit(int(play(options)))


@app.command(epilog=EXIT_STATUSES)
def resimulate(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag.')],
    changes: Annotated[
        list[str] | None,
        typer.Option(
            '--with',
            help='key=value of the scene that is to be otherwise; may be given again. Then the '
            'recorded hand meets the changed tissue, and the differences are shown.',
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the answer as JSON on standard output.')
    ] = False,
) -> None:
    """Compute a recorded session again: identical, or where it first differs. Needs no ROS."""
    from session.recorded_scene import parse_changes
    from session.resimulate import resimulate as compute

    raise typer.Exit(int(compute(bag, parse_changes(changes or []), as_json=as_json)))


@app.command(epilog=EXIT_STATUSES)
def report(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag.')],
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='Page to write (default: BAG/report.html).'),
    ] = None,
) -> None:
    """Write a recorded session on one page: force, depth, speed, the cut against the plan."""
    from session.html_report import write_report

    write_report(bag, output or bag / 'report.html')
    Console().print(f'wrote {output or bag / "report.html"}', highlight=False)


@app.command(epilog=EXIT_STATUSES)
def export(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag.')],
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
) -> None:
    """Write a bag's poses and forces as CSV or Parquet, or its tissue as a mesh."""
    from session.export import export as write

    for file in write(bag, output, at, parquet=parquet):
        Console().print(f'wrote {file}', highlight=False)


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
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the plan as JSON on standard output.')
    ] = False,
) -> None:
    """Find the least method that meets a scene's budget, and say why not a lesser one."""
    from session.plan_report import run_plan

    raise typer.Exit(int(run_plan(scene, as_json=as_json)))


@app.command(epilog=EXIT_STATUSES)
def stability(
    scene: Annotated[
        str, typer.Argument(help='Name of a scene in config/scenes, or path of a scene file.')
    ],
) -> None:
    """Print each integrator's largest stable step on a scene's mesh: by theory, and measured."""
    from session.stability_report import run_stability

    run_stability(scene)


@app.command('haptics-accuracy', epilog=EXIT_STATUSES)
def haptics_accuracy(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder with haptics.md, for tables and picture.'),
    ] = Path('docs'),
) -> None:
    """Measure the force between frames against a tissue that runs at 1 kHz."""
    from session.haptics_accuracy import run_accuracy

    _leave_with(run_accuracy(output))


@app.command('haptics-stability', epilog=EXIT_STATUSES)
def haptics_stability(
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Folder with haptics.md, for table and picture.')
    ] = Path('docs'),
) -> None:
    """Map where the tool can be held still, by hand, tissue, delay and loss."""
    from session.haptics_stability import run_stability

    _leave_with(run_stability(output))


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


@app.command('probe-device', epilog=EXIT_STATUSES)
def probe_device(
    arm: Annotated[
        str, typer.Option(help='Namespace of the device, as in /MTML for /MTML/measured_cp.')
    ] = 'arm',
    profile: Annotated[
        str, typer.Option(help='Name of a file in config/devices, without .yaml.')
    ] = 'emulated',
    emulated: Annotated[
        bool, typer.Option('--emulated', help='Start the emulated arm and probe that.')
    ] = False,
    moves: Annotated[
        bool, typer.Option(help='Ask for three moves, which tell unit and handedness.')
    ] = True,
    push: Annotated[
        bool,
        typer.Option(
            '--push', help='Push the hand with 0.3 N: without it no force is sent at all.'
        ),
    ] = False,
    domain: Annotated[
        str,
        typer.Option(help='ROS domain, or "free" for one of its own (default: ROS_DOMAIN_ID, 0).'),
    ] = '',
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the checks as JSON on standard output.')
    ] = False,
) -> None:
    """Check a connected arm: rate, jitter, stamps, unit, handedness, sign of the force."""
    from session.domain import parse_domain
    from session.probe import Emulation, ProbeOptions, run_probe

    emulation = Emulation() if emulated else None
    options = ProbeOptions(
        arm, profile, emulation, moves, push, parse_domain(domain), as_json=as_json
    )
    raise typer.Exit(int(run_probe(options)))


@app.command('bench-timing', epilog=EXIT_STATUSES)
def bench_timing(
    scene: Annotated[
        str, typer.Option(help='Name of a scene in config/scenes, or path of a scene file.')
    ] = 'liver',
    seconds: Annotated[float, typer.Option(min=5.0, max=3600.0, help='Duration [s].')] = 20.0,
    domain: Annotated[
        str,
        typer.Option(help='ROS domain, or "free" for one of its own (default: ROS_DOMAIN_ID, 0).'),
    ] = '',
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the figures as JSON on standard output.')
    ] = False,
) -> None:
    """Measure wake-up and pose-to-force latency of a session, beside cyclictest."""
    from session.bench_timing import run_bench
    from session.domain import parse_domain

    raise typer.Exit(int(run_bench(scene, seconds, parse_domain(domain), as_json=as_json)))


@app.command('import-mesh', epilog=EXIT_STATUSES)
def import_mesh(
    surface: Annotated[
        Path, typer.Argument(help='Closed surface: .stl, .ply, .obj or what else trimesh reads.')
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
            min=1e-4, max=1.0, help='Length of edge to aim at [m] (default: 4000 tetrahedra).'
        ),
    ] = None,
    rests_on: Annotated[
        str,
        typer.Option(help='Side that is turned down and held: -x, +x, -y, +y, -z or +z.'),
    ] = '-z',
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the report as JSON on standard output.')
    ] = False,
) -> None:
    """Fill the surface of an organ with tetrahedra; write a mesh, a quality report, a scene."""
    from session.import_mesh import ImportOptions
    from session.import_mesh import import_mesh as make

    raise typer.Exit(int(make(ImportOptions(surface, output, unit, edge, rests_on, as_json))))


@app.command(epilog=EXIT_STATUSES)
def doctor(
    as_json: Annotated[
        bool, typer.Option('--json', help='Print the findings as JSON on standard output.')
    ] = False,
) -> None:
    """Examine this machine: Python, compiler, DDS, real time, ports, time sync; what to do."""
    from session.doctor import run_doctor, running_python
    from session.graph import node_environment

    environment = node_environment(int(os.environ.get('ROS_DOMAIN_ID') or 0))
    raise typer.Exit(
        int(run_doctor([running_python], sys.executable, environment, as_json=as_json))
    )


@app.command(epilog=EXIT_STATUSES)
def completion(
    shell: Annotated[Literal['bash', 'zsh'], typer.Argument(help='Which shell.')],
) -> None:
    """Print what makes the shell complete commands: eval "$(./trainer completion bash)"."""
    from session.completion import script

    print(script(app, shell))


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


def _leave_with(failures: list[str]) -> None:
    """Prints what has failed and leaves with the status for it."""
    console = Console(stderr=True, soft_wrap=True)
    for failure in failures:
        console.print(f'[bold red]no:[/] {escape(failure)}', highlight=False)
    raise typer.Exit(int(Status.FAILED if failures else Status.OK))


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits.

    What the user can mend becomes one line and exit status 2; everything else is a bug, and raised.
    """
    try:
        app(arguments, prog_name='trainer')
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
