"""Commands that plan, and that measure what the methods are worth."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from session.options import EXIT_STATUSES, AsJson, Bench, SceneArgument, Seed
from session.status import Status

commands = typer.Typer()


@commands.command(epilog=EXIT_STATUSES)
def plan(
    scene: SceneArgument,
    as_json: AsJson = False,
) -> None:
    """Find the least method that meets a scene's budget, and say why not a lesser one."""
    from session.measure.plan_report import run_plan

    raise typer.Exit(int(run_plan(scene, as_json=as_json)))


@commands.command(epilog=EXIT_STATUSES)
def stability(
    scene: SceneArgument,
    as_json: AsJson = False,
) -> None:
    """Print each integrator's largest stable step on a scene's mesh: by theory, and measured."""
    from session.measure.stability_report import run_stability

    run_stability(scene, as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def chart(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder for the page; charts/ in it for the rest.'),
    ] = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure every method on this machine: error against CPU time, pictures and CSV."""
    from session.measure.chart import run_chart

    run_chart(output, as_json=as_json)


@commands.command(epilog=EXIT_STATUSES)
def bench(
    names: Annotated[
        list[Bench] | None,
        typer.Argument(help='Which benchmarks; all unless some are named.'),
    ] = None,
    size: Annotated[
        list[int] | None,
        typer.Option(min=6, max=1_000_000, help='Tetrahedra, about; may be given again.'),
    ] = None,
    as_json: AsJson = False,
    save: Annotated[
        bool, typer.Option('--save', help='Keep the figures in bench/results.')
    ] = False,
    against: Annotated[
        Path | None, typer.Option(help='File of an earlier run: its figures stand beside.')
    ] = None,
) -> None:
    """Measure what force, step, frame, cut, proxy, messages, session and start cost here."""
    from session.measure.bench import run_bench

    run_bench(names or [], size or [], as_json=as_json, save=save, against=against)


@commands.command('bench-scaling', epilog=EXIT_STATUSES)
def bench_scaling(
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Folder; charts/ in it takes the picture.')
    ] = Path('docs'),
    size: Annotated[
        list[int] | None,
        typer.Option(min=6, max=1_000_000, help='Tetrahedra, about; given twice at least.'),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure how costs grow with the mesh, from 1,000 to 500,000 tetrahedra: a picture."""
    from session.measure.bench_scaling import run_scaling

    run_scaling(output, size or [], as_json=as_json)


@commands.command('bench-strokes', epilog=EXIT_STATUSES)
def bench_strokes(
    strokes: Annotated[int, typer.Option(min=1, help='How many.')] = 1000,
    every: Annotated[int, typer.Option(min=1, help='Look after every so many.')] = 50,
    size: Annotated[
        int, typer.Option(min=600, max=1_000_000, help='Tetrahedra at the beginning, about.')
    ] = 10_000,
    seed: Seed = 0,
    growth: Annotated[
        float, typer.Option(min=1, max=1000, help='tissue.integration.frequency_growth.')
    ] = 1.1,
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Folder; charts/ in it takes the picture.')
    ] = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure time and memory of a session of very many strokes, its mesh checked on the way."""
    from session.measure.bench_strokes import run_strokes

    options = (output, strokes, every, size, seed, growth)
    raise typer.Exit(int(run_strokes(*options, as_json=as_json)))


@commands.command('compare-cuts', epilog=EXIT_STATUSES)
def compare_cuts(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder for the page, the table and the pictures.'),
    ] = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Cut the same strokes by every method and compare what they leave."""
    from session.measure.compare_cuts import run_comparison
    from session.measure.cut_cases_picture import write_cases

    run_comparison(output, as_json=as_json)
    write_cases(output)


@commands.command('haptics-accuracy', epilog=EXIT_STATUSES)
def haptics_accuracy(
    output: Annotated[
        Path,
        typer.Option('--output', '-o', help='Folder with haptics.md, for tables and picture.'),
    ] = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Measure the force between frames against a tissue that runs at 1 kHz."""
    from session.measure.haptics_pages import run_accuracy

    _leave_with(run_accuracy(output, as_json=as_json))


@commands.command('haptics-stability', epilog=EXIT_STATUSES)
def haptics_stability(
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Folder with haptics.md, for table and picture.')
    ] = Path('docs'),
    as_json: AsJson = False,
) -> None:
    """Map where the tool can be held still, by hand, tissue, delay and loss."""
    from session.measure.haptics_pages import run_stability

    _leave_with(run_stability(output, as_json=as_json))


@commands.command('fuzz-cuts', epilog=EXIT_STATUSES)
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
    from session.measure.fuzz_cuts import replay_scene, run_strokes

    options = (strokes, seed, method, output)
    raise typer.Exit(int(replay_scene(replay, method) if replay else run_strokes(*options)))


def _leave_with(failures: list[str]) -> None:
    """Prints what has failed and leaves with the status for it."""
    console = Console(stderr=True, soft_wrap=True)
    for failure in failures:
        console.print(f'[bold red]no:[/] {escape(failure)}', highlight=False)
    raise typer.Exit(int(Status.FAILED if failures else Status.OK))
