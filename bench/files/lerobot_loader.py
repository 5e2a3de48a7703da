"""Exported data sets in LeRobot's own loader.

    ./trainer run python -m bench.files.lerobot_loader --episodes 100
    ./trainer run python -m bench.files.lerobot_loader --episodes 3 --video

The first start makes an environment from bench/requirements-lerobot.txt in `.trainer/lerobot`: a
download of 4 GB, 8 GB of disk. The shipped sample bags are exported again and again until there are
enough episodes. The loader reads each frame of each episode, and the figures that it finds are
compared with those of the bags. With videos, each 25th picture is compared with a new drawing of
the bag.
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
from cutting_trainer.recordings.film_command import open_film
from cutting_trainer.studies.bag_collection import StudyBag, find_bags
from cutting_trainer.studies.dataset import write_dataset
from cutting_trainer.studies.dataset_episode import read_episode
from cutting_trainer.studies.dataset_video import FPS, SIZE, Thumbnail, alike, thumbnail
from cutting_trainer.studies.evaluation import read_recording
from cutting_trainer.studies.session_metadata import SessionMetadata

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = ROOT / 'bench' / 'requirements-lerobot.txt'
ENVIRONMENT = ROOT / '.trainer' / 'lerobot'
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
EACH = 25
"""Frames from one compared picture to the next, as in `lerobot_playback.py`."""
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


def drawings_of(bag: StudyBag) -> list[Thumbnail]:
    """Return thumbnails of each 25th picture, drawn from the bag."""
    episode = read_episode(bag, SessionMetadata()).by_picture(FPS)
    with open_film(bag.path, SIZE, gauges=False) as film:
        return [thumbnail(picture) for picture in film.pictures(episode.times[::EACH])]


def differences(
    bags: Sequence[StudyBag],
    episodes: Mapping[str, Mapping[str, Any]],
    drawings: Mapping[str, Sequence[Thumbnail]] | None = None,
) -> list[str]:
    """Return a sentence for each episode that is missing or has other figures than its bag.

    Args:
        bags: of the episodes.
        episodes: figures of the loader.
        drawings: pictures by hash of the bag, where the data set has videos; the path of the hand
            is that from picture to picture then, and is not compared.
    """
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
            if drawings is not None and name == 'path':
                continue
            if not np.isclose(found[name], value, rtol=TOLERANCE, atol=0.0):
                said.append(f'episode {number}: {name} {found[name]:.7g}, of its bag {value:.7g}')
        if drawings is not None and not same_pictures(found['pictures'], drawings[bag.hash]):
            said.append(f'episode {number}: its pictures are others than those of its bag')
    return said


def same_pictures(found: Sequence[Any], drawn: Sequence[Thumbnail]) -> bool:
    """Return whether the loader has these pictures in this order, but for the encoder's loss."""
    return len(found) == len(drawn) and all(map(alike, found, drawn))


def main(arguments: list[str] | None = None) -> int:
    """Export, load, compare; print JSON. Return 1 where something differs."""
    parser = argparse.ArgumentParser(description="Exported episodes in LeRobot's own loader.")
    parser.add_argument('--episodes', type=int, default=100)
    parser.add_argument('--video', action='store_true')
    asked = parser.parse_args(arguments)
    count = asked.episodes
    python = make_environment()
    samples = find_bags([str(SAMPLES)], SAMPLES)
    bags = [samples[i % len(samples)] for i in range(count)]
    with tempfile.TemporaryDirectory() as temporary:
        began = time.monotonic()
        write_dataset(bags, Path(temporary) / 'set', '', pictures=asked.video)
        exported = time.monotonic()
        found = read_by_lerobot(python, Path(temporary) / 'set', Path(temporary) / 'cache')
        loaded = time.monotonic()
    drawings = {bag.hash: drawings_of(bag) for bag in set(bags)} if asked.video else None
    said = differences(bags, found['episodes'], drawings)
    pictures = sum(len(of['pictures']) for of in found['episodes'].values())
    print(json.dumps({
        'episodes': len(found['episodes']), 'wanted': count, 'frames': found['frames'],
        'pictures': pictures, 'differences': said,
        'export_seconds': exported - began, 'load_seconds': loaded - exported,
    }))  # fmt: skip
    return 1 if said or len(found['episodes']) != count else 0


if __name__ == '__main__':
    sys.exit(main())
