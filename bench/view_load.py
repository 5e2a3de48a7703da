"""What the view costs those who act: wake-up, latency and rate without it, and with 0 and 3 pages.

Run `python -m bench.view_load [--seconds 10] [--rounds 4] [--scene block]`. One session runs all
the time, in which a hand presses and cuts without end; the conditions take turns in it, so that
what else the machine does falls on all of them alike. The pages are clients that read everything
a browser would, and draw nothing; they have a process of their own that takes only what nobody else
wants of a core, so that what is measured is the viewer.
"""

import argparse
import math
import os
import statistics
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from bags.player import first_time
from bags.reader import open_bag
from bags.topics import UPDATES
from bench.open_page import OtherProcess
from session.domain import reserved_domain
from session.evidence import read_evidence
from session.graph import (
    BRIDGE_NODE,
    LOCAL,
    TISSUE_NODE,
    VIEWER_NODE,
    node_environment,
    recorder_command,
    simulation_nodes,
    viewer_command,
)
from session.processes import Supervisor
from session.progress import SessionProgress
from session.scene import load_scene
from session.trials.operator import Operator

CONDITIONS = {'no view': None, 'view, 0 pages': 0, 'view, 3 pages': 3}
PORT = 8899
SETTLING = 2.0
"""[s] after a change of the condition that do not count: a status is about the second before."""
STROKE = 5.0
"""[s] in which the hand goes once along the scene's way: each condition has one whole at least."""
QUANTITIES = {
    'force loop: wake-up p99 [ms]': (BRIDGE_NODE, 'lateness_p99', 1e3),
    'force loop: wake-up p99.9 [ms]': (BRIDGE_NODE, 'lateness_p999', 1e3),
    'force loop: rate [Hz]': (BRIDGE_NODE, 'rate', 1.0),
    'pose to force p99 [ms]': (BRIDGE_NODE, 'pose_to_force_p99', 1e3),
    'tissue: wake-up p99 [ms]': (TISSUE_NODE, 'lateness_p99', 1e3),
    'tissue: rate [Hz]': (TISSUE_NODE, 'rate', 1.0),
    'view: rate [Hz]': (VIEWER_NODE, 'rate', 1.0),
}
OF_SPANS = {
    'viewer: share of a core': 'viewer',
    'pages: share of a core': 'pages',
    'frames that come to a page [Hz]': 'arriving',
    'frames in which the tissue moved [Hz]': 'moved',
}


class Span(NamedTuple):
    """A condition for a while.

    Attributes:
        condition: of `CONDITIONS`.
        began, ended: [s since the epoch].
        viewer: processor time of the viewer by time [1].
        pages: the same of all pages.
        arriving: frames that came to a page, the mean of all [Hz].
        moved: frames in which the tissue moved, by the bag [Hz]: a page gets no others.
    """

    condition: str
    began: float
    ended: float
    viewer: float = math.nan
    pages: float = math.nan
    arriving: float = math.nan
    moved: float = math.nan


def run(supervisor: Supervisor, scene: Path, seconds: float, rounds: int) -> list[Span]:
    """Lets the conditions take turns."""
    spans = []
    for _ in range(rounds):
        for name, pages in CONDITIONS.items():
            supervisor.remove([VIEWER_NODE])
            if pages is not None:
                supervisor.replace([viewer_command(scene, LOCAL, PORT, session=False)])
            opened = OtherProcess(f'http://{LOCAL}:{PORT}', pages, 19) if pages else None
            pause(supervisor, SETTLING)
            began, busy = time.time(), viewer_time(supervisor)
            pause(supervisor, seconds)
            span = Span(name, began, time.time())
            share = (viewer_time(supervisor) - busy) / (span.ended - began)
            span = span._replace(viewer=share)
            if opened is not None:
                seen = opened.close()
                arriving = statistics.mean(seen['rates'])
                span = span._replace(pages=seen['load'], arriving=arriving)
            spans.append(span)
    return spans


def pause(supervisor: Supervisor, seconds: float) -> None:
    """Lets the session run on [s]."""
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        supervisor.run(supervisor.outcome.seconds + 0.2)


def viewer_process(supervisor: Supervisor) -> int:
    """Its number; 0 where there is none."""
    return supervisor.pids.get(VIEWER_NODE, 0)


def viewer_time(supervisor: Supervisor) -> float:
    """Processor time of the viewer so far [s]; NaN where there is none."""
    if not (process := viewer_process(supervisor)):
        return math.nan
    words = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf('SC_CLK_TCK')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--scene', default='block')
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--rounds', type=int, default=4)
    given = parser.parse_args()
    scene = load_scene(given.scene)
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        nodes = [
            *simulation_nodes(scene.path, 0, Path(folder) / 'checkpoint'),
            recorder_command(scene.path, bag, 0),
        ]
        with (
            SessionProgress(Console(stderr=True), len(nodes)) as progress,
            Supervisor(nodes, bag / 'log', node_environment(domain), progress.tell) as supervisor,
        ):
            assert supervisor.start(), supervisor.outcome
            operator = Operator(scene, domain, 0, STROKE)
            spans = run(supervisor, scene.path, given.seconds, given.rounds)
            operator.end()
            supervisor.end()
        Console().print(table(bag, spans))


def table(bag: Path, spans: list[Span]) -> Table:
    """Medians over the seconds of each condition."""
    statuses, origin = read_evidence(bag).statuses, 1e-9 * first_time(open_bag(bag))
    moves = [1e-9 * recorded.log_time for recorded in open_bag(bag).messages([UPDATES])]
    spans = [
        s._replace(moved=sum(s.began < t < s.ended for t in moves) / (s.ended - s.began))
        for s in spans
    ]
    out = Table()
    for column in ('', *CONDITIONS, '3 pages / 0 pages', '3 pages / no view'):
        out.add_column(column, justify='left' if not column else 'right')
    for title, (node, key, scale) in QUANTITIES.items():
        values = {
            name: [
                scale * status.number(key)
                for status in statuses
                for span in spans
                if span.condition == name
                and status.node == node
                and span.began < origin + status.time < span.ended
            ]
            for name in CONDITIONS
        }
        out.add_row(title, *cells(values))
    for title, field in OF_SPANS.items():
        values = {
            name: [getattr(span, field) for span in spans if span.condition == name]
            for name in CONDITIONS
        }
        out.add_row(title, *cells(values))
    return out


def cells(values: Mapping[str, list[float]]) -> list[str]:
    """Medians by condition, and their ratios."""
    medians = []
    for name in CONDITIONS:
        known = [value for value in values[name] if not math.isnan(value)]
        medians.append(statistics.median(known) if known else math.nan)
    none, zero, three = medians
    return [f'{value:.3g}' for value in (none, zero, three, three / zero, three / none)]


if __name__ == '__main__':
    main()
