"""Commands on a running graph: a session, the page, the recorder, a device."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from cutting_trainer.cli.bag_errors import reading
from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, Changes, Domain, SceneOption, Seed
from cutting_trainer.session.errors import SessionError

commands = typer.Typer()


def _given(context: typer.Context, *parameters: str) -> list[str]:
    """Return the options among some parameters of a command that its user has given."""
    known = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    sources = {name: context.get_parameter_source(name) for name in parameters}
    return [known[name] for name, of in sources.items() if of and of.name == 'COMMANDLINE']


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
    subject: Annotated[
        str, typer.Option(help='Pseudonym of who makes the attempt (default: a new one).')
    ] = '',
    notes: Annotated[str, typer.Option(help='Remarks on the session; go into the bag.')] = '',
) -> None:
    """Run a session: an emulated arm palpates and cuts the tissue, all of it recorded."""
    from cutting_trainer.session.demo_command import DemoOptions, run_demo
    from cutting_trainer.session.domain import parse_domain

    options = DemoOptions(
        scene, seconds, bag, seed, parse_domain(domain), as_json, view, subject, notes
    )
    raise typer.Exit(int(run_demo(options)))


@commands.command(epilog=EXIT_STATUSES)
def view(
    context: typer.Context,
    scene: SceneOption = 'liver',
    host: Annotated[
        str,
        typer.Option(help='Address to serve the page on; 0.0.0.0: open to other machines.'),
    ] = '127.0.0.1',
    port: Annotated[
        int, typer.Option(min=0, max=65535, help='Port of the page; 0: one that is free.')
    ] = 8080,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(
            '--allow-host',
            help='Name or address by which pages ask for this machine; may be given again. Needed '
            'where --host lets other machines in.',
        ),
    ] = None,
    attach: Annotated[
        bool, typer.Option('--attach', help='Show the graph that runs already; start no session.')
    ] = False,
    arm: Annotated[
        str,
        typer.Option(
            help='Namespace of a device whose driver runs, as in /MTML: it is checked, and takes '
            'the place of the emulated arm.'
        ),
    ] = '',
    records: Annotated[
        bool, typer.Option('--record', help='Record from the start, into bags/sessions.')
    ] = False,
    bag: Annotated[
        Path | None,
        typer.Option(help='Folder of a bag: show that, with a time line, instead of a session.'),
    ] = None,
    resimulate: Annotated[
        bool, typer.Option('--resimulate', help='Compute the bag again, and show that beside it.')
    ] = False,
    changes: Changes = None,
    beside: Annotated[
        Path | None,
        typer.Option(help='Folder of another bag, to show beside --bag at the same time.'),
    ] = None,
    seed: Seed = 0,
    domain: Domain = '',
) -> None:
    """Run a session in the browser: see the tissue, drag the blade, cut. Ctrl-C ends it."""
    from cutting_trainer.session.domain import parse_domain
    from cutting_trainer.session.view_command import ViewOptions, run_view

    if bag is not None:
        from cutting_trainer.recordings.view_bag_command import ReplayOptions, view_bag
        from cutting_trainer.session.scene_overrides import parse_changes

        if beside is not None and (resimulate or changes):
            raise SessionError('--beside shows another bag: leave out --resimulate and --with')
        if given := _given(context, 'scene', 'attach', 'arm', 'records', 'seed', 'domain'):
            raise SessionError(f'--bag shows a recorded session: leave {" and ".join(given)} out')
        replayed = ReplayOptions(
            bag, resimulate, parse_changes(changes or []), host, port, allow_host or (), beside
        )
        with reading(bag):
            status = view_bag(replayed)
        raise typer.Exit(int(status))
    if resimulate or changes or beside is not None:
        raise SessionError(
            '--resimulate, --with and --beside are for a recorded session: give its --bag'
        )
    if records and attach:
        raise SessionError('--record is for a session of its own: ./trainer record records others')
    options = ViewOptions(
        *(scene, host, port, attach, seed, parse_domain(domain), tuple(allow_host or ())),
        arm=namespace(arm),
        record=records,
    )
    raise typer.Exit(int(run_view(options)))


def namespace(arm: str) -> str:
    """Return the namespace of a device with one slash before it; '': none was given.

    Raises:
        SessionError: it is not a name of ROS.
    """
    words = arm.strip('/')
    if words and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', words, re.ASCII):
        raise SessionError(f'--arm {arm}: give a namespace of ROS, as in /MTML')
    return f'/{words}' if words else ''


@commands.command(epilog=EXIT_STATUSES)
def record(
    output: Annotated[
        Path | None,
        typer.Option('--output', '-o', help='New folder for the bag (default: in bags/sessions).'),
    ] = None,
    scene: Annotated[
        str, typer.Option(help='Scene that the nodes run: its text goes into the bag.')
    ] = '',
    seed: Annotated[int, typer.Option(help='Of the session; goes into the bag.')] = 0,
    domain: Annotated[str, typer.Option(help='ROS domain (default: ROS_DOMAIN_ID, 0).')] = '',
    as_json: AsJson = False,
) -> None:
    """Record every topic of a graph that runs elsewhere, until Ctrl-C."""
    from cutting_trainer.session.record_command import run_recorder

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
        bool, typer.Option(help='Ask for moves and a turn: unit, handedness, scale, orientation.')
    ] = True,
    place: Annotated[
        str,
        typer.Option(
            help='Scene file: ask for touches of known points, and write to its section device '
            'where the device is. Its profile counts.'
        ),
    ] = '',
    point: Annotated[
        list[str] | None,
        typer.Option(
            help='With --place: x,y,z of a point in the tissue [m]; give three or more (default: '
            "the corners of the tissue's underside).",
        ),
    ] = None,
    push: Annotated[
        bool,
        typer.Option(
            '--push', help='Push the hand with 0.3 N: without it no force is sent at all.'
        ),
    ] = False,
    force_topic: Annotated[
        Literal['servo_cf', 'body/servo_cf', 'spatial/servo_cf'],
        typer.Option(help='Where below the namespace it takes the force.'),
    ] = 'servo_cf',
    faults: Annotated[
        str, typer.Option(help='With --emulated: faults of its driver, as in "gain=5".')
    ] = '',
    domain: Domain = '',
    as_json: AsJson = False,
) -> None:
    """Check a connected arm: stream, unit, handedness, scale, orientation, force, letting go."""
    from cutting_trainer.session.domain import parse_domain
    from cutting_trainer.session.probe_command import Emulation, ProbeOptions, run_probe

    emulation = Emulation(faults=faults) if emulated else None
    points = tuple(point or ())
    options = ProbeOptions(
        *(arm, profile, emulation, moves, push, parse_domain(domain), as_json, force_topic),
        place=place,
        points=points,
    )
    raise typer.Exit(int(run_probe(options)))
