"""`trainer bench-timing`: wake-up and latency of the running graph, beside a bare loop."""

import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cutting_trainer.node_common.realtime import PRIORITY
from cutting_trainer.node_common.timing import MAX_TIMELY_LATENESS_S
from cutting_trainer.session.bag_measurements import Status as NodeStatus
from cutting_trainer.session.bag_measurements import read_evidence
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    ARM_NODE,
    BRIDGE_NODE,
    node_environment,
    session_nodes,
)
from cutting_trainer.session.progress import SessionProgress
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.supervisor import Supervisor
from cutting_trainer.session.terminal import session_console

SETTLING_TIME_S = 2.0
"""Time after the first message that is not counted: the nodes are still starting."""
_BIN = re.compile(r'^(\d{6}) (\d+)$', re.MULTILINE)
_OVERFLOWS = re.compile(r'^# Histogram Overflows: (\d+)', re.MULTILINE)
_MAXIMUM = re.compile(r'^# Max Latencies: (\d+)', re.MULTILINE)


@dataclass(frozen=True)
class Row:
    """One quantity [s]: the median over the seconds of the run, and the worst second.

    Attributes:
        name: name of the quantity.
        p50, p999: medians over the seconds of that second's quantile.
        worst_p999: the worst second's.
        largest: of all.
        timely: share of deadlines that were met within 0.5 ms; None where there is no deadline.
    """

    name: str
    p50: float
    p999: float
    worst_p999: float
    largest: float
    timely: float | None = None


def run_bench(
    scene: str, seconds: float, domain: int | Literal['free'], *, as_json: bool
) -> Status:
    """Run a session with a bare loop beside it and print both.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    loaded = load_scene(scene)
    notes = session_console()
    with reserved_domain(domain) as number, tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        nodes = session_nodes(loaded.path, bag, 0, seconds)
        environment = node_environment(number)
        with (
            SessionProgress(notes, len(nodes)) as progress,
            Supervisor(nodes, bag / 'log', environment, progress.show) as supervisor,
        ):
            references = []
            if supervisor.start():
                references = _start_references(seconds, environment)
                supervisor.run(seconds, tick=lambda elapsed: progress.tick(elapsed, seconds))
            bare = [row for process in references for row in _finish_reference(process)]
            outcome = supervisor.end()
        for death in outcome.deaths:
            for line in death.tail:
                notes.print(f'  {death.node}: {escape(line)}', highlight=False)
        if outcome.deaths:
            return Status.NODE_DIED
        if outcome.interrupted:
            return Status.INTERRUPTED
        if not outcome.ran:
            notes.print(f'[bold red]error:[/] {escape(outcome.unready)}', highlight=False)
            return Status.FAILED
        rows = measured(read_evidence(bag).statuses)
    _show([*bare, *rows], as_json=as_json)
    return Status.OK


def measured(statuses: Iterable[NodeStatus]) -> list[Row]:
    """Return the rows of the statuses of a session."""
    late = [status for status in statuses if status.time > SETTLING_TIME_S]
    wanted = {
        f'{BRIDGE_NODE}: wake-up': (BRIDGE_NODE, 'lateness'),
        f'{ARM_NODE}: wake-up': (ARM_NODE, 'lateness'),
        f'{BRIDGE_NODE}: one tick': (BRIDGE_NODE, 'busy'),
        'pose stamped to force sent': (BRIDGE_NODE, 'pose_to_force'),
        'force stamped to motors': (ARM_NODE, 'force_age'),
    }
    rows = []
    for name, (node, key) in wanted.items():
        of_node = [status for status in late if status.node == node]
        p50 = _numbers(of_node, f'{key}_p50')
        # A tick's busy time has no p99.9 in the report.
        tail = _numbers(of_node, f'{key}_p999') or _numbers(of_node, f'{key}_p99')
        largest = _numbers(of_node, f'{key}_max')
        if p50 and tail:
            label = name if _numbers(of_node, f'{key}_p999') else f'{name} (p99)'
            median = statistics.median
            timely = statistics.mean(_numbers(of_node, 'timely')) if key == 'lateness' else None
            rows.append(Row(label, median(p50), median(tail), max(tail), max(largest), timely))
    return rows


def _numbers(statuses: list[NodeStatus], key: str) -> list[float]:
    values = [status.number(key) for status in statuses]
    return [value for value in values if not np.isnan(value)]


def _start_references(seconds: float, environment: dict[str, str]) -> list['subprocess.Popen[str]']:
    """Run a loop that only wakes, in Python, and cyclictest's in C where it is
    installed.
    """
    commands = [[sys.executable, '-m', 'bench.speed.reference_loop', str(seconds)]]
    cyclictest = shutil.which('cyclictest')
    if cyclictest is not None:
        options = f'-q -m -t 1 -p {PRIORITY} -i 1000 -h 50000 -D {round(seconds)}'
        commands.insert(0, [cyclictest, *options.split()])
    return [
        subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        for command in commands
    ]


def _finish_reference(process: 'subprocess.Popen[str]') -> list[Row]:
    try:
        said, _ = process.communicate(timeout=20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        said, _ = process.communicate()
    if process.returncode:
        return []
    if '# Histogram' in said:
        return [cyclictest_row(said)]
    report = json.loads(said)
    p999 = report['lateness_p999']
    largest, timely = report['lateness_max'], report['timely']
    return [Row('bare Python loop', report['lateness_p50'], p999, p999, largest, timely)]


def cyclictest_row(said: str) -> Row:
    """Return the row of cyclictest's histogram [us], over the whole run."""
    bins = [(int(latency), int(count)) for latency, count in _BIN.findall(said)]
    latencies = np.array([latency for latency, _ in bins]) * 1e-6
    counts = np.array([count for _, count in bins])
    overflows = _OVERFLOWS.search(said)
    total = counts.sum() + (int(overflows[1]) if overflows else 0)
    below = np.cumsum(counts) / total
    p50, p999 = (
        float(latencies[np.searchsorted(below, share)]) if below[-1] >= share else float('inf')
        for share in (0.5, 0.999)
    )
    maximum = _MAXIMUM.search(said)
    largest = int(maximum[1]) * 1e-6 if maximum else p999
    timely = float(counts[latencies <= MAX_TIMELY_LATENESS_S].sum() / total)
    return Row('cyclictest', p50, p999, p999, largest, timely)


def _show(rows: list[Row], *, as_json: bool) -> None:
    console = Console()
    if as_json:
        console.out(json.dumps([asdict(row) for row in rows], indent=2), highlight=False)
        return
    table = Table(title='Times [ms]', box=box.SIMPLE_HEAD)
    table.add_column('')
    headings = ('median', 'p99.9', 'p99.9 of the\nworst second', 'largest', 'within 0.5 ms\n[%]')
    for column in headings:
        table.add_column(column, justify='right')
    for row in rows:
        values = (row.p50, row.p999, row.worst_p999, row.largest)
        timely = f'{100 * row.timely:.2f}' if row.timely is not None else ''
        table.add_row(row.name, *(f'{1e3 * value:.3f}' for value in values), timely)
    console.print(table)
