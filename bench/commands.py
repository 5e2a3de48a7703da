"""Commands that measure and torture the trainer: `./trainer bench COMMAND`, in a checkout only."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape

from bench.speed.parts import Part
from cutting_trainer.cli.options import (
    EXIT_STATUSES,
    AsJson,
    Domain,
    SceneArgument,
    SceneOption,
    Seed,
)
from cutting_trainer.session.domain import parse_domain
from cutting_trainer.session.exit_status import Status

Output = Annotated[
    Path, typer.Option('--output', '-o', help='Folder for page, tables and pictures.')
]
Sizes = Annotated[
    list[int] | None,
    typer.Option(min=6, max=1_000_000, help='Tetrahedra, about; may be given again.'),
]
NewBag = Annotated[
    Path | None,
    typer.Option(help='New folder for the bag (default: bags/sessions/COMMAND-SCENE-TIME).'),
]
app = typer.Typer(
    name='bench',
    help='Measure what the trainer costs and what it is worth; try to break it.',
    epilog=EXIT_STATUSES,
    add_completion=False,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode='markdown',
)


@app.callback()
def _bench(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command(epilog=EXIT_STATUSES)
def speed(
    names: Annotated[
        list[Part] | None,
        typer.Argument(help='Which benchmarks; all unless some are named.'),
    ] = None,
    size: Sizes = None,
    as_json: AsJson = False,
    save: Annotated[
        bool, typer.Option('--save', help='Keep the figures in bench/results.')
    ] = False,
    against: Annotated[
        Path | None, typer.Option(help='File of an earlier run: its figures stand beside.')
    ] = None,
) -> None:
    """Measure what force, step, frame, cut, proxy, messages, session and start cost here."""
    from bench.speed.command import run_bench

    run_bench(names or [], size or [], as_json=as_json, save=save, against=against)


@app.command(epilog=EXIT_STATUSES)
def scaling(
    output: Output = Path('docs'),
    size: Sizes = None,
    as_json: AsJson = False,
) -> None:
    """Measure how costs grow with the mesh, from 1,000 to 500,000 tetrahedra: a picture."""
    from bench.speed.scaling import run_scaling

    run_scaling(output, size or [], as_json=as_json)


@app.command(epilog=EXIT_STATUSES)
def strokes(
    strokes: Annotated[int, typer.Option(min=1, help='How many.')] = 1000,
    every: Annotated[int, typer.Option(min=1, help='Look after every so many.')] = 50,
    size: Annotated[
        int, typer.Option(min=600, max=1_000_000, help='Tetrahedra at the beginning, about.')
    ] = 10_000,
    seed: Seed = 0,
    growth: Annotated[
        float, typer.Option(min=1, max=1000, help='tissue.integration.frequency_growth.')
    ] = 1.1,
    output: Output = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure time and memory of a session of very many strokes, its mesh checked on the way."""
    from bench.speed.strokes import run_strokes

    options = (output, strokes, every, size, seed, growth)
    raise typer.Exit(int(run_strokes(*options, as_json=as_json)))


@app.command(epilog=EXIT_STATUSES)
def timing(
    scene: SceneOption = 'liver',
    seconds: Annotated[float, typer.Option(min=5.0, max=3600.0, help='Duration [s].')] = 20.0,
    domain: Domain = '',
    as_json: AsJson = False,
) -> None:
    """Measure wake-up and pose-to-force latency of a session, beside cyclictest."""
    from bench.speed.timing import run_bench

    raise typer.Exit(int(run_bench(scene, seconds, parse_domain(domain), as_json=as_json)))


@app.command(epilog=EXIT_STATUSES)
def chart(
    output: Output = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure every method on this machine: error against CPU time, pictures and CSV."""
    from bench.accuracy.chart import run_chart

    run_chart(output, as_json=as_json)


@app.command(epilog=EXIT_STATUSES)
def validate(
    cases: Annotated[
        list[str] | None, typer.Argument(help='Which cases, by name; all unless some are named.')
    ] = None,
    quick: Annotated[
        bool, typer.Option('--quick', help='Only the coarsest mesh of each case.')
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='Folder for the page; charts/ in it for the picture.'),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute published experiments by every elastic model; print errors and verdicts."""
    from bench.validate.command import run_validate

    run_validate(cases or [], quick=quick, folder=output, as_json=as_json)


@app.command(epilog=EXIT_STATUSES)
def stability(
    scene: SceneArgument,
    as_json: AsJson = False,
) -> None:
    """Print each integrator's largest stable step on a scene's mesh: by theory, and measured."""
    from bench.accuracy.integrator_limits import run_stability

    run_stability(scene, as_json=as_json)


@app.command(epilog=EXIT_STATUSES)
def cuts(
    output: Output = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Cut the same strokes by every method and compare what they leave."""
    from bench.cuts.cases_picture import write_cases
    from bench.cuts.compare import run_comparison

    run_comparison(output, as_json=as_json)
    write_cases(output)


@app.command('haptics-accuracy', epilog=EXIT_STATUSES)
def haptics_accuracy(
    output: Output = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure the force between frames against a tissue that runs at 1 kHz."""
    from bench.haptics.pages import run_accuracy

    _leave_with(run_accuracy(output, as_json=as_json))


@app.command('haptics-stability', epilog=EXIT_STATUSES)
def haptics_stability(
    output: Output = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Map where the tool can be held still, by hand, tissue, delay and loss."""
    from bench.haptics.pages import run_stability

    _leave_with(run_stability(output, as_json=as_json))


@app.command('fuzz-cuts', epilog=EXIT_STATUSES)
def fuzz_cuts(
    strokes: Annotated[int, typer.Option(min=1, help='How many random strokes.')] = 10000,
    seed: Annotated[int, typer.Option(help='Seed of everything random.')] = 0,
    method: Annotated[str, typer.Option(help='Method of cutting.')] = 'combined',
    output: Annotated[
        Path, typer.Option(help='Folder for scenes that break an invariant.')
    ] = Path(),
    replay: Annotated[Path | None, typer.Option(help='Cut a saved scene again instead.')] = None,
    yanks: Annotated[
        int,
        typer.Option(
            min=0,
            help='Load, cut and yank so many moving sliver meshes instead, 500 frames each; those '
            'in yanks.jsonl of the folder are done.',
        ),
    ] = 0,
) -> None:
    """Cut random meshes by random strokes and check every invariant after every batch."""
    from bench.cuts.fuzz_cuts import replay_scene, run_strokes
    from bench.cuts.random_loads import run_yanks

    if yanks:
        raise typer.Exit(int(run_yanks(yanks, seed, output / 'yanks.jsonl')))
    options = (strokes, seed, method, output)
    raise typer.Exit(int(replay_scene(replay, method) if replay else run_strokes(*options)))


@app.command(epilog=EXIT_STATUSES)
def chaos(
    scene: SceneOption = 'block',
    minutes: Annotated[float, typer.Option(min=1.0, max=1440.0, help='Duration [min].')] = 10.0,
    faults: Annotated[int, typer.Option(min=1, help='How many nodes are struck.')] = 50,
    bag: NewBag = None,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Kill and freeze nodes of a session at random: is the hand safe, does all come back?"""
    from bench.trials.chaos import ChaosOptions, run_chaos

    options = ChaosOptions(scene, seed, parse_domain(domain), as_json, minutes, faults, bag)
    raise typer.Exit(int(run_chaos(options)))


@app.command(epilog=EXIT_STATUSES)
def fuzz(
    scene: SceneOption = 'block',
    messages: Annotated[
        int, typer.Option(min=1, help='How many malformed messages are sent.')
    ] = 1_000_000,
    flood: Annotated[
        float,
        typer.Option(min=0.0, max=60.0, help='10 kHz afterwards on each topic of 1 kHz [s].'),
    ] = 2.0,
    largest: Annotated[
        float,
        typer.Option(min=5.0, max=1000.0, help='Size of one huge message to each topic [MB].'),
    ] = 100.0,
    bag: NewBag = None,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Send a session what nobody should send: does any node die, or pass it on?"""
    from bench.trials.fuzz import FuzzOptions, run_fuzz

    options = FuzzOptions(scene, seed, parse_domain(domain), as_json, messages, flood, largest, bag)
    raise typer.Exit(int(run_fuzz(options)))


@app.command(epilog=EXIT_STATUSES)
def soak(
    scene: SceneOption = 'block',
    minutes: Annotated[float, typer.Option(min=1.0, max=10080.0, help='Duration [min].')] = 60.0,
    every: Annotated[float, typer.Option(min=20.0, help='Length of a session [s].')] = 60.0,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Run session after session on the same processes: do memory, threads or handles grow?"""
    from bench.trials.soak import SoakOptions, run_soak

    options = SoakOptions(scene, seed, parse_domain(domain), as_json, minutes, every)
    raise typer.Exit(int(run_soak(options)))


@app.command('same-cut', epilog=EXIT_STATUSES)
def same_cut(
    bag: Annotated[Path, typer.Argument(help='Folder of the bag with the hand.')],
    runs: Annotated[int, typer.Option(min=2, max=1000, help='How many sessions.')] = 20,
    as_json: AsJson = False,
) -> None:
    """Run a recorded hand live under changing load: the same cut, pieces and bits?"""
    from bench.trials.same_cut import run_same_cut

    raise typer.Exit(int(run_same_cut(bag, runs, as_json=as_json)))


@app.command(epilog=EXIT_STATUSES)
def faults(
    count: Annotated[int, typer.Option(min=1, help='How many faults.')] = 60,
    until: Annotated[
        Literal['quick', 'nearest', 'near', 'usual', 'all'],
        typer.Option(
            help='Last round: quick tests of 8 files; 4 or 16 files; all of `trainer test`; of '
            '`--all`.'
        ),
    ] = 'usual',
    folder: Annotated[
        Path, typer.Option(help='Keeps state and copy of the commit: an interrupted run goes on.')
    ] = Path('.trainer/faults'),
    seed: Seed = 0,
) -> None:
    """Plant small faults in kernels and nodes, one at a time: does a test find each?"""
    from bench.faults.run import run_faults

    checkout = Path(__file__).parents[1]
    raise typer.Exit(int(run_faults(checkout, folder.resolve(), count, seed, until)))


def _leave_with(failures: list[str]) -> None:
    """Print what has failed and leave with the status for it."""
    console = Console(stderr=True, soft_wrap=True)
    for failure in failures:
        console.print(f'[bold red]no:[/] {escape(failure)}', highlight=False)
    raise typer.Exit(int(Status.FAILED if failures else Status.OK))
