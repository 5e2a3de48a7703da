"""Two arms in one tissue on the real graph: loops in time, rate of the tissue, the same bits again.

`./trainer run python -m bench.figures.arms_two_tools --seconds 60` measures a longer session.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.common.json_answer import json_answer
from bench.figures.figure import Figure, print_figures
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.node_common.cdr_codec import (
    ForceSampleCodec,
    PoseStampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.tissue_sim.contact.tool import ContactState

SECONDS = 20.0
PERIOD_S, RATE_HZ = 1e-3, 30.0
TOOLS = ('', '/grasper')


def measure(seconds: float = SECONDS) -> list[Figure]:
    """Run the scene `two_tools`, compute it again, and return the figures.

    Args:
        seconds: duration of the scripts [s].
    """
    with tempfile.TemporaryDirectory(prefix='trainer-') as folder:
        bag = Path(folder) / 'bag'
        arguments = ('demo', '--scene', 'two_tools', '--seconds', f'{seconds:g}', '--json')
        json_answer(*arguments, '--domain', 'free', '--bag', str(bag))
        again = json_answer('resimulate', str(bag), '--json')
        return [*_loops(open_bag(bag)), *_tissue(open_bag(bag)), *_same(again)]


def _stamps(bag: Bag, topic: str, codec: Any) -> np.ndarray:
    """Return the stamps of a topic [s]."""
    stamps = [codec.decode(message.data).stamp_ns for message in bag.messages([topic])]
    return np.array(stamps, np.int64) * 1e-9


def _loops(bag: Bag) -> list[Figure]:
    """Return the share of periods within half a period of the nominal one, by recorded stamps."""
    found = []
    for tool in TOOLS:
        for topic, codec in (
            ('/arm/servo_cf', WrenchStampedCodec()),
            ('/arm/measured_cp', PoseStampedCodec()),
        ):
            periods = np.diff(_stamps(bag, f'{tool}{topic}', codec))
            share = float(np.mean(np.abs(periods - PERIOD_S) <= 0.5 * PERIOD_S))
            name = f'periods of {tool}{topic} in time'
            found.append(Figure(1, name, share, 0.995, 'at least', '', len(periods)))
    return found


def _tissue(bag: Bag) -> list[Figure]:
    times = _stamps(bag, '/tissue/force', ForceSampleCodec())
    rate = (len(times) - 1) / (times[-1] - times[0])
    figures = [Figure(1, 'mean rate of the tissue', rate, 0.98 * RATE_HZ, 'at least', 'Hz', 1)]
    codec = ForceSampleCodec()
    place = codec.fields['state']
    inside = []
    for tool in TOOLS:
        samples = [codec.decode(m.data) for m in bag.messages([f'{tool}/tissue/force'])]
        inside.append({s.stamp_ns for s in samples if s.values[place][0] == ContactState.INSIDE})
    both = len(inside[0] & inside[1])
    name = 'frames in which one tool holds the tissue and the other cuts it'
    return [*figures, Figure(1, name, both, 10, 'at least', '', len(times))]


def _same(report: dict[str, Any]) -> list[Figure]:
    differs = float(not report['identical'] or bool(report['missing']))
    name = 'sessions that are not the same when computed again'
    return [Figure(1, name, differs, 0.0, 'at most', '', report['frames'])]


def main() -> int:
    """Print the figures of one session; return 1 where one falls short."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=SECONDS, help='duration [s]')
    figures = measure(parser.parse_args().seconds)
    return print_figures(figures)


if __name__ == '__main__':
    sys.exit(main())
