"""Commands for a session on two hosts."""

from pathlib import Path
from typing import Annotated

import typer

from cutting_trainer.cli.options import EXIT_STATUSES, AsJson, Domain, SceneOption, Seed

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
    from cutting_trainer.session.domain import parse_domain
    from cutting_trainer.session.network import Network
    from cutting_trainer.session.two_host_session import BridgeSide, run_bridge_side

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
        typer.Option(min=0, help='Largest flow of meshes [bytes/s]; 0: no limit.'),
    ] = 0.0,
    seed: Seed = 0,
    domain: Domain = '',
) -> None:
    """Run the host that computes the tissue and its cuts, for a bridge-side. Ctrl-C ends it."""
    from cutting_trainer.session.domain import parse_domain
    from cutting_trainer.session.network import Network
    from cutting_trainer.session.two_host_session import run_sim_side

    reach = Network(network, tuple(peer or ()), discovery_server, partition)
    raise typer.Exit(int(run_sim_side(scene, seed, parse_domain(domain), reach, mesh_bandwidth)))
