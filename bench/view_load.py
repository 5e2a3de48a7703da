"""What the view costs those who act: wake-up, latency and rate without it, and with 0 and 3 pages.

Run `python -m bench.view_load [--seconds 10] [--rounds 3] [--scene liver]`. One session runs all
the time; the conditions take turns in it, so that what else the machine does falls on all of them
alike. The pages are clients that read everything a browser would, and draw nothing.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bags.player import first_time
from bags.reader import open_bag
from bench.open_page import OpenPage
from session.domain import reserved_domain
from session.evidence import read_evidence
from session.graph import (
    BRIDGE_NODE,
    LOCAL,
    TISSUE_NODE,
    VIEWER_NODE,
    node_environment,
    session_nodes,
    viewer_command,
)
from session.processes import Supervisor
from session.progress import SessionProgress
from session.scene import load_scene

CONDITIONS = {'no view': None, 'view, 0 pages': 0, 'view, 3 pages': 3}
PORT = 8899
SETTLING = 2.0
"""[s] after a change of the condition that do not count: a status is about the second before."""
QUANTITIES = {
    'force loop: wake-up p99 [ms]': (BRIDGE_NODE, 'lateness_p99', 1e3),
    'force loop: wake-up p99.9 [ms]': (BRIDGE_NODE, 'lateness_p999', 1e3),
    'force loop: rate [Hz]': (BRIDGE_NODE, 'rate', 1.0),
    'pose to force p99 [ms]': (BRIDGE_NODE, 'pose_to_force_p99', 1e3),
    'tissue: wake-up p99 [ms]': (TISSUE_NODE, 'lateness_p99', 1e3),
    'tissue: rate [Hz]': (TISSUE_NODE, 'rate', 1.0),
    'view: rate [Hz]': (VIEWER_NODE, 'rate', 1.0),
}


def run(
    supervisor: Supervisor, scene: Path, seconds: float, rounds: int
) -> list[tuple[str, float, float]]:
    """Lets the conditions take turns; returns each with its begin and end [s since the epoch]."""
    spans = []
    for _ in range(rounds):
        for name, pages in CONDITIONS.items():
            supervisor.remove([VIEWER_NODE])
            if pages is not None:
                supervisor.replace([viewer_command(scene, LOCAL, PORT, session=False)])
            opened = [OpenPage(f'http://{LOCAL}:{PORT}') for _ in range(pages or 0)]
            began = time.time() + SETTLING
            ends = time.monotonic() + SETTLING + seconds
            while time.monotonic() < ends:
                supervisor.run(supervisor.outcome.seconds + 0.2)
            spans.append((name, began, time.time()))
            for page in opened:
                page.close()
    return spans


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--scene', default='liver')
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--rounds', type=int, default=3)
    given = parser.parse_args()
    scene = load_scene(given.scene)
    length = given.rounds * len(CONDITIONS) * (given.seconds + SETTLING + 8.0)
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        nodes = session_nodes(scene.path, bag, 0, length)
        with (
            SessionProgress(Console(stderr=True), len(nodes)) as progress,
            Supervisor(nodes, bag / 'log', node_environment(domain), progress.tell) as supervisor,
        ):
            assert supervisor.start(), supervisor.outcome
            spans = run(supervisor, scene.path, given.seconds, given.rounds)
            supervisor.end()
        Console().print(table(bag, spans))


def table(bag: Path, spans: list[tuple[str, float, float]]) -> Table:
    """Medians over the seconds of each condition."""
    statuses, origin = read_evidence(bag).statuses, 1e-9 * first_time(open_bag(bag))
    out = Table()
    for column in ('', *CONDITIONS, '3 pages / 0 pages', '3 pages / no view'):
        out.add_column(column, justify='left' if not column else 'right')
    for title, (node, key, scale) in QUANTITIES.items():
        medians: dict[str, float] = {}
        for name in CONDITIONS:
            values = [
                scale * status.number(key)
                for status in statuses
                for span, began, ended in spans
                if span == name and status.node == node and began < origin + status.time < ended
            ]
            values = [value for value in values if value == value]
            medians[name] = statistics.median(values) if values else float('nan')
        none, zero, three = medians.values()
        cells = [f'{value:.3g}' for value in (none, zero, three, three / zero, three / none)]
        out.add_row(title, *cells)
    return out


if __name__ == '__main__':
    main()
