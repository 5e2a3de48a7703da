"""Commands for a session on two hosts, and under faults."""

from pathlib import Path
from typing import Annotated

import typer

from session.options import EXIT_STATUSES, AsJson, Domain, SceneOption, Seed

commands = typer.Typer()

Open = Annotated[
    bool, typer.Option('--network', help='Find the nodes of other hosts, by multicast.')
]
Peers = Annotated[
    list[str] | None,
    typer.Option('--peer', help='Host to look for, where multicast does not pass; may repeat.'),
]
Server = Annotated[
    str,
    typer.Option('--discovery-server', help='HOST or HOST:PORT of a Fast DDS discovery server.'),
]
Partition = Annotated[
    str, typer.Option(help='Name that all nodes of the session share: others are not heard.')
]


@commands.command('bridge-side', epilog=EXIT_STATUSES)
def bridge_side(
    scene: SceneOption = 'liver',
    seconds: Annotated[
        float | None,
        typer.Option(help="Duration of the arm's script [s] (default: of the scene)."),
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option(help='New folder for the bag (default: bags/sessions/SCENE-TIME).'),
    ] = None,
    arm: Annotated[
        bool, typer.Option(help="Run the emulated arm; without, a device's driver must run.")
    ] = True,
    network: Open = False,
    peer: Peers = None,
    discovery_server: Server = '',
    partition: Partition = '',
    seed: Seed = 0,
    domain: Domain = '',
    as_json: AsJson = False,
) -> None:
    """Run the host with the device: force loop and recorder. The tissue is on a sim-side."""
    from session.domain import parse_domain
    from session.network import Network
    from session.sides import BridgeSide, run_bridge_side

    reach = Network(network, tuple(peer or ()), discovery_server, partition)
    options = BridgeSide(
        scene, seconds, bag, seed, parse_domain(domain), reach, arm=arm, as_json=as_json
    )
    raise typer.Exit(int(run_bridge_side(options)))


@commands.command('sim-side', epilog=EXIT_STATUSES)
def sim_side(
    scene: SceneOption = 'liver',
    network: Open = False,
    peer: Peers = None,
    discovery_server: Server = '',
    partition: Partition = '',
    mesh_bandwidth: Annotated[
        float,
        typer.Option(min=0, help='Most that goes out for meshes [bytes/s]; 0: no limit.'),
    ] = 0.0,
    seed: Seed = 0,
    domain: Domain = '',
) -> None:
    """Run the host that computes the tissue and its cuts, for a bridge-side. Ctrl-C ends it."""
    from session.domain import parse_domain
    from session.network import Network
    from session.sides import run_sim_side

    reach = Network(network, tuple(peer or ()), discovery_server, partition)
    raise typer.Exit(int(run_sim_side(scene, seed, parse_domain(domain), reach, mesh_bandwidth)))


@commands.command(epilog=EXIT_STATUSES)
def chaos(
    scene: SceneOption = 'block',
    minutes: Annotated[float, typer.Option(min=1.0, max=1440.0, help='Duration [min].')] = 10.0,
    faults: Annotated[int, typer.Option(min=1, help='How many nodes are struck.')] = 50,
    bag: Annotated[
        Path | None,
        typer.Option(help='New folder for the bag (default: bags/sessions/chaos-SCENE-TIME).'),
    ] = None,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Kill and freeze nodes of a session at random: is the hand safe, does all come back?"""
    from session.domain import parse_domain
    from session.trials.chaos import ChaosOptions, run_chaos

    options = ChaosOptions(scene, minutes, faults, seed, bag, parse_domain(domain), as_json)
    raise typer.Exit(int(run_chaos(options)))


@commands.command(epilog=EXIT_STATUSES)
def soak(
    scene: SceneOption = 'block',
    minutes: Annotated[float, typer.Option(min=1.0, max=10080.0, help='Duration [min].')] = 60.0,
    every: Annotated[float, typer.Option(min=20.0, help='Length of a session [s].')] = 60.0,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Run session after session on the same processes: do memory, threads or handles grow?"""
    from session.domain import parse_domain
    from session.trials.soak import SoakOptions, run_soak

    options = SoakOptions(scene, minutes, every, seed, parse_domain(domain), as_json)
    raise typer.Exit(int(run_soak(options)))


@commands.command(epilog=EXIT_STATUSES)
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
    bag: Annotated[
        Path | None,
        typer.Option(help='New folder for the bag (default: bags/sessions/fuzz-SCENE-TIME).'),
    ] = None,
    seed: Seed = 0,
    domain: Domain = 'free',
    as_json: AsJson = False,
) -> None:
    """Send a session what nobody should send: does any node die, or pass it on?"""
    from session.domain import parse_domain
    from session.trials.fuzz import FuzzOptions, run_fuzz

    options = FuzzOptions(scene, messages, flood, largest, seed, bag, parse_domain(domain), as_json)
    raise typer.Exit(int(run_fuzz(options)))
