"""Records the sample sessions anew: `python -m session.make_samples [FOLDER]`.

Each is a live session of `trainer demo` in a scene of bags/samples, written once more with chunks
as large as they come, message by message as it was. Samples of a released format stay: new ones go
into a folder named after their format.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from bags.node import FORMAT_VERSION
from bags.repair import copy_bag

SAMPLES = Path(__file__).resolve().parents[1] / 'bags' / 'samples'
NAMES = ('palpation', 'straight_cut', 'crossing_cuts')


def main(folder: Path) -> None:
    """Records all samples into a new folder."""
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        for file in SAMPLES.glob('*.[vy]*'):
            shutil.copy(file, temporary)  # bags name the scene that they are from
        for name in NAMES:
            bag = Path(temporary) / name
            command = [sys.executable, '-m', 'session.cli', 'demo', '--domain', 'free']
            scene = ['--scene', f'{bag}.yaml', '--bag', str(bag)]
            subprocess.run([*command, *scene], check=True)
            copy_bag(bag, folder / name)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if sys.argv[1:] else SAMPLES / f'format_{FORMAT_VERSION}')
