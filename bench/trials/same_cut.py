"""`bench same-cut`: one recorded hand, run live under changing load: is the cut the same?"""

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from bench.trials.trial import print_result
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.recordings.html_report import incision_area
from cutting_trainer.recordings.picture import read_story
from cutting_trainer.session.exit_status import Status
from cutting_trainer.tissue_sim.mesh.pieces import pieces_of

MAX_SPREAD = 0.01
"""Allowed difference of opened area, relative to the mean."""
MAX_BUSY = 2
"""Most processes that keep a core busy; the runs take 0 to so many in turn."""
_TRAINER = (sys.executable, '-m', 'cutting_trainer.cli')
_BUSY = (sys.executable, '-c', 'while True: pass')


@dataclass(frozen=True)
class Cut:
    """The cut of one run.

    Attributes:
        busy: processes that kept a core busy.
        status: exit status of the session.
        area: opened, one side [m^2].
        pieces: their volumes, smallest first [mm^3].
        identical: whether the recording, computed again, gave the same bits.
    """

    busy: int
    status: int
    area: float
    pieces: tuple[int, ...]
    identical: bool


def run_same_cut(hand: Path, runs: int, *, as_json: bool) -> Status:
    """Run a recorded hand several times, and print the cut of each run.

    Args:
        hand: folder of the bag with the hand.
        runs: how many.
        as_json: print the result as JSON.

    Raises:
        BagError: the bag is not valid.
    """
    open_bag(hand)
    cuts = []
    with tempfile.TemporaryDirectory(prefix='trainer-') as folder:
        for number in range(runs):
            cuts.append(_run(hand, Path(folder) / f'{number}', number % (MAX_BUSY + 1)))
            print(f'run {number + 1} of {runs}: {cuts[-1]}', file=sys.stderr)
    areas = [cut.area for cut in cuts]
    mean = sum(areas) / runs
    spread = (max(areas) - min(areas)) / mean if mean > 0 else float('inf')
    failures = failures_of(cuts, spread)
    table = Table('busy', 'status', 'opened [cm^2]', 'pieces', 'computed again')
    for cut in cuts:
        same = 'identical' if cut.identical else 'differs'
        numbers = (str(cut.busy), str(cut.status), f'{cut.area * 1e4:.4f}', str(len(cut.pieces)))
        table.add_row(*numbers, same)
    more = {'runs': [asdict(cut) for cut in cuts]}
    print_result({'spread of area': spread}, table, failures, more=more, as_json=as_json)
    return Status.FAILED if failures else Status.OK


def failures_of(cuts: list[Cut], spread: float) -> list[str]:
    """Return the differences between some runs, as sentences.

    Args:
        cuts: of the runs.
        spread: of their opened areas, relative to the mean.
    """
    found = []
    if not spread <= MAX_SPREAD:
        found.append(f'the opened areas differ by {100 * spread:.2f} %')
    if len({len(cut.pieces) for cut in cuts}) > 1:
        found.append('the runs have cut off different numbers of pieces')
    differing = sum(not cut.identical for cut in cuts)
    if differing:
        found.append(f'{differing} recordings, computed again, differ')
    return found


def _run(hand: Path, bag: Path, busy: int) -> Cut:
    with kept_busy(busy):
        status = _call('replay', str(hand), '--domain', 'free', '--output', str(bag))
    recorded = open_bag(bag)
    replica = read_story(bag, None).replica
    volumes = (round(1e9 * piece.volume) for piece in pieces_of(replica, replica.rest))
    identical = _call('resimulate', str(bag)) == Status.OK
    return Cut(busy, status, incision_area(recorded), tuple(sorted(volumes)), identical)


def _call(*arguments: str) -> int:
    return subprocess.run([*_TRAINER, *arguments], capture_output=True, check=False).returncode


@contextlib.contextmanager
def kept_busy(count: int) -> Iterator[None]:
    """Keep some processors busy, at the priority of this process."""
    processes = [subprocess.Popen(_BUSY) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
