"""Load of the view on the session: wake-up, latency and rate without it, and with 0 and 3 pages.

Run `python -m bench.graph.view_load [--seconds 10] [--rounds 4] [--scene block]`. One session runs
all the time, in which a hand presses and cuts without end; the conditions take turns in it, so that
so that other load of the machine is the same for all. The pages are clients that read everything
a browser would, and draw nothing; their process takes only idle
processor time, so that the measurement is that of the viewer.
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

from bench.page.open_page import OtherProcess
from bench.trials.operator import Operator
from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.topic_names import UPDATES
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import (
    BRIDGE_NODE,
    LOCAL,
    TISSUE_NODE,
    VIEWER_NODE,
    node_environment,
    recorder_command,
    simulation_nodes,
    viewer_command,
)
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.viewer.access_control import TOKEN_VARIABLE, link

CONDITIONS = {'no view': None, 'view, 0 pages': 0, 'view, 3 pages': 3}
PORT, TOKEN = 8899, 'of-this-measurement'
URL = link(LOCAL, PORT, [], TOKEN)
SETTLING_TIME_S = 2.0
"""[s] after a change of the condition that do not count: a status is about the second before."""
STROKE_DURATION_S = 5.0
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
    """Let the conditions take turns."""
    spans = []
    for _ in range(rounds):
        for name, pages in CONDITIONS.items():
            supervisor.remove([VIEWER_NODE])
            if pages is not None:
                supervisor.replace([viewer_command(scene, LOCAL, PORT, session=False)])
            opened = OtherProcess(URL, pages, 19) if pages else None
            pause(supervisor, SETTLING_TIME_S)
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
    """Let the session run on [s]."""
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        supervisor.run(supervisor.outcome.seconds + 0.2)


def viewer_process(supervisor: Supervisor) -> int:
    """Return its number; 0 where there is none."""
    return supervisor.pids.get(VIEWER_NODE, 0)


def viewer_time(supervisor: Supervisor) -> float:
    """Return processor time of the viewer so far [s]; NaN where there is none."""
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
    os.environ[TOKEN_VARIABLE] = TOKEN
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        nodes = [
            *simulation_nodes(scene.path, 0, Path(folder) / 'checkpoint'),
            recorder_command(scene.path, bag, 0),
        ]
        with (
            SessionProgress(Console(stderr=True), len(nodes)) as progress,
            Supervisor(nodes, bag / 'log', node_environment(domain), progress.show) as supervisor,
        ):
            assert supervisor.start(), supervisor.outcome
            operator = Operator(scene, domain, 0, STROKE_DURATION_S)
            spans = run(supervisor, scene.path, given.seconds, given.rounds)
            operator.end()
            supervisor.end()
        Console().print(table(bag, spans))


def table(bag: Path, spans: list[Span]) -> Table:
    """Return medians over the seconds of each condition."""
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
    """Return medians by condition, and their ratios."""
    medians = []
    for name in CONDITIONS:
        known = [value for value in values[name] if not math.isnan(value)]
        medians.append(statistics.median(known) if known else math.nan)
    none, zero, three = medians
    return [f'{value:.3g}' for value in (none, zero, three, three / zero, three / none)]


if __name__ == '__main__':
    main()
