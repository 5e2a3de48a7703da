"""A session of a large tissue under changing load: what it concedes, and the same bits again.

`./trainer run python -m bench.figures.scale_governor` takes two minutes. The tissue is that of the
scene `palpation` in 51,744 tetrahedra, 500 nodes of it moving on their own. For a part of the
session other processes keep the processors busy. At this mesh it takes two dozen: fewer leave the
tissue, which sleeps half of the time, its share.
"""

import contextlib
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import yaml

from bench.accuracy.footprint import CELLS
from bench.common.json_answer import json_answer
from bench.common.meshes import kuhn_block
from bench.figures.figure import Figure, print_figures
from bench.trials.same_cut import kept_busy
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import FrameRecord, read_run
from cutting_trainer.bags.resimulation import as_recorded
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.session.scene_loader import SCENES, Scene, load_scene

SECONDS = 50.0
NODES = 500
BUSY = 24
"""Processes that keep a processor busy."""
LOADED = (0.15, 0.35)
"""Part of the session in which they run, as a share of it."""
_STARTS_S = 4.0
"""[s] that the nodes take to start."""


def measure() -> list[Figure]:
    """Run the session, compute it again, and return the figures."""
    with tempfile.TemporaryDirectory(prefix='trainer-') as name:
        folder = Path(name)
        scene, bag = _scene(folder), folder / 'bag'
        (folder / 'recorded').mkdir()
        command = ('demo', '--scene', str(scene), '--seconds', f'{SECONDS:g}', '--json')
        with _load():
            done = json_answer(*command, '--domain', 'free', '--bag', str(bag))
        again = json_answer('resimulate', str(bag), '--json')
        recorded = open_bag(bag)
        records, _ = read_run(recorded)
        off = _force_error(records, load_scene(str(restore_scene(recorded, folder / 'recorded'))))
    conceded = np.array([record.concession for record in records])
    count = int((conceded > 0).sum())
    taken_back = int((np.diff(conceded) < 0).sum())
    differs = float(not again['identical'] or bool(again['missing']))
    frames, lost = len(records), sum(done['lost'].values())
    return [
        Figure(5, 'frames with a concession', count, 30, 'at least', '', frames),
        Figure(5, 'concessions taken back', taken_back, 1, 'at least', '', frames),
        Figure(5, 'messages lost on the way to the bag', lost, 0, 'at most', '', frames),
        Figure(5, 'force against no concession, rms over peak', off, 0.05, 'at most', '', frames),
        Figure(5, 'sessions that differ when computed again', differs, 0, 'at most', '', frames),
    ]


def _force_error(records: list[FrameRecord], scene: Scene) -> float:
    """Return how far the conceding frames' forces are from those without a concession."""
    conceding_nothing = [replace(record, concession=0) for record in records]
    place = ForceSampleCodec.fields['force']
    felt, whole = [], []
    for record, frame in zip(
        records, as_recorded(conceding_nothing, recomputation(scene)), strict=True
    ):
        if record.concession and record.force is not None:
            felt.append(record.force.values[place])
            whole.append(frame.force)
    if not whole:
        return 0.0
    off = np.linalg.norm(np.subtract(felt, whole), axis=1)
    return float(np.sqrt((off**2).mean()) / np.linalg.norm(whole, axis=1).max())


def _scene(folder: Path) -> Path:
    """Write the scene with a finer mesh and a far field; return its file."""
    file = SCENES / 'palpation.yaml'
    scene = yaml.safe_load(file.read_text(encoding='utf-8'))
    size = np.array([0.096, 0.096, 0.04])
    mesh = kuhn_block(CELLS[3.6], tuple(size))
    nodes = mesh.rest - size * [0.5, 0.5, 0.0]
    tetrahedra = [('tetra', mesh.tetrahedra.astype(np.int64))]
    meshio.Mesh(nodes, tetrahedra).write(folder / 'block.vtk', file_format='vtk')
    scene['tissue'] |= {
        'mesh': 'block.vtk',
        'active_region': {'mode': 'budget', 'nodes': NODES},
    }
    scene['tissue']['integration']['max_substeps'] = 1000
    changed = folder / 'large.yaml'
    changed.write_text(yaml.safe_dump(scene), encoding='utf-8')
    return changed


@contextlib.contextmanager
def _load() -> Iterator[None]:
    """Keep the processors busy in a part of a session that begins now."""
    over = threading.Event()

    def run() -> None:
        if over.wait(_STARTS_S + LOADED[0] * SECONDS):
            return
        with kept_busy(BUSY):
            over.wait((LOADED[1] - LOADED[0]) * SECONDS)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


if __name__ == '__main__':
    sys.exit(print_figures(measure()))
