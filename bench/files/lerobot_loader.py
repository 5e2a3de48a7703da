"""Exported data sets in LeRobot's own loader.

    ./trainer run python -m bench.files.lerobot_loader --episodes 100

The first start makes an environment from bench/requirements-lerobot.txt in `.trainer/lerobot`: a
download of 4 GB, 8 GB of disk. The shipped sample bags are exported again and again until there are
enough episodes. The loader reads each frame of each episode, and the figures that it finds are
compared with those of the bags.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.topic_names import POSE
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.dataset import write_dataset
from cutting_trainer.studies.evaluation import read_recording

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = ROOT / 'bench' / 'requirements-lerobot.txt'
ENVIRONMENT = ROOT / '.trainer' / 'lerobot'
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
TOLERANCE = 1e-5
"""Relative difference of a figure: a loader may read in single precision."""


def make_environment() -> Path:
    """Return the Python of LeRobot's environment, which is made where it is not or is outdated."""
    python, stamp = ENVIRONMENT / 'bin' / 'python', ENVIRONMENT / 'requirements.sha256'
    digest = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()
    if not (stamp.exists() and stamp.read_text() == digest):
        uv = [str(Path(sys.prefix) / 'bin' / 'uv'), '--no-config']
        made = [*uv, 'venv', '--clear', '--python', sys.executable, str(ENVIRONMENT)]
        installed = [*uv, 'pip', 'install', '--python', str(python), '--require-hashes', '-r']
        subprocess.run(made, check=True)
        subprocess.run([*installed, str(REQUIREMENTS)], check=True)
        stamp.write_text(digest)
    return python


def read_by_lerobot(python: Path, root: Path, cache: Path) -> dict[str, Any]:
    """Return the figures of the loader.

    Args:
        python: of LeRobot's environment.
        root: folder of the data set.
        cache: folder of the loader.
    """
    environment = {**os.environ, 'HF_HUB_OFFLINE': '1', 'HF_HOME': str(cache)}
    environment.pop('PYTHONPATH', None)
    script = Path(__file__).with_name('lerobot_playback.py')
    ran = subprocess.run(
        [str(python), str(script), str(root)],
        env=environment, stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    found: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return found


def figures_of(bag: StudyBag) -> dict[str, float]:
    """Return largest force [N] and path of the hand [m], from the bag alone."""
    opened, codec = open_bag(bag.path), PoseStampedCodec()
    poses = [codec.decode(recorded.data) for recorded in opened.messages([POSE])]
    path = np.array([pose.values[:3] for pose in poses if pose.stamp_ns])
    felt = read_recording(str(bag.path), bag.hash).felt
    return {
        'largest_force': float(felt.forces.max()),
        'path': float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
    }


def differences(bags: Sequence[StudyBag], episodes: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return a sentence for each episode that is missing or has other figures than its bag."""
    figures = {bag.hash: figures_of(bag) for bag in bags}
    said = []
    for number, bag in enumerate(bags):
        found = episodes.get(str(number))
        if found is None:
            said.append(f'episode {number} is missing')
            continue
        if found['wrong']:
            said.append(f'episode {number}: {found["wrong"]:.0f} frames have other neighbours')
        for name, value in figures[bag.hash].items():
            if not np.isclose(found[name], value, rtol=TOLERANCE, atol=0.0):
                said.append(f'episode {number}: {name} {found[name]:.7g}, of its bag {value:.7g}')
    return said


def main(arguments: list[str] | None = None) -> int:
    """Export, load, compare; print JSON. Return 1 where something differs."""
    parser = argparse.ArgumentParser(description="Exported episodes in LeRobot's own loader.")
    parser.add_argument('--episodes', type=int, default=100)
    count = parser.parse_args(arguments).episodes
    python = make_environment()
    samples = find_bags([str(SAMPLES)], SAMPLES)
    bags = [samples[i % len(samples)] for i in range(count)]
    with tempfile.TemporaryDirectory() as temporary:
        began = time.monotonic()
        write_dataset(bags, Path(temporary) / 'set', '')
        exported = time.monotonic()
        found = read_by_lerobot(python, Path(temporary) / 'set', Path(temporary) / 'cache')
        loaded = time.monotonic()
    said = differences(bags, found['episodes'])
    print(json.dumps({
        'episodes': len(found['episodes']), 'wanted': count, 'frames': found['frames'],
        'differences': said, 'export_seconds': exported - began, 'load_seconds': loaded - exported,
    }))  # fmt: skip
    return 1 if said or len(found['episodes']) != count else 0


if __name__ == '__main__':
    sys.exit(main())
