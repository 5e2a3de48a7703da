"""Record the sample sessions again: `python -m bench.files.make_samples [FOLDER]`.

Each is a live session of `trainer demo` in a scene of bags/samples. All before tissue and
force loop are there is left out, as are the topics that name files of this machine; all the rest is
written once more, message by message as it was, with chunks as large as they come. Only a session
that succeeded, whose arm was never held up, and that is recomputed bit for bit, becomes a sample;
nothing is replaced before all are there. Samples of a released format stay: new ones go into a
folder named after their format. In the end the README's picture of a sample is drawn.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from cutting_trainer.bags.metadata import FORMAT_VERSION
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.repair import copy_bag
from cutting_trainer.bags.topic_names import CONTACT, MESH, POSE
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec
from cutting_trainer.recordings.picture import make_picture
from cutting_trainer.recordings.resimulate_command import resimulate
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / 'bags' / 'samples'
NAMES = ('palpation', 'straight_cut', 'crossing_cuts')
PICTURE = ROOT / 'docs' / 'images' / 'crossing_cuts.png'
MAX_ATTEMPTS = 10
MAX_GAP = 1.4
"""Time between two poses, in median times, from which on the machine has held the arm up."""
_LEFT_OUT = ('/rosout', '/parameter_events')


def main(folder: Path) -> None:
    """Record all samples into a folder and replace those in it.

    Raises:
        SessionError: a session failed ten times.
    """
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        for file in SAMPLES.glob('*.[vy]*'):
            shutil.copy(file, temporary)  # bags name the scene that they are from
        made = {name: record_sample(Path(temporary), name) for name in NAMES}
        for name, bag in made.items():
            shutil.rmtree(folder / name, ignore_errors=True)
            shutil.copytree(bag, folder / name)
            kilobytes = sum(file.stat().st_size for file in bag.iterdir()) / 1e3
            begin, end = open_bag(bag).span
            print(f'{folder / name}: {(end - begin) * 1e-9:.1f} s, {kilobytes:.0f} kB')
    if folder.is_relative_to(SAMPLES):
        make_picture(folder / NAMES[-1], PICTURE, None)
        print(f'{PICTURE}: of {NAMES[-1]}')


def record_sample(folder: Path, name: str) -> Path:
    """Record one session and make a sample of it.

    Args:
        folder: has the scene, and gets the bags.
        name: of the scene.

    Returns:
        Folder of the sample.

    Raises:
        SessionError: the session failed ten times.
    """
    for attempt in range(MAX_ATTEMPTS):
        bag, sample = folder / f'live{attempt}' / name, folder / f'sample{attempt}' / name
        bag.parent.mkdir(exist_ok=True)
        command = [sys.executable, '-m', 'cutting_trainer.cli', 'demo', '--domain', 'free']
        scene = ['--scene', str(folder / f'{name}.yaml'), '--bag', str(bag)]
        if subprocess.run([*command, *scene], check=False).returncode != Status.OK:
            continue
        copy_bag(bag, sample, since=begin_of_session(open_bag(bag)), without=_LEFT_OUT)
        poses = open_bag(sample).messages([POSE])
        gaps = np.diff([PoseStampedCodec().decode(pose.data).stamp_ns for pose in poses])
        if gaps.max() > MAX_GAP * np.median(gaps):
            print(f'{name}: the arm was held up for {gaps.max() * 1e-6:.1f} ms: once more')
            continue
        if resimulate(sample, {}) is Status.OK:
            return sample
    raise SessionError(f'{name} failed {MAX_ATTEMPTS} times: record samples on an idle machine')


def begin_of_session(bag: Bag) -> int:
    """Return the time of the first message of tissue or force loop [ns since the epoch]."""
    return next((m.log_time for m in bag.messages([MESH, CONTACT])), 0)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if sys.argv[1:] else SAMPLES / f'format_{FORMAT_VERSION}')
