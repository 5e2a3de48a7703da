"""`trainer soak`: one session after another on the same processes; does anything grow?"""

import json
import shutil
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rich.console import Console
from rich.table import Table

from haptic_bridge.settings import DeviceProfile
from session.demo import not_run
from session.domain import reserved_domain
from session.graph import (
    CUTTING_NODE,
    RECORDER_NODE,
    TISSUE_NODE,
    node_environment,
    recorder_command,
    simulation_nodes,
)
from session.processes import Supervisor
from session.progress import SessionProgress
from session.scene import load_scene
from session.status import Status
from session.trials.chaos import bags_of
from session.trials.chaos_verdict import unsafe
from session.trials.operator import Operator

RENEWED = (RECORDER_NODE, TISSUE_NODE, CUTTING_NODE)
"""Nodes that begin anew with each session; the others, and all processes, go on."""
STEPS = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)
SAMPLED = 5.0
"""[s] between two looks at the processes."""
WARM = 0.2
"""Share of the time that does not count: allocators and caches fill."""
GROWTH = 0.05
"""Share by which memory may be more in the last quarter than in the first that counts."""
PATIENCE = 60.0
"""[s] that a node has for a transition."""
ALLOWANCE = {'memory [MB]': 4.0, 'threads': 0.5, 'file handles': 2.0, 'DDS entities': 2.0}
"""By how much each may be more in any case."""


@dataclass(frozen=True)
class Sample:
    """One look at one process, or at the graph.

    Attributes:
        seconds: [s] since the start.
        what: the process's node, or `graph`.
        values: by the names of `ALLOWANCE`.
    """

    seconds: float
    what: str
    values: dict[str, float]


@dataclass(frozen=True)
class SoakOptions:
    """What the command line says.

    Attributes:
        scene: name or path.
        minutes: duration.
        every: length of a session [s].
        seed: of where the hand goes.
        domain: ROS domain, or `free`.
        as_json: print the outcome as JSON.
    """

    scene: str
    minutes: float
    every: float
    seed: int
    domain: int | Literal['free']
    as_json: bool


def look(name: str, pid: int, seconds: float) -> Sample | None:
    """A process's memory, threads and open files; None when it has ended."""
    try:
        status = Path(f'/proc/{pid}/status').read_text(encoding='utf-8')
        files = len(list(Path(f'/proc/{pid}/fd').iterdir()))
    except OSError:
        return None
    fields = dict(line.split(':', 1) for line in status.splitlines() if ':' in line)
    memory = float(fields['VmRSS'].split()[0]) / 1024
    values = {'memory [MB]': memory, 'threads': float(fields['Threads']), 'file handles': files}
    return Sample(seconds, name, values)


def entities(node: Node) -> int:
    """Publishers, subscriptions, services and clients of the graph."""
    count = 0
    for topic, _ in node.get_topic_names_and_types():
        count += node.count_publishers(topic) + node.count_subscribers(topic)
    for name, namespace in node.get_node_names_and_namespaces():
        count += len(node.get_service_names_and_types_by_node(name, namespace))
        count += len(node.get_client_names_and_types_by_node(name, namespace))
    return count


def grown(samples: list[Sample]) -> list[str]:
    """What was more at the end than after the warm-up, as sentences."""
    series: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for sample in samples:
        for name, value in sample.values.items():
            series[sample.what, name].append((sample.seconds, value))
    found = []
    for (what, name), rows in series.items():
        first, last = quarters(np.array(rows))
        if last > first * (1 + (GROWTH if name == 'memory [MB]' else 0)) + ALLOWANCE[name]:
            found.append(f'{name} of {what} grew from {first:.4g} to {last:.4g}')
    return found


def remove_old(bags: list[Path]) -> None:
    """Removes all but the two newest: by time, as a recorder takes a name that is free again."""
    there = [bag for bag in bags if bag.is_dir()]
    for old in sorted(there, key=lambda bag: bag.stat().st_mtime_ns)[:-2]:
        shutil.rmtree(old, ignore_errors=True)


def quarters(rows: np.ndarray) -> tuple[float, float]:
    """Medians of the first and the last quarter of what counts, rows of time and value."""
    start, end = WARM * rows[-1, 0], rows[-1, 0]
    quarter = (end - start) / 4
    early = rows[(rows[:, 0] >= start) & (rows[:, 0] <= start + quarter), 1]
    return float(np.median(early)), float(np.median(rows[rows[:, 0] >= end - quarter, 1]))


class _Renewal:
    """Begins the next session on the running processes, one transition after another."""

    def __init__(
        self, operator: Operator, profile: DeviceProfile, folder: Path, every: float
    ) -> None:
        self.sessions, self.failures = 1, list[str]()
        self._operator, self._profile = operator, profile
        self._folder, self._every = folder, every
        self._clients = {
            name: operator.node.create_client(ChangeState, f'{name}/change_state')
            for name in RENEWED
        }
        self._due = every
        self._left: list[tuple[str, int]] = []
        self._answer: Any = None
        self._since = 0.0

    def tick(self, elapsed: float) -> None:
        """Takes the next step when the one before is done."""
        if elapsed >= self._due and not self._left:
            self._due, self._since = self._due + self._every, elapsed
            self.judge()
            self._left = [(name, step) for step in STEPS for name in RENEWED]
        if not self._left:
            return
        name, step = self._left[0]
        if self._answer is None:
            if self._clients[name].service_is_ready():
                request = ChangeState.Request(transition=Transition(id=step))
                self._answer = self._clients[name].call_async(request)
        elif self._answer.done():
            done, self._answer, self._since = self._answer.result().success, None, elapsed
            self._left.pop(0)
            if not done:
                self.failures.append(f'{name} refused transition {step} at {elapsed:.0f} s')
            if not self._left:
                self.sessions += 1
                remove_old(bags_of(self._folder / 'bag'))
            return
        if elapsed > self._since + PATIENCE:
            self._left, self._answer = [], None
            self.failures.append(f'{name} did not answer to transition {step} at {elapsed:.0f} s')

    def judge(self) -> None:
        """Looks at every force since the last time."""
        self.failures += unsafe(self._operator.take_seen(), [], self._profile)


def run_soak(options: SoakOptions) -> Status:
    """Runs the sessions and says what has grown.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene, notes = load_scene(options.scene), Console(stderr=True)
    samples: list[Sample] = []
    with (
        reserved_domain(options.domain) as domain,
        tempfile.TemporaryDirectory(prefix='trainer-') as temporary,
        SessionProgress(notes, 5) as progress,
        Supervisor(
            [
                *simulation_nodes(scene.path, options.seed, Path(temporary) / 'checkpoint'),
                recorder_command(scene.path, Path(temporary) / 'bag', options.seed),
            ],
            Path(temporary) / 'log',
            node_environment(domain),
            progress.tell,
        ) as supervisor,
    ):
        if not supervisor.start():
            return not_run(supervisor.end(), Path(temporary), notes)
        operator = Operator(scene, domain, options.seed)
        profile = scene.device.load_profile()
        renewal, due = _Renewal(operator, profile, Path(temporary), options.every), 0.0

        def tick(elapsed: float) -> None:
            nonlocal due
            progress.tick(elapsed, 60 * options.minutes)
            renewal.tick(elapsed)
            if elapsed < due:
                return
            due += SAMPLED
            for name, pid in supervisor.pids.items():
                if (sample := look(name, pid, elapsed)) is not None:
                    samples.append(sample)
            graph = {'DDS entities': float(entities(operator.node))}
            samples.append(Sample(elapsed, 'graph', graph))

        began = time.monotonic()
        supervisor.run(60 * options.minutes, tick=tick)
        minutes = (time.monotonic() - began) / 60
        operator.end()
        renewal.judge()
        outcome = supervisor.end()
    failures = [
        *outcome.troubles,
        *grown(samples),
        *renewal.failures,
    ]
    _report(samples, renewal.sessions, minutes, failures, as_json=options.as_json)
    if outcome.interrupted:
        return Status.INTERRUPTED
    return Status.FAILED if failures else Status.OK


def _report(
    samples: list[Sample], sessions: int, minutes: float, failures: list[str], *, as_json: bool
) -> None:
    console = Console()
    rows = []
    for what in sorted({sample.what for sample in samples}):
        own = [s for s in samples if s.what == what]
        for name in own[0].values:
            first, last = quarters(np.array([(s.seconds, s.values[name]) for s in own]))
            rows.append((what, name, first, last))
    if as_json:
        values = [dict(zip(('what', 'name', 'first', 'last'), row, strict=True)) for row in rows]
        plain = {'minutes': minutes, 'sessions': sessions, 'quarters': values}
        console.out(json.dumps({**plain, 'failures': failures}, indent=2), highlight=False)
        return
    table = Table('of', 'what', 'first quarter', 'last quarter', box=None)
    for what, name, first, last in rows:
        table.add_row(what, name.replace('[', r'\['), f'{first:.4g}', f'{last:.4g}')
    console.print(table)
    console.print(f'{sessions} sessions in {minutes:.1f} min', highlight=False)
    for failure in failures:
        console.print(f'[bold red]not as it should be:[/] {failure}', highlight=False)
