"""A session on two hosts over an impaired link, measured by its bag.

Run as `./trainer run python -m bench.graph.two_hosts`, with the rights of root: it tries
links from good to bad, half a minute each, and prints a table in Markdown.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.graph.impaired_link import Impairment, TwoHosts, missing_rights
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.node_common.cdr_codec import WrenchStampedCodec
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.scene_loader import load_scene

ROOT = Path(__file__).parents[2]
READY_TIMEOUT_S = 60.0
INTERRUPTION_S = 7.0, 3.0
"""Start, with the blade in the tissue, and duration of the interruption [s]."""
DELAYS, LOSSES = (0.0, 0.02, 0.05, 0.1), (0.0, 0.01, 0.05)
INTERRUPTED_IMPAIRMENT = Impairment(0.05, 0.01, 0.05, 0.02)
"""Impairment that is also tried with an interruption."""


@dataclass(frozen=True)
class Ended:
    """Results of the two sides of a session.

    Attributes:
        bridge_status, sim_status: exit statuses.
        bridge_said, sim_said: their output.
        bag: of the bridge's side.
    """

    bridge_status: int
    sim_status: int
    bridge_said: str
    sim_said: str
    bag: Path


def run_on_two_hosts(
    scene: Path, folder: Path, impairment: Impairment, domain: int, away: tuple[float, float]
) -> Ended:
    """Palpate and cut with the arm on one host and the tissue on another.

    Args:
        scene: that both run.
        folder: folder for the bag and the output of the sides.
        impairment: of the link.
        domain: ROS domain.
        away: from when and for how long [s] nothing passes, since all nodes are ready.
    """
    environment = os.environ | {'ROS_DOMAIN_ID': str(domain), 'COLUMNS': '200'}
    names, bag = ('bridge-side', 'sim-side'), folder / 'bag'
    said = [folder / name for name in names]
    with TwoHosts(impairment) as hosts:
        sides = []
        for side, name in enumerate(names):
            command = [
                sys.executable,
                '-m',
                'cutting_trainer.cli.main',
                name,
                '--scene',
                str(scene),
            ]
            command += ['--peer', hosts.addresses[1 - side], *(['--bag', str(bag)] * (not side))]
            with said[side].open('wb') as file:
                sides.append(
                    subprocess.Popen(
                        hosts.on(side, command), cwd=ROOT, env=environment, stdout=file, stderr=file
                    )
                )
        try:
            deadline = time.monotonic() + READY_TIMEOUT_S
            while not (_all_ready(said[0], 3) and _all_ready(said[1], 2)):
                if time.monotonic() > deadline:
                    raise TimeoutError(f'the nodes are not ready: {said[0].read_text()}')
                time.sleep(0.1)
            time.sleep(away[0])
            hosts.take_away(away[1])
            sides[0].wait(timeout=120)
            sides[1].send_signal(signal.SIGINT)
            sides[1].wait(timeout=60)
        finally:
            for process in sides:
                process.kill()
    return Ended(*(p.returncode for p in sides), *(p.read_text() for p in said), bag)


def _all_ready(said: Path, nodes: int) -> bool:
    return said.read_text().count(' is ready') == nodes


def checked_meshes(bag: Bag) -> list[tuple[int, bool]]:
    """Return revision and equality of each mesh that the bridge could compare.

    The hash of the simulation's side is in the mesh, that of the bridge's side on /diagnostics.
    """
    meshes = map(bag.read, bag.messages(['/tissue/mesh', '/tissue/mesh_updates']))
    sent = {mesh.revision: mesh.state_hash for mesh in meshes if mesh.state_hash}
    found = {}
    for array in map(bag.read, bag.messages(['/diagnostics'])):
        for status in array.status:
            if status.name == 'haptic_bridge':
                values = {v.key: v.value for v in status.values}
                revision = int(values['mesh_checked_revision'])
                if revision in sent:
                    found[revision] = int(values['mesh_checked_hash'], 16) == sent[revision]
    return sorted(found.items())


def last_status(bag: Bag, node: str) -> dict[str, str]:
    """Return the last values of a node on /diagnostics."""
    values: dict[str, str] = {}
    for array in map(bag.read, bag.messages(['/diagnostics'])):
        for status in array.status:
            if status.name == node:
                values = {v.key: v.value for v in status.values}
    return values


def ages(bag: Bag, topic: str) -> np.ndarray:
    """Return the age of each message at its recording [s]."""
    return np.array([(m.log_time - m.publish_time) * 1e-9 for m in bag.messages([topic])])


def main() -> None:
    """Try all links and print the results."""
    if why := missing_rights():
        raise SystemExit(f'not possible here: {why}')
    scene = load_scene('block')
    limit = scene.device.load_profile().max_force
    columns = (
        'one-way delay, loss of packets',
        'completes',
        'changes by cuts',
        'largest force [N]',
        'above the limit',
        'force faded',
        'faults',
        'frame on its way, median and p99 [ms]',
        'meshes compared, different',
    )
    for row in (columns, ['---'] * len(columns)):
        print('|', ' | '.join(row), '|', flush=True)
    links = [Impairment(d, min(d, 0.01), p, 0.02 if p else 0.0) for d in DELAYS for p in LOSSES]
    with reserved_domain('free') as domain:
        for link in [*links, INTERRUPTED_IMPAIRMENT]:
            away = INTERRUPTION_S if link is INTERRUPTED_IMPAIRMENT else (0.0, 0.0)
            name = f'{1e3 * link.delay:g} ms, {100 * link.loss:g} %'
            with tempfile.TemporaryDirectory() as folder:
                ended = run_on_two_hosts(scene.path, Path(folder), link, domain, away)
                row = _row(ended, limit)
            name += f', away for {away[1]:g} s' if away[1] else ''
            print('|', ' | '.join([name, *row]), '|', flush=True)


def _row(ended: Ended, limit: float) -> list[str]:
    bag = open_bag(ended.bag)
    codec = WrenchStampedCodec()
    forces = np.array([codec.decode(m.data).values[:3] for m in bag.messages(['/arm/servo_cf'])])
    norms = np.linalg.norm(forces, axis=1)
    way = 1e3 * ages(bag, '/tissue/force')
    status, compared = last_status(bag, 'haptic_bridge'), checked_meshes(bag)
    cuts = max((bag.read(m).topology for m in bag.messages(['/tissue/mesh'])), default=0)
    return [
        'no' if 'did not finish' in ended.bridge_said or ended.sim_status else 'yes',
        str(cuts),
        f'{norms.max():.2f}',
        f'{(norms > limit).sum()} of {len(norms)}',
        f'{status["stale_trips"]} times',
        status['faults'],
        f'{np.median(way):.0f}, {np.percentile(way, 99):.0f}',
        f'{len(compared)}, {sum(not same for _, same in compared)}',
    ]


if __name__ == '__main__':
    main()
