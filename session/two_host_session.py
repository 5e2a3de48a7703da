"""A session on two hosts: `bridge-side` where the device is, `sim-side` elsewhere."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cutting_trainer.session.demo_command import (
    conclude,
    expectations,
    new_bag,
    report_failed_start,
    run_nodes,
    script_seconds,
)
from cutting_trainer.session.domain import SIDES, reserved_domain
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.network import Network, network_environment
from cutting_trainer.session.node_commands import bridge_side_nodes, sim_side_nodes
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import load_scene, require_frames
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.session.terminal import session_console

_FOREVER = 1e9


@dataclass(frozen=True)
class BridgeSide:
    """Options of `bridge-side`, on the host with the device.

    Attributes:
        scene: name or path, the same on both hosts.
        seconds: duration of the arm's script [s]; None: that of the scene.
        bag: folder of the new bag; None: a folder named after scene and time.
        seed: seed of all random numbers.
        domain: ROS domain.
        network: reach of the graph.
        arm: run the emulated arm; else the driver of a device runs.
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
    """Run the force loop and the recorder until the end of the arm's script, or Ctrl-C.

    Raises:
        SessionError, SceneError, SettingsError: an option or the scene is not valid.
    """
    scene = load_scene(options.scene)
    require_frames(scene)
    seconds = script_seconds(scene, options.seconds) if options.arm else _FOREVER
    bag = new_bag(options.bag, scene.name)
    nodes = bridge_side_nodes(scene.path, bag, options.seed, seconds, arm=options.arm)
    notes = session_console()
    with (
        reserved_domain(options.domain, SIDES[:1]) as domain,
        network_environment(domain, options.network) as environment,
    ):
        outcome = run_nodes(nodes, seconds, bag, environment, notes, restart=True)
    return conclude(outcome, bag, expectations(scene), as_json=options.as_json)


def run_sim_side(
    scene: str,
    seed: int,
    domain: int | Literal['free'],
    network: Network,
    mesh_bandwidth: float,
) -> Status:
    """Compute the tissue until Ctrl-C.

    Args:
        scene: name or path, the same on both hosts.
        seed: seed of all random numbers.
        domain: ROS domain.
        network: reach of the graph.
        mesh_bandwidth: limit of the outgoing mesh data [bytes/s]; 0: no limit.

    Raises:
        SessionError, SceneError, SettingsError: an option or the scene is not valid.
    """
    notes, path = session_console(), load_scene(scene).path
    with (
        reserved_domain(domain, SIDES[1:]) as number,
        network_environment(number, network) as environment,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        SessionProgress(notes, 2) as progress,
        Supervisor(
            sim_side_nodes(path, seed, Path(temporary) / 'tissue.checkpoint', mesh_bandwidth),
            Path(temporary) / 'log',
            environment,
            progress.show,
            restart=True,
        ) as supervisor,
    ):
        if supervisor.start():
            supervisor.run(_FOREVER)
        outcome = supervisor.end()
        if not outcome.ran:
            return report_failed_start(outcome, Path(temporary), notes)
    return Status.OK if outcome.interrupted and not outcome.deaths else Status.NODE_DIED
