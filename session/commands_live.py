"""Commands on a running graph: a session, the page, the recorder, a device."""

from pathlib import Path
from typing import Annotated

import typer

from session.errors import SessionError
from session.options import EXIT_STATUSES, AsJson, Changes, Domain, SceneOption, Seed

commands = typer.Typer()


@commands.command(epilog=EXIT_STATUSES)
def demo(
    scene: SceneOption = 'liver',
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
    seed: Seed = 0,
    domain: Domain = '',
    as_json: AsJson = False,
    view: Annotated[
        bool, typer.Option('--view', help='Serve a page that shows the session (see view).')
    ] = False,
) -> None:
    """Run a session: an emulated arm palpates and cuts the tissue, all of it recorded."""
    from session.demo import DemoOptions, run_demo
    from session.domain import parse_domain

    options = DemoOptions(scene, seconds, bag, seed, parse_domain(domain), as_json, view)
    raise typer.Exit(int(run_demo(options)))


@commands.command(epilog=EXIT_STATUSES)
def view(
    scene: SceneOption = 'liver',
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
    changes: Changes = None,
    seed: Seed = 0,
    domain: Domain = '',
) -> None:
    """Run a session in the browser: see the tissue, drag the blade, cut. Ctrl-C ends it."""
    from session.domain import parse_domain
    from session.view import ViewOptions, run_view

    if bag is not None:
        from session.recordings.recorded_scene import parse_changes
        from session.recordings.view_bag import ReplayOptions, view_bag

        replayed = ReplayOptions(bag, resimulate, parse_changes(changes or []), host, port)
        raise typer.Exit(int(view_bag(replayed)))
    if resimulate or changes:
        raise SessionError('--resimulate and --with are for a recorded session: give its --bag')
    options = ViewOptions(scene, host, port, attach, seed, parse_domain(domain))
    raise typer.Exit(int(run_view(options)))


@commands.command(epilog=EXIT_STATUSES)
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
    as_json: AsJson = False,
) -> None:
    """Record every topic of a graph that runs elsewhere, until Ctrl-C."""
    from session.record import run_recorder

    raise typer.Exit(int(run_recorder(output, scene, seed, domain, as_json=as_json)))


@commands.command('probe-device', epilog=EXIT_STATUSES)
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
    domain: Domain = '',
    as_json: AsJson = False,
) -> None:
    """Check a connected arm: rate, jitter, stamps, unit, handedness, sign of the force."""
    from session.domain import parse_domain
    from session.probe import Emulation, ProbeOptions, run_probe

    emulation = Emulation() if emulated else None
    options = ProbeOptions(
        arm, profile, emulation, moves, push, parse_domain(domain), as_json=as_json
    )
    raise typer.Exit(int(run_probe(options)))


@commands.command('bench-timing', epilog=EXIT_STATUSES)
def bench_timing(
    scene: SceneOption = 'liver',
    seconds: Annotated[float, typer.Option(min=5.0, max=3600.0, help='Duration [s].')] = 20.0,
    domain: Domain = '',
    as_json: AsJson = False,
) -> None:
    """Measure wake-up and pose-to-force latency of a session, beside cyclictest."""
    from session.domain import parse_domain
    from session.measure.bench_timing import run_bench

    raise typer.Exit(int(run_bench(scene, seconds, parse_domain(domain), as_json=as_json)))
