"""Figures of exported arrays: a foreign reader finds the figures of the bags."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from bench.figures.figure import Figure
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.exercises.opened_tissue import cut_faces
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.session_arrays import write_sessions

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
READER = ROOT / 'bench' / 'files' / 'hdf5_reader.py'
SESSIONS = 3
BOUND = 1e-9
"""Largest relative difference: sums in another order round otherwise."""


def measure() -> list[Figure]:
    """Return the figure of line 4 for arrays."""
    bags = find_bags(['.'], SAMPLES)[:SESSIONS]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, 'set.h5')
        write_sessions(bags, file, '')
        command = [sys.executable, '-I', str(READER), str(file)]
        found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    off = []
    for bag in bags:
        read, wanted = found[bag.hash], _figures(bag)
        _, volume, area = read['states'][-1]
        values = np.array([read['largest_force'], volume, area])
        off.append(np.abs(values - wanted) / np.where(wanted > 0.0, wanted, 1.0))
    name = (
        'largest force, volume and opened area in another program, relative difference to the bag'
    )
    return [Figure(4, name, float(np.max(off)), BOUND, 'at most', '', 3 * len(bags))]


def _figures(bag: StudyBag) -> np.ndarray:
    """Return largest force [N], volume [m^3], opened area of one side at rest [m^2]."""
    tissue = tissue_at(open_bag(bag.path))
    corners = tissue.positions()[tissue.tetrahedra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6
    force = read_evidence(bag.path).forces[:, 1].max()
    return np.array([force, volume, cut_faces(tissue).areas.sum()])
