"""The moving picture of README.md: a demo is recorded, and its two cuts are filmed.

Run `python -m bench.page.demo_film [-o FILE]`.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from cutting_trainer.bags.playback_messages import duration
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.recordings.film_command import FilmOptions, make_film

CUTS_S = 11.5
"""[s] at the end of the demo, with both cuts."""
FILM_S = 10.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/images/demo.gif'))
    output = parser.parse_args().output
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'demo'
        demo = [sys.executable, '-m', 'cutting_trainer.cli', 'demo', '--domain', 'free']
        subprocess.run([*demo, '--bag', str(bag)], check=True)
        start, rate = duration(open_bag(bag)) - CUTS_S, CUTS_S / FILM_S
        size = 640, 360
        options = FilmOptions(bag, output, start=start, rate=rate, fps=10, size=size, zoom=2.0)
        make_film(options, lambda _: None)


if __name__ == '__main__':
    main()
