"""A session on two hosts: `bridge-side` where the device is, `sim-side` elsewhere."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from session.demo import conclude, expected_of, new_bag, not_run, run_nodes, script_seconds
from session.domain import SIDES, reserved_domain
from session.graph import bridge_side_nodes, sim_side_nodes
from session.network import Network, network_environment
from session.processes import Supervisor
from session.progress import SessionProgress
from session.scene import load_scene
from session.status import Status

_FOREVER = 1e9


@dataclass(frozen=True)
class BridgeSide:
    """What the command line says to the host with the device.

    Attributes:
        scene: name or path, the same on both hosts.
        seconds: duration of the arm's script [s]; None: what the scene says.
        bag: folder of the new bag; None: one named after scene and time.
        seed: of everything random.
        domain: ROS domain.
        network: how far the graph reaches.
        arm: run the emulated arm; else a device's own driver is there.
        as_json: print the summary as JSON.
    """

    scene: str
    seconds: float | None
    bag: Path | None
    seed: int
    domain: int | Literal['free']
    network: Network
    arm: bool
    as_json: bool


def run_bridge_side(options: BridgeSide) -> Status:
    """Runs the force loop and the recorder until the arm's script is over, or Ctrl-C.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)
    seconds = script_seconds(scene, options.seconds) if options.arm else _FOREVER
    bag = new_bag(options.bag, scene.name)
    nodes = bridge_side_nodes(scene.path, bag, options.seed, seconds, arm=options.arm)
    notes = Console(stderr=True)
    with (
        reserved_domain(options.domain, SIDES[:1]) as domain,
        network_environment(domain, options.network) as environment,
    ):
        outcome = run_nodes(nodes, seconds, bag, environment, notes, restart=True)
    return conclude(outcome, bag, expected_of(scene), as_json=options.as_json)


def run_sim_side(
    scene: str,
    seed: int,
    domain: int | Literal['free'],
    network: Network,
    mesh_bandwidth: float,
) -> Status:
    """Computes the tissue until Ctrl-C.

    Args:
        scene: name or path, the same on both hosts.
        seed: of everything random.
        domain: ROS domain.
        network: how far the graph reaches.
        mesh_bandwidth: most that goes out for meshes [bytes/s]; 0: no limit.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    notes, path = Console(stderr=True), load_scene(scene).path
    with (
        reserved_domain(domain, SIDES[1:]) as number,
        network_environment(number, network) as environment,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        SessionProgress(notes, 2) as progress,
        Supervisor(
            sim_side_nodes(path, seed, Path(temporary) / 'tissue.checkpoint', mesh_bandwidth),
            Path(temporary) / 'log',
            environment,
            progress.tell,
            restart=True,
        ) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(_FOREVER)
        outcome = supervisor.end()
        if not outcome.ran:
            return not_run(outcome, Path(temporary), notes)
    return Status.OK if outcome.interrupted and not outcome.deaths else Status.NODE_DIED
